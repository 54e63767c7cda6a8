"""Draw a garment: Phi, Psi and the reference solver, each in its own rollout, on three motions and bodies.

    python -m experiments.gallery skirt --out skirt.png
    python -m experiments.gallery runs/skirt --motions walk_3 dance_3 run_3 --frame 45 --out skirt.png

The bodies are a thin, the mean and a heavy one, the cloth is the middle one of `assembly.wearers`. Rollouts begin
at the motion's start; the same frame of each is shown.
"""

from pathlib import Path

from clothjax import cli
from clothjax.evaluation.pictures import GALLERY_MOTIONS, gallery
from clothjax.render import ray_cast
from clothjax.runtime import trained


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.gallery", __doc__)
    cli.model_argument(parser)
    parser.add_argument("--motions", nargs="+", default=GALLERY_MOTIONS, help="asset names or paths")
    parser.add_argument("--frame", type=int, default=40, help="the frame shown")
    parser.add_argument("--out", type=Path, required=True, help="a .png")
    arguments = parser.parse_args(argv)
    run = trained.find(arguments.model)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    rows, columns = gallery(run, arguments.motions, arguments.frame)
    ray_cast.comparison(arguments.out, rows, columns)
    print(f"written to {arguments.out}")


if __name__ == "__main__":
    cli.run(main)
