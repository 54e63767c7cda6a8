"""`python -m experiments.demo`: see `viewer.py`."""

from clothjax import cli
from experiments.demo.viewer import main

if __name__ == "__main__":
    cli.run(main)
