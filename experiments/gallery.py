"""A picture of a garment: Phi, Psi and the reference solver, each in its own closed loop, on three motions and bodies.

    python -m experiments.gallery --pretrained skirt --out skirt.png
    python -m experiments.gallery runs/skirt --motions walk_3 dance_3 run_3 --frame 45 --out skirt.png

The bodies are a thin, the mean and a heavy one, the cloth is the middling one of `experiment.wearers`. All start at
the motion's start; what is shown is the same frame of each.
"""

import argparse
import sys
from pathlib import Path

from clothjax.cli import fail_clearly, setup
from clothjax.evaluation.pictures import GALLERY_MOTIONS, gallery
from clothjax.render import ray_cast
from clothjax.runtime import trained


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run")
    parser.add_argument("--pretrained", default=None, help="name of a garment that comes with the library")
    parser.add_argument("--motions", nargs="+", default=GALLERY_MOTIONS, help="asset names or paths")
    parser.add_argument("--frame", type=int, default=40, help="the frame shown")
    parser.add_argument("--out", type=Path, required=True, help="a .png")
    arguments = parser.parse_args(argv)
    if (arguments.run is None) == (arguments.pretrained is None):
        raise ValueError("give the folder of a run, or --pretrained with the name of a garment")
    run = arguments.run or trained.folder(arguments.pretrained)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    rows, columns = gallery(run, arguments.motions, arguments.frame)
    ray_cast.comparison(arguments.out, rows, columns)
    print(f"written to {arguments.out}")


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
