"""Trajectories as labelled grids of pictures and as animation files."""

from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import joint_names, skinning
from clothjax.evaluation import rollouts
from clothjax.evaluation.rollouts import Tracks, load_run, psi_trajectory, windows
from clothjax.networks.animators import phi_animator
from clothjax.progress import progress_bar
from clothjax.render import gltf, point_cache, ray_cast, skinned_gltf, usd
from clothjax.render.performance import Part, Performance, SkinnedPart, SkinnedPerformance
from clothjax.render.ray_cast import CLOTH, SKIN, Surface
from clothjax.runtime import loading
from clothjax.simulation import assembly, reference
from clothjax.simulation.assembly import Experiment
from clothjax.types import Array, Body, Motion, Pose

GALLERY_MOTIONS = ("walk_3", "dance_3", "run_3")
GALLERY_BODIES = ("thin", "mean", "heavy")
GALLERY_CLOTH = "middling"
GALLERY_SIZE = (240, 480)


def gallery(run: Path, motions: list[str], frame: int) -> tuple[dict[str, list[np.ndarray]], list[str]]:
    """Render Phi, Psi and the solver on three bodies in several motions.

    Args:
        frame: of each motion, the one that is shown.

    Returns:
        Rows of pictures [h, w, 3] uint8 by method, and a label for each column.

    Raises:
        ValueError: for a motion without that frame.
    """
    experiment, phi = load_run(run)
    config = experiment.config
    people = assembly.wearers(experiment)
    play = jax.jit(lambda m, c, p: rollouts.states(phi_animator, m, experiment, c, p))
    index = frame - 1  # trajectories start at a clip's second frame
    rows, columns = {"Phi": [], "Psi": [], "solver": []}, []
    with progress_bar("simulating", len(motions) * len(GALLERY_BODIES)) as report:
        for motion in motions:
            clip = assembly.motion(experiment, motion)
            if not 1 <= frame <= len(clip.translation) - 2:
                raise ValueError(f"{motion} has frames 1 to {len(clip.translation) - 2} to show, not {frame}")
            clip = Motion(clip.rotations[: frame + 2], clip.translation[: frame + 2], clip.fps)
            poses = windows(clip)
            for shape in GALLERY_BODIES:
                betas, material = people[f"{shape}, {GALLERY_CLOTH}"]
                character = assembly.dress(experiment, betas, material)
                tracks = {
                    "Phi": np.asarray(play(phi, character, poses)),
                    "Psi": psi_trajectory(loading.load(run, betas=betas, material=material), clip),
                    "solver": reference.simulate(experiment.scene, character, poses, config)[0],
                }
                body, root = body_trajectory(experiment, clip, betas)
                camera = ray_cast.camera_for(body[index : index + 1])
                floor = float((body + root[:, None])[..., 1].min() - root[index, 1])
                for name, track in tracks.items():
                    surfaces = dressed(experiment, body[index], track[index])
                    rows[name].append(ray_cast.render(surfaces, camera, GALLERY_SIZE, floor=floor))
                columns.append(f"{Path(motion).stem}, {shape}")
                report(len(columns))
    return rows, columns


ROWS = {"lbs": "LBS", "phi": "Phi", "psi": "Psi"}  # of a comparison, and the solver
SIZE = (360, 480)
FILM, AROUND = (480, 640), 1.3  # of a film: pixels, and how much more than the garment the camera sees


def perform(run: Path, experiment: Experiment, motion: str, frames: int) -> Performance:
    """Roll Psi out over at most `frames` frames of a clip; return the garment, on the body if the scene has one."""
    clip = assembly.motion(experiment, motion)
    garment = psi_trajectory(loading.load(run, betas=assembly.betas(experiment.config)), clip)[:frames]
    return _performance(experiment, clip, garment)


def perform_beside(run: Path, experiment: Experiment, motion: str, frames: int) -> dict[str, Performance]:
    """Return Psi and the reference solver over at most `frames` frames of a clip, by name, as `perform` does.

    Raises:
        ValueError: if `clothjax evaluate` has not measured the run, as it is now, on this clip.
    """
    tracks, clip = Tracks.load(run, motion), assembly.motion(experiment, motion)
    frames = min(frames, len(tracks.solver))
    both = {"Psi": tracks.methods["psi"], "reference solver": tracks.solver}
    return {name: _performance(experiment, clip, track[:frames]) for name, track in both.items()}


