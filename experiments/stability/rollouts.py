"""A trained run in autoregressive rollouts: long, beyond its training, and after shocks."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from clothjax.evaluation import metrics
from clothjax.evaluation.rollouts import load_run, phi_trajectory, windows
from clothjax.material import configured_material
from clothjax.physics import incremental_potential
from clothjax.runtime import inference, loading
from clothjax.runtime.models import ForcePredictor, Model
from clothjax.simulation import assembly, reference
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.characters import Character
from clothjax.types import Motion, Pose, Rest
from experiments.stability.solver import corners

BEFORE = 60  # frames, until a shock
AFTER = 240  # frames, after it
SETTLING = 120  # frames from the freeze of the pose until drift is measured
WITHIN = 0.1  # of its undisturbed energy
TELEPORT = 10.0  # m


class Loop(NamedTuple):
    """One autoregressive rollout."""

    frames: int
    nonfinite: int  # frames
    flagged: int  # frames that the model says are outside the range of training
    latent: float  # the largest component of the code, in standard deviations; with forces, of a code in its own units
    strain: float  # the largest of an edge


class Shock(NamedTuple):
    """A shock at frame `BEFORE` of a rollout, and its consequences."""

    loop: Loop
    recovery: int | None  # frames until the energy is within `WITHIN` of the undisturbed one, and stays there
    energy: np.ndarray  # [T] J of the disturbed loop over that of the undisturbed one


def play(model: Model, motion: Motion) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices [T, V, 3] m relative to the root, codes [T, L] as in `State`, and `ok` [T]."""
    vertices, latents, ok = _play(model, motion)
    root = np.nan_to_num(np.asarray(motion.translation, np.float32))
    return np.asarray(vertices) - root[:, None], np.asarray(latents), np.asarray(ok)


@jax.jit
def _play(model: Model, motion: Motion):
    return inference.rollout(model, motion, lambda state, vertices: (vertices, state.latent, state.ok))


def measure(experiment: Experiment, character: Character, played: tuple) -> Loop:
    """Measure a rollout."""
    vertices, latents, ok = played
    finite = np.isfinite(vertices).all(axis=(1, 2)) & np.isfinite(latents).all(axis=1)
    strain = (
        metrics.edge_strain(experiment.scene, character, vertices[finite])["edge_strain_max"]
        if finite.any()
        else np.inf
    )
    code = float(np.abs(latents[finite]).max(initial=0.0))
    return Loop(len(ok), int((~finite).sum()), int((~ok).sum()), code, strain)


def stress(run, frames: int, quick: bool, progress: Callable[[int], None]) -> dict:
    """Run every rollout of a run; `frames` for the longest. With `quick`, fewer variants."""
    experiment, phi = load_run(run)
    config = experiment.config
    betas, cloth = assembly.betas(config), configured_material(config)
    load = partial(loading.load, run)
    dress = partial(assembly.dress, experiment)
    usual, character = load(betas=betas), dress(betas, cloth)
    clip = assembly.motion(experiment, config.evaluation.motions[0])
    clip = clip._replace(translation=np.asarray(clip.translation - clip.translation[:1], np.float32))
    short = assembly.there_and_back(clip, min(frames, 300))
    loops = {"long": measure(experiment, character, play(usual, assembly.there_and_back(clip, frames)))}

    for scale in (0.5, 2.0):
        larger = character._replace(template=scale * character.template)
        farther = short._replace(translation=scale * short.translation)
        loops[f"body scale {scale:g}"] = measure(experiment, larger, play(scaled(usual, scale), farther))
    for size in (-5.0, 5.0) if quick else (-5.0, -3.0, 3.0, 5.0):
        shape = np.full_like(betas, size)
        loops[f"betas {size:+g}"] = measure(experiment, dress(shape, cloth), play(load(betas=shape), short))
    for index, material in enumerate(corners(config)[:: 15 if quick else 1]):
        model = load(betas=betas, material=material)
        loops[f"material {index}"] = measure(experiment, dress(betas, material), play(model, short))
    for fps in (15.0, 120.0) if quick else (15.0, 24.0, 60.0, 90.0, 120.0):
        model = replace(usual, config=replace(config, fps=fps))
        loops[f"{fps:g} frames/s"] = measure(experiment, character, play(model, at_rate(short, fps)))
    progress(1)

    frozen = freeze(short, BEFORE, min(frames, 2000) + SETTLING)
    played = play(usual, frozen)
    loops["frozen pose"] = measure(experiment, character, played)
    drift = drift_mm(played[0][BEFORE + SETTLING :])
    phi_track = phi_trajectory(experiment, phi, character, windows(frozen))
    phi_drift = drift_mm(phi_track[BEFORE + SETTLING :])
    progress(2)

    base = assembly.there_and_back(clip, BEFORE + AFTER)
    undisturbed = energies(experiment, character, play(usual, base)[0], base)
    shocks = {}
    for name, motion in disturbed(base).items():
        played = play(usual, motion)
        relative = energies(experiment, character, played[0], base) / undisturbed
        shocks[name] = Shock(measure(experiment, character, played), recovery_frames(relative), relative)
    progress(3)
    phi_base = phi_trajectory(experiment, phi, character, windows(base))
    thrown = phi_trajectory(experiment, phi, character, windows(disturbed(base)["teleport"]))
    same = windows(base)
    relative = energies_of(experiment, character, thrown, same) / energies_of(experiment, character, phi_base, same)
    progress(4)
    return {
        "loops": loops | {name: shock.loop for name, shock in shocks.items()},
        "shocks": shocks,
        "drift_mm": drift,
        "phi": {
            "drift_mm": phi_drift,
            "recovery_frames": recovery_frames(relative),
            "nonfinite": sum(int((~np.isfinite(track)).any(axis=(1, 2)).sum()) for track in (phi_track, thrown)),
            "energy": relative,
        },
    }


