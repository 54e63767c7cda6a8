"""Labelled frames: where the descent would take states of Psi's own rollouts (DAgger, Ross et al. 2011)."""

import json
import zlib
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
from clothjax.networks import forces, phi, psi
from clothjax.networks.normalisation import ForceScales
from clothjax.physics import descent, incremental_potential
from clothjax.simulation import characters, rollout, time_step
from clothjax.simulation.scene import Scene
from clothjax.training import pool, sampling
from clothjax.types import Array, ClothState, Pose

NOISY = 0.2  # share of the frames whose code gets noise
WILD = (2.0, 0.2)  # a code of Psi's with more energy than so often the held one's, plus so many J, is not followed
LOST = 200.0  # J, from which on a frame is left out


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


class _Policy(NamedTuple):
    """Psi as labelling needs it."""

    params: dict
    scales: ForceScales
    garment: dict
    inverse_hessian: Array


def make_sequence(scene: Scene, config: Config) -> Callable:
    """Return a function that rolls out and labels a sequence of frames of a random clip, body and material.

    Its arguments are a random key, a `_Policy` and clips; it returns `Labels` of T frames.
    """
    settings = config.labels

    def sequence(key: Array, policy: _Policy, clips: Clips) -> Labels:
        begin_key, share_key, noise_key = jax.random.split(key, 3)
        simulation = pool.begin(begin_key, scene, clips, config)
        character = pool.dressed(scene, simulation.betas, simulation.material, config)
        constants = psi.constant_inputs(character.betas, character.material, config.material)
        share = jax.random.choice(share_key, jnp.array(settings.shares))
        whitening = policy.scales.whitening

        def precondition(gradient: Array) -> Array:
            return jnp.matmul(policy.inverse_hessian, gradient, precision="highest")

        def frame(state: ClothState, inputs: tuple[Pose, Array]) -> tuple[ClothState, Labels]:
            poses, key = inputs
            window = characters.window(scene, character, poses)
            step = time_step.time_step(scene, character, state, window, 1.0 / config.fps, config)
            held = state.latent

            def garment(code: Array) -> Array:
                return phi.decode(policy.garment, scene, character, code, window, config.model)

            def potential(new: Array) -> Array:
                return incremental_potential.potential(new, step, scene.mesh, config.physics)

            pulls = forces.reduced(garment, held, step, scene.mesh, config.physics)
            scales = policy.scales
            code = psi.next_code(policy.params, scales, held, state.change, pulls, constants, config.stage2)
            code = jnp.clip(code, scales.low, scales.high)
            starts = jnp.stack([held, held + state.change, code])
            energies = jax.lax.map(lambda z: potential(garment(z)), starts)
            begin = starts[jnp.argmin(jnp.where(jnp.isnan(energies), jnp.inf, energies))]
            target, _ = descent.converge(
                precondition, begin, garment, potential, settings.descent_steps, phi.DESCENT_BOUND, settings.tolerance
            )
            labels = Labels(
                held, state.change, pulls, constants, target, energies[0], energies[2], potential(garment(target))
            )
            wild = ~(energies[2] < WILD[0] * energies[0] + WILD[1])
            taken = target + jnp.where(wild, 0.0, share * (code - target))
            keys = jax.random.split(key, 3)
            length = settings.noise * jax.random.uniform(keys[0]) / np.sqrt(len(held), dtype=np.float32)
            length = jnp.where(jax.random.uniform(keys[1]) < NOISY, length, 0.0)
            taken += jnp.matmul(length * jax.random.normal(keys[2], held.shape), whitening.back, precision="highest")
            new = garment(taken)
            velocity = new - state.position
            state = ClothState(new, velocity, velocity - state.velocity, taken, taken - held)
            return rollout.follow(state, poses.translation[2]), labels

        poses = motion_clips.there_and_back(clips, simulation.frame, settings.frames)
        return jax.lax.scan(frame, simulation.cloth, (poses, jax.random.split(noise_key, settings.frames)))[1]

    return sequence


def collect(
    params: dict,
    scales: ForceScales,
    garment: dict,
    inverse_hessian: Array,
    scene: Scene,
    clips: Clips,
    config: Config,
    seed: int,
    progress: Callable[[int], None] = lambda _: None,
    device_mesh: Mesh | None = None,
) -> Labels:
    """Label the frames of a round's rollouts; those in which the cloth is lost are left out.

    Args:
        params, scales: of the Psi that moves the garment.
        garment: parameters of the decoder.
        inverse_hessian: [L, L] in 1/J, the preconditioner of the descent.
        seed: of the round.
        progress: called with the number of rollouts done.
        device_mesh: each device takes a part of the rollouts.

    Raises:
        ValueError: if no frame is left.
    """
    policy = _Policy(params, scales, garment, inverse_hessian)
    arguments = (policy, jax.tree.map(jnp.asarray, clips))
    rounds = sampling.sample(
        make_sequence(scene, config), arguments, config.labels.sequences, seed, progress, device_mesh, together=1
    )
    flat = Labels(*(part.reshape(-1, *part.shape[2:]) for part in rounds))
    good = np.all([np.isfinite(part.reshape(len(part), -1)).all(axis=1) for part in flat], axis=0) & (flat.least < LOST)
    if not good.any():
        raise ValueError("no frame could be labelled: train stage 1 further before stage 2")
    return Labels(*(part[good] for part in flat))


def fingerprint(settings: dict, params: dict) -> int:
    """Return a number that tells labels of other settings, or of another Phi, apart.

    Args:
        settings: those that labels depend on, as `configuration.to_dict` gives them.
        params: of Phi.
    """
    leaves = jax.tree.leaves((params["garment"], params["inverse_hessian"]))
    return zlib.crc32(b"".join([json.dumps(settings).encode(), *(np.asarray(leaf).tobytes() for leaf in leaves)]))


def save(labels: Labels, path: Path, of: int) -> None:
    """Write labels to a file with their `fingerprint`, whole or not at all."""
    partial = path.with_name(f".{path.name}")
    with partial.open("wb") as file:
        np.savez(file, **labels._asdict(), of=of)
    partial.replace(path)


def load(paths: list[Path], of: int) -> Labels:
    """Read the labels of several files as one.

    Raises:
        ValueError: for a file that is missing, damaged or of another `fingerprint`.
    """
    parts = []
    for path in paths:
        try:
            with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                same = int(file["of"]) == of
                parts.append(Labels(*(file[name] for name in Labels._fields)))
        except damage.UNREADABLE as error:
            raise ValueError(f"{path}: not readable labels ({error}); remove {path.parent} to begin anew") from error
        if not same:
            raise ValueError(f"{path}: of other settings or of another Phi; remove {path.parent} to begin anew")
    return Labels(*(np.concatenate(each) for each in zip(*parts, strict=True)))
