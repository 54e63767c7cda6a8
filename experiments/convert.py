"""Writes Psi for another runtime: the same program as `python -m clothjax convert`.

    python -m experiments.convert skirt --to onnx --int8

`clothjax/commands/convert.py` tells the rest.
"""

from clothjax import cli
from clothjax.commands.convert import main

if __name__ == "__main__":
    cli.run(main)