def _performance(experiment: Experiment, clip: Motion, garment: np.ndarray) -> Performance:
    """Return a garment [T, V, 3] m over the start of a clip, on the body if the scene has one."""
    frames, (body, root) = len(garment), body_trajectory(experiment, clip)
    cloth = experiment.garment
    parts = (
        Part("body", body[:frames], np.asarray(experiment.body.faces), SKIN),
        Part("garment", garment, np.asarray(cloth.faces), CLOTH, np.asarray(cloth.vertices)),
    )
    return Performance(parts if experiment.scene.touchable else parts[1:], root[:frames], clip.fps)


def perform_skinned(
    run: Path, experiment: Experiment, motion: str | None, frames: int, betas: np.ndarray | None = None
) -> SkinnedPerformance:
    """Roll Psi out as `perform` does, on the body's skeleton; without a motion, return the canonical pose alone.

    In motion, each vertex of the garment keeps four joints, as many as every engine has. Its canonical place is the one
    that these carry to what Psi shows.

    Args:
        betas: [S]; default: the mean body, as of an exported model.
    """
    body, weights = experiment.body, np.asarray(experiment.garment.weights)
    shape = jnp.zeros(body.shapedirs.shape[-1]) if betas is None else jnp.asarray(betas, jnp.float32)
    joints, skin = skinning.shaped_joints(body, shape), skinning.shaped_vertices(body, shape)
    corrected, cloth, clip = skin[None], skinning.shaped_vertices(experiment.garment, shape)[None], None
    if motion is not None:
        clip = assembly.motion(experiment, motion)
        shown = psi_trajectory(loading.load(run, betas=betas), clip)[:frames]
        root = np.asarray(clip.translation[1:-1][:frames])
        clip = Motion(np.asarray(clip.rotations[1:-1][:frames], np.float32), root - root[0], clip.fps)
        weights = skinned_gltf.largest(weights, skinned_gltf.SET).astype(np.float32)
        cloth = np.stack(list(map(_unskinned(body, joints, weights), clip.rotations, shown)))
        if body.posedirs is not None:
            poses = Pose(jnp.asarray(clip.rotations), jnp.zeros_like(root))
            corrected = jax.vmap(lambda pose: skinning.pose_corrected(body.posedirs, skin, pose))(poses)
    parts = (
        SkinnedPart("body", np.asarray(corrected), np.asarray(body.faces), np.asarray(body.weights), SKIN),
        SkinnedPart("garment", np.asarray(cloth), np.asarray(experiment.garment.faces), weights, CLOTH),
    )
    parts = parts if experiment.scene.touchable else parts[1:]
    bones = joint_names.vrm_bones(experiment.names)
    return SkinnedPerformance(parts, experiment.names, np.asarray(body.parents), np.asarray(joints), bones, clip)


def _unskinned(body: Body, joints: Array, weights: np.ndarray) -> Callable:
    """Return a function from rotations [J, 3, 3] and posed vertices [V, 3] m to the canonical ones [V, 3] m.

    Args:
        joints: [J, 3] m in the canonical pose.
        weights: [V, J] skinning weights.
    """

    @jax.jit
    def unskinned(rotations, posed):
        transforms = skinning.joint_transforms(rotations, joints, body.parents)
        return skinning.unapply(skinning.blend(jnp.asarray(weights), transforms), posed)

    return unskinned


