"""`python -m experiments.stability`: see `report.py`."""

from clothjax import cli
from experiments.stability.report import main

if __name__ == "__main__":
    cli.run(main)
