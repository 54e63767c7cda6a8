"""Draw pictures and animations of a trained garment: the same program as `python -m clothjax render`.

    python -m experiments.render skirt --motions dance_3 --out skirt.mp4

See `clothjax/commands/render.py`.
"""

from clothjax import cli
from clothjax.commands.render import main

if __name__ == "__main__":
    cli.run(main)
