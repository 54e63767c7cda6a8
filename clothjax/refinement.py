"""Psi refined in its own closed loop (DAgger, Ross et al. 2011), by the physics.

In rounds: Psi plays random clips on random bodies in random cloth, and in every frame some conjugate-gradient steps
down the potential, from the code that it predicts, find a better one. Psi learns to predict that, on the frames of all
rounds so far, as far as the codes differ in energy. So what it sees is what it will see in use, and what it learns
comes from the physics alone.
"""

import math
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from tqdm import tqdm

from clothjax import clips as motion
from clothjax import compact_latent, devices, fit, garment_model, latent_predictor, rollout, sampling, stage1, storage
from clothjax.character import Character, Window
from clothjax.clips import Clips
from clothjax.config import Config, RefinementConfig
from clothjax.fit import Weights
from clothjax.latent_predictor import Normalizers
from clothjax.losses import TimeStep
from clothjax.rollout import Animator
from clothjax.scene import Scene
from clothjax.types import Array, ClothState, Pose

LOST = 30.0  # times the median gain: cloth that has gone into the body, from where few steps do not find the way
ROBUST = 40.0  # times the median of a batch: the error from which on it counts by its root
PLAYED = 0.4  # of the steps, over which the rounds are spread
ROUNDS = "rounds"  # the folder of their files


class Frozen(NamedTuple):
    """What is not changed."""

    garment: dict  # decoder and blend shapes
    normalizers: Normalizers
    inverse: Array  # [L, L] in 1/J, an approximate inverse Hessian of codes, as Phi's descent has it


class Frames(NamedTuple):
    """Frames of Psi's closed loops, and what it should have predicted there, in standard deviations."""

    codes: Array  # [N, L] before the frame
    poses: Array  # [N, P] inputs
    constants: Array  # [N, C]
    better: Array  # [N, L] codes of the frame
    gain: Array  # [N] J, by how much they are better than those predicted


class TrainingState(NamedTuple):
    """All that the refinement is at a step, but for the frames, which are in files."""

    step: Array  # int32
    key: Array
    params: dict
    average: dict
    optimizer: optax.OptState


def init(predictor: dict, config: Config) -> TrainingState:
    """The state before the first step."""
    params = jax.tree.map(jnp.array, predictor)
    return TrainingState(
        step=jnp.int32(0),
        key=jax.random.key(config.refinement.seed),
        params=params,
        average=jax.tree.map(jnp.array, params),
        optimizer=optimizer(config).init(params),
    )


