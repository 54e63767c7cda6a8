"""Train all stages of a run: the same program as `python -m clothjax train`.

    python -m experiments.train configs/quickstart.yaml

See `clothjax/commands/train.py`.
"""

from clothjax import cli
from clothjax.commands.train import main

if __name__ == "__main__":
    cli.run(main)
