"""`python -m experiments.compare_solvers`: see `report.py`."""

import sys

from clothjax.cli import fail_clearly, setup
from experiments.compare_solvers.report import main

if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