def optimizer(config: Config) -> optax.GradientTransformation:
    """Adam behind a clipped norm, at a rate that grows, is constant while Psi is played, then decays as a cosine."""
    settings = config.refinement
    played = int(PLAYED * settings.steps)
    decay = optax.cosine_decay_schedule(settings.learning_rate, max(1, settings.steps - played), alpha=0.01)
    grow = optax.linear_schedule(0.0, settings.learning_rate, played // 4)
    rate = optax.join_schedules([grow, optax.constant_schedule(settings.learning_rate), decay], [played // 4, played])
    return optax.chain(optax.clip_by_global_norm(settings.clip), optax.adam(rate, b2=0.99))


def make_rollout(scene: Scene, kept: np.ndarray, config: Config) -> Callable:
    """A function of a key, the predictor, `Frozen` and clips: the frames [T] of one closed loop of Psi.

    Args:
        kept: joints that are inputs.
    """
    settings = config.refinement

    def psi(predictor: dict, frozen: Frozen, character: Character) -> Animator:
        """Psi, of which `Frames` are seen."""
        scale = frozen.normalizers.latent
        constants = latent_predictor.constant_inputs(character.betas, character.material, config.material)

        def animate(state: ClothState, poses: Pose, window: Window, _step: TimeStep, potential: Callable):
            latent, inputs = latent_predictor.advance(
                predictor, state.latent, poses, character.joints, constants, scene.body.parents, kept,
                frozen.normalizers, config,
            )  # fmt: skip

            def garment(code):
                return compact_latent.decode({"garment": frozen.garment}, scene, character, code, window, config.model)

            code = latent_predictor.denormalise(scale, latent)
            new = garment(code)
            better = compact_latent.descend(
                lambda g: frozen.inverse @ g, code, garment, potential, settings.descent_steps,
                config.model.descent_bound,
            )  # fmt: skip
            gain = potential(new) - potential(garment(better))
            return new, code, Frames(*inputs, latent_predictor.normalise(scale, better), gain)

        return animate

    def sequence(key: Array, predictor: dict, frozen: Frozen, clips: Clips) -> Frames:
        simulation = stage1.begin(key, scene, clips, config)
        character = stage1.wearer(scene, simulation.betas, simulation.material, config)
        animate = psi(predictor, frozen, character)

        def frame(state, poses):
            taken, (_, _, seen) = rollout.take(animate, scene, character, state, poses, 1.0 / config.fps, config)
            return rollout.follow(taken, poses.translation[2]), seen

        poses = motion.there_and_back(clips, simulation.frame, settings.frames)
        return jax.lax.scan(frame, simulation.cloth, poses)[1]

    return sequence


def worth(frames: Frames) -> Frames:
    """Those of frames [N, T] from which there is something to learn, as [n]."""
    frames = Frames(*(np.asarray(x).reshape(-1, *x.shape[2:]) for x in frames))
    finite = np.isfinite(frames.gain) & np.isfinite(frames.better).all(axis=1)
    most = LOST * np.median(frames.gain[finite]) if finite.any() else 0.0
    chosen = Frames(*(x[finite & (np.abs(frames.gain) < most)] for x in frames))
    return chosen._replace(poses=chosen.poses.astype(np.float16))  # half of what there is to keep


def metric(frozen: Frozen, config: Config) -> Array:
    """The matrix M [L, L] in J such that an error e of a code, in standard deviations, costs e^T M e / 2.

    It is the Hessian of the energy, and `refinement.vertex_stiffness` for the mean squared displacement of vertices.
    """
    latent = frozen.normalizers.latent
    deviation = np.asarray(latent.deviation, np.float64)
    hessian = np.linalg.inv(np.asarray(frozen.inverse, np.float64)) * np.outer(deviation, deviation)
    weights = jax.jacobian(
        lambda code: garment_model.blend_weights(
            frozen.garment, latent_predictor.denormalise(latent, code), config.model
        )
    )(jnp.zeros(len(deviation)))
    shapes = np.asarray(frozen.garment["blendshapes"], np.float64)
    moved = np.asarray(weights, np.float64).T @ shapes.reshape(len(shapes), -1)
    squared = moved @ moved.T / shapes.shape[1]
    return jnp.asarray(hessian + 2.0 * config.refinement.vertex_stiffness * squared, jnp.float32)


def make_update(
    scene: Scene,
    clips: Clips,
    kept: np.ndarray,
    frozen: Frozen,
    config: Config,
    directory: Path,
    steps: int,
    device_mesh: Mesh | None = None,
) -> Callable[[TrainingState], tuple[TrainingState, dict[str, Array]]]:
    """A function that takes `steps` training steps, and their metrics [steps]; it consumes its argument.

    Where a round begins, it first plays Psi, or reads what an interrupted training has played. A batch, and what is
    played, is spread over the devices.

    Args:
        directory: of the rounds' files.
    """
    settings = config.refinement
    transform, cost = optimizer(config), metric(frozen, config)
    play = sampling.sampler(make_rollout(scene, kept, config), settings.sequences, device_mesh)
    frozen, clips = (devices.replicate(x, device_mesh) for x in (frozen, clips))
    begun = {number for number in range(settings.rounds) if _path(directory, number).exists()}
    turns, held = schedule(settings, steps), []
    size = settings.rounds * settings.sequences * settings.frames

    def played(number: int, average: dict) -> Frames:
        found = worth(play(settings.seed + 1 + number, (average, frozen, clips)))
        if not len(found.gain):
            raise ValueError("no closed loop of Psi stayed finite: train stage 2 further first")
        if jax.process_index() == 0:
            _write(_path(directory, number), found)
            gain = 1e3 * np.median(found.gain)
            tqdm.write(
                f"round {number + 1} of {settings.rounds}: of half its frames Psi is within {gain:.1f} mJ", sys.stdout
            )
        return found

    def data(number: int, average: dict) -> tuple[Frames, Array]:
        """The frames of all rounds so far, in arrays of one size, and how many there are."""
        for each in range(len(held), number + 1):
            if each < number and each not in begun:
                raise ValueError(f"{_path(directory, each)} is gone, and cannot be played again: remove {directory}")
            held.append(_read(_path(directory, each)) if each in begun else played(each, average))
        whole = Frames(*(np.concatenate(parts) for parts in zip(*held, strict=True)))
        count = len(whole.gain)
        padded = Frames(*(np.pad(x, [(0, size - count)] + [(0, 0)] * (x.ndim - 1)) for x in whole))
        return devices.replicate(padded, device_mesh), jnp.int32(count)

    def error(part: tuple[Array, Array], params: dict, frames: Frames, cost: Array):
        rows, noise = part
        batch = Frames(*(x[rows] for x in frames))
        return excess(params, batch._replace(codes=batch.codes + noise), cost, config)

    each = devices.shard(error, device_mesh)

    def one(frames: Frames, count: Array, state: TrainingState, _):
        keys = jax.random.split(jax.random.fold_in(state.key, state.step))
        rows = jax.random.randint(keys[0], (settings.batch,), 0, count)
        noise = settings.noise * jax.random.normal(keys[1], (settings.batch, frames.codes.shape[1]))

        def loss(params):
            found = each((rows, noise), params, frames, cost)
            return robust(found), found

        (value, found), gradient = jax.value_and_grad(loss, has_aux=True)(state.params)
        weights, metrics = fit.descend(
            transform, Weights(state.params, state.average, state.optimizer), value, gradient, settings.ema
        )
        metrics["excess"] = jnp.median(found)
        return state._replace(step=state.step + 1, **weights._asdict()), metrics

    @partial(jax.jit, donate_argnums=0, out_shardings=devices.replicated(device_mesh))
    def train(state, frames, count):
        return jax.lax.scan(partial(one, frames, count), state, None, length=steps)

    now = None

    def update(state: TrainingState):
        nonlocal now
        if int(state.step) == 0:
            begun.clear()  # what an earlier training, that came to nothing, may have played of other motions
        number = turns[int(state.step) // steps]
        if now is None or now[0] != number:
            now = (number, *data(number, state.average))
        return train(state, *now[1:])

    return update


def schedule(settings: RefinementConfig, steps: int) -> list[int]:
    """The round of every call of so many steps.

    There are steps in proportion to the frames of the rounds so far: more of few frames would be learnt by heart.
    """
    turns: list[int] = []
    for step in range(0, settings.steps, steps):
        number = min(int(settings.rounds * math.sqrt(step / (PLAYED * settings.steps))), settings.rounds - 1)
        turns.append(min(number, turns[-1] + 1) if turns else 0)
    return turns


def excess(params: dict, frames: Frames, cost: Array, config: Config) -> Array:
    """What the errors of predictions for frames [B] cost, [B] in J.

    Args:
        cost: of `metric`.
    """
    decay = config.stage2.latent_decay
    predicted = jax.vmap(lambda *row: latent_predictor.predict(params, *row, decay))(
        frames.codes, frames.poses.astype(jnp.float32), frames.constants
    )
    apart = predicted - frames.better
    return 0.5 * jnp.sum(apart * jnp.matmul(apart, cost), axis=-1)


def robust(energies: Array) -> Array:
    """The mean of energies [B] of errors in units of their median; of large ones their roots count.

    The errors of some frames are a thousand times those of others, and would be all that is learnt of.
    """
    unit = ROBUST * jnp.maximum(jax.lax.stop_gradient(jnp.median(energies)), 1e-12)
    return jnp.mean(2.0 * ROBUST * (jnp.sqrt(1.0 + energies / unit) - 1.0))


def _path(directory: Path, number: int) -> Path:
    return directory / ROUNDS / f"{number:03d}.npz"


def _write(path: Path, frames: Frames) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_suffix(".partial")
    with unfinished.open("wb") as file:
        np.savez(file, **frames._asdict())
    unfinished.replace(path)


def _read(path: Path) -> Frames:
    try:
        with np.load(path, allow_pickle=False) as file:
            return Frames(*(file[name] for name in Frames._fields))
    except storage.UNREADABLE as error:
        raise ValueError(f"{path} is damaged ({error}): remove {path.parents[1]}, and refine again") from error
