"""Measure runs and garments against the reference solver: the same program as `python -m clothjax evaluate`.

    python -m experiments.evaluate runs/quickstart --motions walk_3

See `clothjax/commands/evaluate.py`.
"""

from clothjax import cli
from clothjax.commands.evaluate import main

if __name__ == "__main__":
    cli.run(main)
