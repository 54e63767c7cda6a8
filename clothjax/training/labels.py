"""Labelled frames: where the descent takes the states of simulations that Psi moves (DAgger, Ross et al. 2011)."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from clothjax.body import motion_clips
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.files import damage
from clothjax.material import unscaled
from clothjax.networks import animators, phi, psi
from clothjax.networks.normalisation import ForceScales
from clothjax.physics import descent, incremental_potential, kernels
from clothjax.physics.energies import GRAVITY
from clothjax.simulation import characters, rollout, time_step
from clothjax.simulation.characters import Window
from clothjax.simulation.scene import Scene
from clothjax.training import pool, run_folder, sampling
from clothjax.training.pool import Simulation
from clothjax.types import Array, ClothState, Pose

NOISY = 0.2  # share of the frames whose code gets noise
WILD = (2.0, 0.2)  # a code of Psi's with more energy than so often the held one's, plus so many J, is not followed
LOST = 200.0  # J, from which on a frame is left out
BOUND = 1.0  # length of a descent step, in units of the code: labels are up to 14 away, and have no time for short ones
ON_GPU = 1024  # simulations in one program; 2 GB for a garment of 1 000 vertices
STILL = 0.15  # share of the simulations whose body holds its pose in a round: Psi must come to rest
SAME = 0.85  # share of what Psi's code lacked in the last frame that a label also tries to start with
PUSHED = 0.15  # share of the simulations that an external acceleration pushes in a round
ALIKE = 0.3  # share of the simulations whose cloth is mostly soft in all respects or stiff in all: few draws are either


class Labels(NamedTuple):
    """Labelled frames: what Psi sees [n, ...], and where the descent goes."""

    code: Array  # [n, L] held
    change: Array  # [n, L] in the last frame
    forces: Array  # [n, kinds, L] J
    constants: Array  # [n, C]
    target: Array  # [n, L] the code at the end of the descent
    held: Array  # [n] J, energy of the held code, ...
    predicted: Array  # [n] J, ... of Psi's ...
    least: Array  # [n] J, ... and of the target

    def gap(self) -> float:
        """Return the median of Psi's hold gap over frames: 0 the descent's end, 1 persistence."""
        return float(np.median((self.predicted - self.least) / np.maximum(self.held - self.least, 1e-6)))


class Round(NamedTuple):
    """Result of a round of labelling."""

    simulations: Simulation  # leaves [N, ...], where the next round goes on
    labels: Labels


class Policy(NamedTuple):
    """The Psi that moves the garment while it is labelled, and the teacher's preconditioner."""

    params: dict
    scales: ForceScales
    garment: dict  # parameters of the decoder
    inverse_hessian: Array  # [L, L] in 1/J


def begin(scene: Scene, clips: Clips, config: Config) -> Simulation:
    """Return the simulations of the first round, leaves [N, ...]."""
    keys = sampling.keys(config.labels.seed, config.labels.simulations)
    clips = jax.tree.map(jnp.asarray, clips)
    return jax.device_get(jax.jit(jax.vmap(lambda key: begin_one(key, scene, clips, config)))(keys))


def begin_one(key: Array, scene: Scene, clips: Clips, config: Config) -> Simulation:
    """Return a new simulation as of `pool.begin`, more often of soft or of stiff cloth."""
    simulation = pool.begin(key, scene, clips, config)
    alike_key, share_key = jax.random.split(jax.random.fold_in(key, 1))
    alike = (jax.random.uniform(alike_key) < ALIKE) & config.material.sample
    share = jnp.sin(0.5 * jnp.pi * jax.random.uniform(share_key)) ** 2  # mostly near 0 or 1
    drawn, cloth = simulation.material, config.material
    limits = {"mu": cloth.mu_range, "lam": cloth.lam_range, "bending": cloth.bending_range}
    of_share = drawn._replace(**{name: unscaled(share, limit) for name, limit in limits.items()})
    return simulation._replace(material=jax.tree.map(lambda x, y: jnp.where(alike, x, y), of_share, drawn))


