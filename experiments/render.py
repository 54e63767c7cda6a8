"""Pictures and animations of a trained garment.

    python -m experiments.render runs/quickstart --motion walk_3 --out walk.webp
    python -m experiments.render runs/quickstart --motion dance_0 --out dance.glb
    python -m experiments.render runs/quickstart --motion walk_3 --out comparison.png
    python -m experiments.render --pretrained skirt --motion dance_3 --out skirt.webp

.webp is an animation of Psi on the body, .glb the same for a viewer; .png compares skinning, Phi, Psi and the
reference solver on a clip that `experiments.evaluate` has measured.
"""

import argparse
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import animation, experiment, inference, skinning, trained
from clothjax.animation import SKIN, Surface
from clothjax.experiment import Experiment
from clothjax.export import gltf
from clothjax.types import Motion, Pose
from experiments.evaluate import kept, psi_trajectory
from experiments.session import fail_clearly, progress, setup
from experiments.train import load_phi

ROWS = {"lbs": "LBS", "phi": "Phi", "psi": "Psi", "solver": "reference solver"}
SIZE = (360, 480)


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run")
    parser.add_argument("--pretrained", default=None, help="name of a garment that comes with the library")
    parser.add_argument("--motion", default=None, help="asset name or path; default: the configured one")
    parser.add_argument("--out", type=Path, required=True, help="a .webp, .glb or .png")
    parser.add_argument("--frames", type=int, default=None, help="at the most; default: the configured number")
    arguments = parser.parse_args(argv)
    writers = {".webp": write_webp, ".glb": write_glb, ".png": write_comparison}
    if arguments.out.suffix not in writers:
        raise ValueError(f"{arguments.out}: cannot write {arguments.out.suffix!r}; allowed: {', '.join(writers)}")
    if (arguments.run is None) == (arguments.pretrained is None):
        raise ValueError("give the folder of a run, or --pretrained with the name of a garment")
    run = arguments.run or trained.folder(arguments.pretrained)
    whole, _ = load_phi(run)
    motion = arguments.motion or whole.config.evaluation.motions[0]
    frames = arguments.frames or whole.config.evaluation.animation_frames
    writers[arguments.out.suffix](run, whole, motion, arguments.out, frames)
    print(f"written to {arguments.out}")


def write_webp(run: Path, whole: Experiment, motion: str, out: Path, frames: int) -> None:
    """Psi on the body, the camera going with it."""
    clip = experiment.motion(whole, motion)
    garment = psi_trajectory(inference.load(run, betas=experiment.betas(whole.config)), clip)[:frames]
    body, root = body_trajectory(whole, clip)
    floor = float((body + root[:, None])[..., 1].min())
    camera = animation.camera_for(body)
    pictures = []
    with progress("rendering", len(garment)) as report:
        for t in range(len(garment)):
            # the camera goes along, but does not bob
            height = np.array([0.0, root[t, 1], 0.0])
            surfaces = dressed(whole, body[t] + height, garment[t] + height)
            pictures.append(animation.render(surfaces, camera, SIZE, floor=floor))
            report(t + 1)
    animation.webp(out, pictures, clip.fps)


def write_glb(run: Path, whole: Experiment, motion: str, out: Path, frames: int) -> dict[str, float]:
    """Psi on the body as glTF; returns the error of its compression in m."""
    clip = experiment.motion(whole, motion)
    garment = psi_trajectory(inference.load(run, betas=experiment.betas(whole.config)), clip)[:frames]
    body, root = body_trajectory(whole, clip)
    return gltf.to_glb(out, garment, whole.garment.faces, body[:frames], whole.body.faces, root[:frames], clip.fps)


def write_comparison(run: Path, whole: Experiment, motion: str, out: Path, frames: int = 0) -> None:
    """Skinning, Phi, Psi and the reference solver at the same moments of a measured clip."""
    path = kept(run) / f"trajectories_{Path(motion).stem}.npz"
    if not path.is_file():
        raise ValueError(f"{path}: no such file; run `python -m experiments.evaluate {run} --motion {motion}` first")
    with np.load(path) as tracks:
        tracks = {name: tracks[name] for name in ROWS}
    clip = experiment.motion(whole, motion)
    body, root = body_trajectory(whole, clip)
    moments = np.linspace(0, min(map(len, tracks.values())) - 1, 6)[1:].astype(int)
    floor = float((body + root[:, None])[moments][..., 1].min())
    camera = animation.camera_for(body[moments])
    rows = {
        label: [
            animation.render(dressed(whole, body[t], tracks[name][t]), camera, SIZE, floor=floor - float(root[t, 1]))
            for t in moments
        ]
        for name, label in ROWS.items()
    }
    animation.comparison(out, rows, [f"frame {t + 1}" for t in moments])


def body_trajectory(whole: Experiment, clip: Motion, betas: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The whole body [T - 2, B, 3] m at the frames that are measured, relative to its root [T - 2, 3] m.

    Args:
        betas: [S]; default: those of evaluation.
    """
    betas = jnp.asarray(experiment.betas(whole.config) if betas is None else betas)
    vertices = skinning.shaped_vertices(whole.body, betas)
    joints = skinning.shaped_joints(whole.body, betas)

    @jax.jit
    def posed(rotations):
        return skinning.pose_body(whole.body, vertices, joints, Pose(rotations, jnp.zeros(3)))

    rotations = np.asarray(clip.rotations[1:-1], np.float32)
    translation = np.asarray(clip.translation[1:-1])
    return np.stack([np.asarray(posed(r)) for r in rotations]), translation - translation[0]


def dressed(whole: Experiment, body: np.ndarray, garment: np.ndarray) -> list[Surface]:
    """The surfaces of a garment on a body, or of the garment alone where the scene has no body."""
    cloth = [Surface(garment, whole.garment.faces)]
    return [Surface(body, whole.body.faces, SKIN), *cloth] if whole.scene.touchable else cloth


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