def film(write: Callable) -> Callable:
    """Return a writer of performances from a writer of pictures.

    It takes one performance, or several by name, which are shown side by side. The garment fills the picture. The
    camera follows the root, but not up and down.

    Args:
        write: takes a path, pictures and frames a second.
    """

    def write_film(out: Path, shown: Performance | dict[str, Performance]) -> None:
        several = shown if isinstance(shown, dict) else {"": shown}
        first = next(iter(several.values()))
        tracks = {
            name: [np.asarray(part.vertices) + one.root[:, None] * [0.0, 1.0, 0.0] for part in one.parts]
            for name, one in several.items()
        }
        floor = min(float(parts[0][..., 1].min()) for parts in tracks.values())
        camera = ray_cast.camera_for(
            np.concatenate([parts[-1] for parts in tracks.values()]), margin=AROUND, aspect=FILM[0] / FILM[1]
        )
        pictures = []
        with progress_bar("rendering", len(first.root)) as report:
            for t in range(len(first.root)):
                each = {}
                for name, one in several.items():
                    pairs = zip(tracks[name], one.parts, strict=True)
                    surfaces = [Surface(x[t], part.faces, part.colour, part.checked) for x, part in pairs]
                    each[name] = ray_cast.render(surfaces, camera, FILM, floor=floor)
                pictures.append(ray_cast.beside(each) if isinstance(shown, dict) else each[""])
                report(t + 1)
        write(out, pictures, first.fps)

    return write_film


def write_comparison(run: Path, experiment: Experiment, motion: str, out: Path) -> None:
    """Write a PNG of skinning, Phi, Psi and the reference solver at the same moments of a clip.

    Raises:
        ValueError: if `clothjax evaluate` has not measured the run, as it is now, on this clip.
    """
    tracks = Tracks.load(run, motion)
    shown = {label: tracks.methods[name] for name, label in ROWS.items()} | {"reference solver": tracks.solver}
    rows, columns = at_moments(experiment, motion, shown)
    ray_cast.comparison(out, rows, columns)


def at_moments(
    experiment: Experiment, motion: str, tracks: dict[str, np.ndarray], count: int = 5
) -> tuple[dict[str, Sequence[np.ndarray]], list[str]]:
    """Render rows of pictures of trajectories [T, V, 3] m over a clip at the same moments; also label each column."""
    body, root = body_trajectory(experiment, assembly.motion(experiment, motion))
    moments = np.linspace(0, min(map(len, tracks.values())) - 1, count + 1)[1:].astype(int)
    floor = float((body + root[:, None])[moments][..., 1].min())
    camera = ray_cast.camera_for(body[moments])
    rows: dict[str, Sequence[np.ndarray]] = {
        label: [
            ray_cast.render(dressed(experiment, body[t], track[t]), camera, SIZE, floor=floor - float(root[t, 1]))
            for t in moments
        ]
        for label, track in tracks.items()
    }
    return rows, [f"frame {t + 1}" for t in moments]


def body_trajectory(
    experiment: Experiment, clip: Motion, betas: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Pose the complete body [T - 2, B, 3] m at the measured frames, relative to its root; also return the root.

    Args:
        betas: [S]; default: those of evaluation.

    Returns:
        The body's vertices, and the root's positions [T - 2, 3] m.
    """
    shape = jnp.asarray(assembly.betas(experiment.config) if betas is None else betas)
    vertices = skinning.shaped_vertices(experiment.body, shape)
    joints = skinning.shaped_joints(experiment.body, shape)

    @jax.jit
    def posed(rotations):
        return skinning.pose_body(experiment.body, vertices, joints, Pose(rotations, jnp.zeros(3)))

    rotations = np.asarray(clip.rotations[1:-1], np.float32)
    translation = np.asarray(clip.translation[1:-1])
    return np.stack([np.asarray(posed(r)) for r in rotations]), translation - translation[0]


def dressed(experiment: Experiment, body: np.ndarray, garment: np.ndarray) -> list[Surface]:
    """Return the surfaces of a garment [V, 3] m on a body [B, 3] m; of the garment alone if the scene has no body."""
    cloth = [Surface(garment, np.asarray(experiment.garment.faces))]
    return [Surface(body, np.asarray(experiment.body.faces), SKIN), *cloth] if experiment.scene.touchable else cloth


FILMS = {".webp": film(ray_cast.webp), ".mp4": film(ray_cast.mp4)}
WRITERS = {
    **FILMS,
    ".glb": gltf.to_glb,
    ".usdc": usd.to_usd,
    ".usda": usd.to_usd,
    ".pc2": point_cache.to_pc2,
    ".mdd": point_cache.to_mdd,
    ".obj": point_cache.to_obj,
}