def make_segment(scene: Scene, config: Config) -> Callable:
    """Return a function that moves a simulation on by some frames and labels them.

    Its arguments are a random key with a `Simulation`, a `Policy` and clips; it returns a `Round` of T frames.
    """
    settings = config.labels

    def segment(one: tuple[Array, Simulation], policy: Policy, clips: Clips) -> Round:
        key, simulation = one
        share_key, noise_key, external_key, new_key, renew_key, still_key = jax.random.split(key, 6)
        character = pool.dressed(scene, simulation.betas, simulation.material, config)
        constants = psi.constant_inputs(character.betas, character.material, config.material)
        scales = policy.scales
        # a Psi that has learnt nothing yet does not move the garment
        share = jnp.where(scales.output > 0, jax.random.choice(share_key, jnp.array(settings.shares)), 0.0)
        stride = jnp.where(share < 1, 1, settings.stride)
        external = draw_external(external_key, settings.external)

        def precondition(gradient: Array) -> Array:
            return jnp.matmul(policy.inverse_hessian, gradient, precision="highest")

        def predicted(state: ClothState, poses: Pose) -> tuple[Window, Array, Array]:
            window = characters.window(scene, character, poses)
            pulls = animators.forces_on_code(policy.garment, scene, character, state, window, config, external)
            code = psi.next_code(policy.params, scales, state.latent, state.change, pulls, constants, config.stage2)
            return window, pulls, jnp.clip(code, scales.low, scales.high)

        def decoded(code: Array, window: Window) -> Array:
            return phi.decode(policy.garment, scene, character, code, window, config.model)

        def moved(state: ClothState, code: Array, window: Window, poses: Pose, key: Array) -> ClothState:
            keys = jax.random.split(key, 3)
            length = settings.noise * jax.random.uniform(keys[0]) / np.sqrt(len(code), dtype=np.float32)
            length = jnp.where(jax.random.uniform(keys[1]) < NOISY, length, 0.0)
            noise = length * jax.random.normal(keys[2], code.shape)
            code += jnp.matmul(noise, scales.whitening.back, precision="highest")
            new = decoded(code, window)
            velocity = new - state.position
            state = ClothState(new, velocity, velocity - state.velocity, code, code - state.latent)
            return rollout.follow(state, poses.translation[2])

        def unlabelled(index: Array, carry: tuple[ClothState, Array]) -> tuple[ClothState, Array]:
            state, key = carry
            poses = jax.tree.map(lambda x: x[index], windows)
            window, _, code = predicted(state, poses)
            return moved(state, code, window, poses, jax.random.fold_in(key, index)), key

        def labelled(
            carry: tuple[ClothState, Array], inputs: tuple[Array, Array]
        ) -> tuple[tuple[ClothState, Array], Labels]:
            (state, lag), (number, key) = carry, inputs
            last = (number + 1) * stride - 1
            state, _ = jax.lax.fori_loop(number * stride, last, unlabelled, (state, key))
            poses = jax.tree.map(lambda x: x[last], windows)
            window, pulls, code = predicted(state, poses)
            step = time_step.time_step(scene, character, state, window, 1.0 / config.fps, config, external)
            held = state.latent

            def garment(code: Array) -> Array:
                return decoded(code, window)

            def potential(new: Array) -> Array:
                return incremental_potential.potential(new, step, scene.mesh, config.physics)

            starts = jnp.stack([held, held + state.change, code, code + SAME * lag])
            energies = jax.lax.map(lambda z: potential(garment(z)), starts)
            start = starts[jnp.argmin(jnp.where(jnp.isnan(energies), jnp.inf, energies))]
            target, _ = descent.converge(
                precondition, start, garment, potential, settings.descent_steps, BOUND, settings.tolerance
            )
            labels = Labels(
                held, state.change, pulls, constants, target, energies[0], energies[2], potential(garment(target))
            )
            wild = ~(energies[2] < WILD[0] * energies[0] + WILD[1])
            taken = target + jnp.where(wild, 0.0, share * (code - target))
            return (moved(state, taken, window, poses, jax.random.fold_in(key, last)), target - code), labels

        still = jax.random.uniform(still_key) < STILL
        count = settings.frames * settings.stride
        windows = motion_clips.there_and_back(clips, simulation.frame, count)
        stood = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (count, *x.shape)),
            motion_clips.standing(motion_clips.poses(clips, simulation.frame)),
        )
        stood = jax.tree.map(lambda x, y: x.at[0, 0].set(y[0, 0]), stood, windows)  # it has just come to a stop
        windows = jax.tree.map(lambda x, y: jnp.where(still, x, y), stood, windows)
        keys = jax.random.split(noise_key, settings.frames)
        begun = simulation.cloth, jnp.zeros_like(simulation.cloth.latent)
        (cloth, _), labels = jax.lax.scan(labelled, begun, (jnp.arange(settings.frames), keys))
        passed = settings.frames * stride
        goes_on = (
            jnp.all(usable(labels))
            & (clips.remaining[simulation.frame] > 2 * passed)
            & (jax.random.uniform(renew_key) > settings.renewed)
        )
        later = simulation._replace(cloth=cloth, frame=simulation.frame + jnp.where(still, 0, passed))
        new = begin_one(new_key, scene, clips, config)
        return Round(jax.tree.map(lambda x, y: jnp.where(goes_on, x, y), later, new), labels)

    return segment


