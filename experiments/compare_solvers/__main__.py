"""`python -m experiments.compare_solvers`: see `report.py`."""

from clothjax import cli
from experiments.compare_solvers.report import main

if __name__ == "__main__":
    cli.run(main)
