"""`python -m experiments.stability`: see `report.py`."""

import sys

from clothjax.cli import fail_clearly, setup
from experiments.stability.report import main

if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
