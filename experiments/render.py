"""Pictures and animations of a trained garment.

    python -m experiments.render runs/quickstart --motion walk_3 --out walk.webp
    python -m experiments.render runs/quickstart --motion walk_3 --out comparison.png
    python -m experiments.render --pretrained skirt --motion dance_3 --out skirt.mp4
    python -m experiments.render --pretrained skirt --motion dance_3 --out skirt.usdc

Psi on the body as a film (.webp, .mp4); for a viewer or an animation program with both as meshes (.glb, .usdc, .usda,
or .obj, of which each frame is a file of its own) or the garment's vertices alone (.pc2, .mdd, with an .obj of the mesh
to put them on). .png compares skinning, Phi, Psi and the reference solver on a clip that `experiments.evaluate` has
measured.
"""

import argparse
import sys
from pathlib import Path

from clothjax.cli import fail_clearly, setup
from clothjax.evaluation.pictures import WRITERS, perform, write_comparison
from clothjax.evaluation.rollouts import load_run
from clothjax.runtime import trained


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run")
    parser.add_argument("--pretrained", default=None, help="name of a garment that comes with the library")
    parser.add_argument("--motion", default=None, help="asset name or path; default: the configured one")
    parser.add_argument("--out", type=Path, required=True, help=f"a file of .png, {', '.join(WRITERS)}")
    parser.add_argument("--frames", type=int, default=None, help="at the most; default: the configured number")
    arguments = parser.parse_args(argv)
    kind = arguments.out.suffix
    if kind != ".png" and kind not in WRITERS:
        raise ValueError(f"{arguments.out}: cannot write {kind!r}; allowed: .png, {', '.join(WRITERS)}")
    if (arguments.run is None) == (arguments.pretrained is None):
        raise ValueError("give the folder of a run, or --pretrained with the name of a garment")
    run = arguments.run or trained.folder(arguments.pretrained)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    whole, _ = load_run(run)
    motion = arguments.motion or whole.config.evaluation.motions[0]
    frames = arguments.frames or whole.config.evaluation.animation_frames
    if kind == ".png":
        write_comparison(run, whole, motion, arguments.out)
    else:
        WRITERS[kind](arguments.out, perform(run, whole, motion, frames))
    out = arguments.out
    print(f"written to {out.with_name(f'{out.stem}_NNNN.obj') if kind == '.obj' else out}")


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
