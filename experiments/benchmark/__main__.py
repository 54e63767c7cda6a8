"""`python -m experiments.benchmark`: see `report.py`."""

import sys

from clothjax.cli import fail_clearly, setup
from experiments.benchmark.report import main

if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
