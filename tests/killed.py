"""A training that keeps a checkpoint after every call, for `test_killed.py`: python tests/killed.py CONFIG ..."""

import sys
from functools import partial

from clothjax import fit
from experiments import train
from experiments.session import setup

if __name__ == "__main__":
    setup()
    fit.fit = partial(fit.fit, checkpoint_seconds=0.0)
    train.main(sys.argv[1:])