def scaled(model: Model, scale: float) -> Model:
    """Return a model with a body so much larger, and a garment cut for it; blend shapes are as they are."""

    def cut(rest: Rest) -> Rest:
        return Rest(rest.inverse / scale, scale**2 * rest.face_area, scale**2 * rest.hinge_area, rest.hinge_angle)

    wearer, predictor = model.wearer, model.network.predictor
    wearer = wearer._replace(joints=scale * wearer.joints, template=scale * wearer.template)
    if isinstance(predictor, ForcePredictor):
        cloth = wearer.cloth
        wearer = wearer._replace(
            cloth=cloth._replace(
                mass=scale**2 * cloth.mass,
                rest=cut(cloth.rest),
                body=scale * cloth.body,
                template=None if cloth.template is None else scale * cloth.template,
                shown=None if cloth.shown is None else cloth.shown._replace(rest=cut(cloth.shown.rest)),
            )
        )
        corrections = None if predictor.corrections is None else scale * predictor.corrections
        predictor = predictor._replace(corrections=corrections)
    return replace(model, wearer=wearer, network=model.network._replace(predictor=predictor))


def freeze(motion: Motion, start: int, frames: int) -> Motion:
    """Return the motion up to a frame, then that frame for `frames` more."""
    order = np.minimum(np.arange(start + frames), start - 1)
    return Motion(motion.rotations[order], motion.translation[order], motion.fps)


def disturbed(motion: Motion) -> dict[str, Motion]:
    """Return the motion with one shock each at frame `BEFORE`: a lasting jump, a frame of NaN, a half-turn."""
    jump = np.where(np.arange(len(motion.translation))[:, None] >= BEFORE, np.float32(TELEPORT), np.float32(0.0))
    broken, turned = np.array(motion.rotations, np.float32), np.array(motion.rotations, np.float32)
    broken[BEFORE] = np.nan
    turned[BEFORE, 0] = np.diag(np.float32([1, -1, -1])) @ turned[BEFORE, 0]
    return {
        "teleport": motion._replace(translation=motion.translation + jump * np.float32([[1, 0, 0]])),
        "NaN frame": motion._replace(rotations=broken),
        "half-turn": motion._replace(rotations=turned),
    }


def at_rate(motion: Motion, fps: float) -> Motion:
    """Resample the motion to another frame rate by interpolation."""
    count = len(motion.translation)
    old = np.arange(count) / motion.fps
    new = np.arange(0, old[-1], 1 / fps)
    low = np.minimum((new * motion.fps).astype(int), count - 2)
    share = (new * motion.fps - low)[:, None]
    first, second = (np.asarray(motion.rotations, np.float64)[low + i].reshape(-1, 3, 3) for i in (0, 1))
    turn = Rotation.from_matrix(np.swapaxes(first, 1, 2) @ second).as_rotvec().reshape(len(new), -1, 3)
    between = first @ Rotation.from_rotvec((share[:, None] * turn).reshape(-1, 3)).as_matrix()
    place = (1 - share) * motion.translation[low] + share * motion.translation[low + 1]
    joints = motion.rotations.shape[1]
    return Motion(between.reshape(len(new), joints, 3, 3).astype(np.float32), place.astype(np.float32), fps)


def drift_mm(track: np.ndarray) -> np.ndarray:
    """Return the largest distance [T] mm of a vertex of [T, V, 3] m from its place in the first frame."""
    return 1e3 * np.linalg.norm(track - track[:1], axis=-1).max(axis=1)


def energies(experiment: Experiment, character: Character, track: np.ndarray, motion: Motion) -> np.ndarray:
    """Return `energies_of` a track with a frame for every frame of the motion."""
    return energies_of(experiment, character, track[1:-1], windows(motion))


def energies_of(experiment: Experiment, character: Character, track: np.ndarray, poses: Pose) -> np.ndarray:
    """Return the energy [T - 2] J stored in the cloth and in its motion at the steps of a track [T, V, 3] m.

    All terms except gravity, which has no natural zero.
    """
    state = reference.problem(experiment.scene, experiment.config)

    def energy(before, now, after, poses):
        step, _, _, advance = state(character, before, now, poses)
        terms = incremental_potential.energies(
            after + advance[None], step, experiment.scene.mesh, experiment.config.physics
        )
        return sum(value for name, value in terms.items() if name != "gravity")

    count = len(track) - 2
    windows_of_steps = jax.tree.map(lambda x: x[1 : 1 + count], poses)
    track = jnp.asarray(track)
    return np.asarray(
        jax.jit(lambda *a: jax.lax.map(lambda x: energy(*x), a))(track[:-2], track[1:-1], track[2:], windows_of_steps)
    )


def recovery_frames(relative: np.ndarray) -> int | None:
    """Return frames after the shock until energies [T] over undisturbed ones stay within `WITHIN`, or None."""
    first = BEFORE - 3  # the step whose end is the shock
    away = ~(np.abs(relative[first:] - 1.0) <= WITHIN)
    if away[-1]:
        return None
    return int(np.flatnonzero(away)[-1]) + 1 if away.any() else 0
