"""Write Psi for another runtime: the same program as `python -m clothjax convert`.

    python -m experiments.convert skirt --to onnx --int8

See `clothjax/commands/convert.py`.
"""

from clothjax import cli
from clothjax.commands.convert import main

if __name__ == "__main__":
    cli.run(main)
