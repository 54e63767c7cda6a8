"""A training that keeps a checkpoint after every call, for `test_killed.py`: python tests/killed.py CONFIG ..."""

import sys
from functools import partial

from clothjax.cli import setup
from clothjax.training import loop
from experiments import train

if __name__ == "__main__":
    setup()
    loop.fit = partial(loop.fit, checkpoint_seconds=0.0)
    train.main(sys.argv[1:])