def draw_external(key: Array, most: float) -> Array:
    """Draw an external acceleration [3] m/s^2: mostly none, else no weight, gravity in any direction, or wind.

    Args:
        most: m/s^2, of wind; 0 for none of all.
    """
    kind_key, direction_key, length_key = jax.random.split(key, 3)
    direction = jax.random.normal(direction_key, (3,))
    direction = direction / jnp.linalg.norm(direction)
    weightless = jnp.array([0.0, min(most, GRAVITY), 0.0])
    turned = weightless + min(most, GRAVITY) * direction
    wind = most * jax.random.uniform(length_key) * direction
    kind = jax.random.uniform(kind_key) / PUSHED
    pushed = jnp.where(kind < 0.2, weightless, jnp.where(kind < 0.5, turned, wind))
    return jnp.where(kind < 1.0, pushed, 0.0)


def usable(labels: Labels) -> Array:
    """Return which of the labels [n] are finite, of cloth that is not lost."""
    finite = [jnp.all(jnp.isfinite(part).reshape(len(part), -1), axis=1) for part in labels]
    return jnp.all(jnp.stack(finite), axis=0) & (labels.least < LOST)


def make_collect(
    scene: Scene, clips: Clips, config: Config, device_mesh: Mesh | None = None
) -> Callable[[Policy, Simulation, int, Callable[[int], None]], Round]:
    """Return a function that labels a round of frames on the simulations of the last, compiled once.

    Its arguments are a `Policy`, the simulations, the seed of the round, and a function to call with the number of
    simulations done. The labels are flat, [n, ...]; usable frames again take the place of the others. It raises a
    ValueError if none is usable.

    Args:
        device_mesh: each device takes a part of the simulations.
    """
    sample = sampling.make_sampler(kernels.in_kernels(make_segment(scene, config)), device_mesh, elsewhere=ON_GPU)
    clips = jax.tree.map(jnp.asarray, clips)

    def collect(policy: Policy, simulations: Simulation, seed: int, progress: Callable[[int], None]) -> Round:
        keys = sampling.keys(seed, len(simulations.frame))
        policy = jax.device_get(policy)  # one from a checkpoint would be compiled for again
        simulations, labels = sample((keys, simulations), (policy, clips), progress)
        flat = Labels(*(part.reshape(-1, *part.shape[2:]) for part in labels))
        (good,) = np.nonzero(np.asarray(usable(flat)))
        if len(good) == 0:
            raise ValueError("no frame could be labelled: train stage 1 further before stage 2")
        rows = good[np.arange(len(flat.code)) % len(good)]
        return Round(simulations, Labels(*(part[rows] for part in flat)))

    return collect


def save(finished: Round, path: Path, of: int) -> None:
    """Write a round to a file with its `fingerprint`, whole or not at all."""
    leaves = {f"simulations_{i}": leaf for i, leaf in enumerate(jax.tree.leaves(finished.simulations))}
    with run_folder.whole(path) as file:
        np.savez(file, **finished.labels._asdict(), **leaves, of=of)


def load(path: Path, of: int, like: Simulation) -> Round:
    """Read a round from its file.

    Args:
        like: simulations, of which the structure is used.

    Raises:
        ValueError: for a file that is missing, damaged or of another `fingerprint`.
    """
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            same = int(file["of"]) == of
            labels = Labels(*(file[name] for name in Labels._fields))
            leaves = [file[f"simulations_{i}"] for i in range(len(jax.tree.leaves(like)))]
    except damage.UNREADABLE as error:
        raise ValueError(f"{path}: not readable labels ({error}); remove {path.parent} to begin anew") from error
    if not same:
        raise ValueError(f"{path}: of other settings or of another Phi; remove {path.parent} to begin anew")
    return Round(jax.tree.unflatten(jax.tree.structure(like), leaves), labels)
