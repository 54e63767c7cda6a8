"""`python -m experiments.benchmark`: see `report.py`."""

from clothjax import cli
from experiments.benchmark.report import main

if __name__ == "__main__":
    cli.run(main)
