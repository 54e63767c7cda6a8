"""Preconditioner of Phi's descent: the inverse of its potential's mean Hessian over states of rollouts."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.networks import animators, phi
from clothjax.physics import descent, incremental_potential
from clothjax.simulation import characters, rollout, time_step
from clothjax.simulation.scene import Scene
from clothjax.training import pool, sampling
from clothjax.types import Array

FRAMES = 16  # of the rollouts; the Hessian is taken at their ends


def measure(
    model: dict,
    scene: Scene,
    clips: Clips,
    config: Config,
    progress: Callable[[int], None] = lambda _: None,
    device_mesh: Mesh | None = None,
    folder: Path | None = None,
) -> np.ndarray:
    """Measure the inverse mean Hessian [L, L] in 1/J at the ends of `model.descent_samples` short rollouts of Phi.

    Each rollout has its own clip, betas and material. Unlike the Hessian at rest, this one includes contact, tension
    and inertia of a moving body. Directions in which a Hessian is negative count as flat.

    Args:
        model: Phi's `params`, with any preconditioner, and `statistics`.
        progress: called with the number of rollouts done.
        device_mesh: each device rolls out a part of them.
        folder: where they are kept, and read, if they are there.

    Raises:
        ValueError: if no rollout stayed finite.
    """

    def sequence(key: Array, model: dict, clips: Clips) -> Array:
        character, poses = pool.draw(key, scene, clips, config, FRAMES)
        _, states, latents = rollout.play(
            animators.phi_animator(model, scene, character, config), scene, character, poses, config
        )
        state, last = jax.tree.map(lambda x: x[-1], (states, poses))
        window = characters.window(scene, character, last)
        step = time_step.time_step(scene, character, state, window, jnp.asarray(1.0 / config.fps), config)

        def energy(latent: Array) -> Array:
            new = phi.decode(model["params"]["garment"], scene, character, latent, window, config.model)
            return incremental_potential.potential(new, step, scene.mesh, config.physics)

        return descent.nearest_convex(descent.hessian(energy, latents[-1]))

    clips = jax.tree.map(jnp.asarray, clips)
    keys = sampling.keys(config.stage1.seed, config.model.descent_samples)
    hessians = sampling.make_sampler(sequence, device_mesh)(keys, (model, clips), progress, folder)
    good = np.isfinite(hessians).all(axis=(1, 2))
    if not good.any():
        raise ValueError(
            "no rollout of an untrained Phi stayed finite: look at the garment on the body, or set "
            "model.descent_samples: 0 to descend by the Hessian at rest"
        )
    return np.asarray(descent.regularised_inverse(hessians[good].mean(axis=0), config.model.descent_damping))
