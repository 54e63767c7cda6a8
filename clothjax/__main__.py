"""The programs of clothjax: a garment from its training to another engine.

    clothjax train --garment skirt_1000 --model.relaxation 4 --stage1.steps 200 --directory runs/skirt
    clothjax evaluate runs/skirt --motions walk_3
    clothjax render skirt --motions dance_3 --out skirt.webp
    clothjax convert skirt --to onnx --int8
    clothjax doctor

`clothjax COMMAND --help` tells more of each; `python -m clothjax` is the same as `clothjax`. A model is a run's folder,
a packed folder, or the name of a garment that comes with clothjax.
"""

import importlib
import sys
from collections.abc import Sequence

from clothjax import cli

COMMANDS = {  # imported when it is run, so that the doctor can look at an installation that lacks a package
    "train": "clothjax.commands.train",
    "evaluate": "clothjax.commands.evaluate",
    "render": "clothjax.commands.render",
    "convert": "clothjax.commands.convert",
    "doctor": "clothjax.doctor",
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the program that the first argument names; by default the arguments of this process."""
    argv = list(sys.argv[1:] if argv is None else argv)
    parser = cli.Parser("clothjax", __doc__)
    parser.add_argument("command", choices=COMMANDS, metavar=f"{{{','.join(COMMANDS)}}}")
    command = parser.parse_args(argv[:1] or ["--help"]).command
    with cli.fail_clearly():
        if command != "doctor":
            cli.setup()
        importlib.import_module(COMMANDS[command]).main(argv[1:])


if __name__ == "__main__":
    main()
