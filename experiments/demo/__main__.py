"""`python -m experiments.demo`: see `viewer.py`."""

import sys

from clothjax.cli import fail_clearly, setup
from experiments.demo.viewer import main

if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
