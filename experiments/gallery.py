"""A picture of a garment: Phi, Psi and the reference solver, each in its own closed loop, on three motions and bodies.

    python -m experiments.gallery --pretrained skirt --out skirt.png
    python -m experiments.gallery runs/skirt --motions walk_3 dance_3 run_3 --frame 45 --out skirt.png

The bodies are a thin, the mean and a heavy one, the cloth is the middling one of `experiment.wearers`. All start at
the motion's start; what is shown is the same frame of each.
"""

import argparse
import sys
from pathlib import Path

import jax
import numpy as np

from clothjax import animation, experiment, inference, rollout, simulation, trained
from clothjax import character as characters
from clothjax.types import Motion
from experiments.evaluate import psi_trajectory, windows
from experiments.render import body_trajectory, dressed
from experiments.session import fail_clearly, progress, setup
from experiments.train import load_phi

MOTIONS = ("walk_3", "dance_3", "run_3")
BODIES = ("thin", "mean", "heavy")
CLOTH = "middling"
SIZE = (240, 480)


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run")
    parser.add_argument("--pretrained", default=None, help="name of a garment that comes with the library")
    parser.add_argument("--motions", nargs="+", default=MOTIONS, help="asset names or paths")
    parser.add_argument("--frame", type=int, default=40, help="the frame shown")
    parser.add_argument("--out", type=Path, required=True, help="a .png")
    arguments = parser.parse_args(argv)
    if (arguments.run is None) == (arguments.pretrained is None):
        raise ValueError("give the folder of a run, or --pretrained with the name of a garment")
    run = arguments.run or trained.folder(arguments.pretrained)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    rows, columns = pictures(run, arguments.motions, arguments.frame)
    animation.comparison(arguments.out, rows, columns)
    print(f"written to {arguments.out}")


def pictures(run: Path, motions: list[str], frame: int) -> tuple[dict[str, list[np.ndarray]], list[str]]:
    """Rows of pictures by method, and what each column shows."""
    whole, phi = load_phi(run)
    config = whole.config
    wearers = experiment.wearers(whole)
    play = jax.jit(lambda m, c, p: rollout.play(m, whole.scene, c, p, config)[1].position)
    at = frame - 1  # what is measured starts at a clip's second frame
    rows, columns = {"Phi": [], "Psi": [], "solver": []}, []
    with progress("simulating", len(motions) * len(BODIES)) as report:
        for motion in motions:
            clip = experiment.motion(whole, motion)
            if not 1 <= frame <= len(clip.translation) - 2:
                raise ValueError(f"{motion} has frames 1 to {len(clip.translation) - 2} to show, not {frame}")
            clip = Motion(clip.rotations[: frame + 2], clip.translation[: frame + 2], clip.fps)
            poses = windows(clip)
            for shape in BODIES:
                betas, material = wearers[f"{shape}, {CLOTH}"]
                character = jax.jit(lambda b, m: characters.dress(whole.scene, b, m, config.physics))(betas, material)
                tracks = {
                    "Phi": np.asarray(play(phi, character, poses)),
                    "Psi": psi_trajectory(inference.load(run, betas=betas, material=material), clip),
                    "solver": simulation.simulate(whole.scene, character, poses, config)[0],
                }
                body, root = body_trajectory(whole, clip, betas)
                camera = animation.camera_for(body[at : at + 1])
                floor = float((body + root[:, None])[..., 1].min() - root[at, 1])
                for name, track in tracks.items():
                    surfaces = dressed(whole, body[at], track[at])
                    rows[name].append(animation.render(surfaces, camera, SIZE, floor=floor))
                columns.append(f"{Path(motion).stem}, {shape}")
                report(len(columns))
    return rows, columns


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
