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
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import animation, experiment, inference, skinning, trained
from clothjax.animation import CLOTH, SKIN, Surface
from clothjax.experiment import Experiment
from clothjax.export import gltf, point_cache, usd
from clothjax.export.performance import Part, Performance
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
    whole, _ = load_phi(run)
    motion = arguments.motion or whole.config.evaluation.motions[0]
    frames = arguments.frames or whole.config.evaluation.animation_frames
    if kind == ".png":
        write_comparison(run, whole, motion, arguments.out)
    else:
        WRITERS[kind](arguments.out, perform(run, whole, motion, frames))
    out = arguments.out
    print(f"written to {out.with_name(f'{out.stem}_NNNN.obj') if kind == '.obj' else out}")


def perform(run: Path, whole: Experiment, motion: str, frames: int) -> Performance:
    """Psi on the body over the frames of a clip, or alone where the scene has no body."""
    clip = experiment.motion(whole, motion)
    garment = psi_trajectory(inference.load(run, betas=experiment.betas(whole.config)), clip)[:frames]
    body, root = body_trajectory(whole, clip)
    parts = (Part("body", body[:frames], whole.body.faces, SKIN), Part("garment", garment, whole.garment.faces, CLOTH))
    return Performance(parts if whole.scene.touchable else parts[1:], root[:frames], clip.fps)


def film(write: Callable) -> Callable:
    """A writer of a performance from one of pictures and frames a second; the camera goes along, but does not bob."""

    def written(out: Path, shown: Performance) -> None:
        tracks = [np.asarray(part.vertices) + shown.root[:, None] * [0.0, 1.0, 0.0] for part in shown.parts]
        floor, camera = float(tracks[0][..., 1].min()), animation.camera_for(shown.parts[0].vertices)
        pictures = []
        with progress("rendering", len(shown.root)) as report:
            for t in range(len(shown.root)):
                surfaces = [Surface(x[t], part.faces, part.colour) for x, part in zip(tracks, shown.parts)]
                pictures.append(animation.render(surfaces, camera, SIZE, floor=floor))
                report(t + 1)
        write(out, pictures, shown.fps)

    return written


def write_comparison(run: Path, whole: Experiment, motion: str, out: Path) -> None:
    """Skinning, Phi, Psi and the reference solver at the same moments of a measured clip."""
    path = kept(run) / f"trajectories_{Path(motion).stem}.npz"
    if not path.is_file():
        raise ValueError(f"{path}: no such file; run `python -m experiments.evaluate {run} --motion {motion}` first")
    with np.load(path) as tracks:
        tracks = {name: tracks[name] for name in ROWS}
    rows, columns = at_moments(whole, motion, {label: tracks[name] for name, label in ROWS.items()})
    animation.comparison(out, rows, columns)


def at_moments(
    whole: Experiment, motion: str, tracks: dict[str, np.ndarray], count: int = 5
) -> tuple[dict[str, list[np.ndarray]], list[str]]:
    """Rows of pictures of trajectories [T, V, 3] m over a clip, all at the same moments, and what each column shows."""
    body, root = body_trajectory(whole, experiment.motion(whole, motion))
    moments = np.linspace(0, min(map(len, tracks.values())) - 1, count + 1)[1:].astype(int)
    floor = float((body + root[:, None])[moments][..., 1].min())
    camera = animation.camera_for(body[moments])
    rows = {
        label: [
            animation.render(dressed(whole, body[t], track[t]), camera, SIZE, floor=floor - float(root[t, 1]))
            for t in moments
        ]
        for label, track in tracks.items()
    }
    return rows, [f"frame {t + 1}" for t in moments]


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


WRITERS = {
    ".webp": film(animation.webp),
    ".mp4": film(animation.mp4),
    ".glb": gltf.to_glb,
    ".usdc": usd.to_usd,
    ".usda": usd.to_usd,
    ".pc2": point_cache.to_pc2,
    ".mdd": point_cache.to_mdd,
    ".obj": point_cache.to_obj,
}


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
