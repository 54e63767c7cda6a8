"""What makes Phi's descent short: the inverse of the Hessian that its potential has, on average, where cloth goes."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from clothjax.body import motion_clips
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.networks import animators, phi
from clothjax.physics import descent, incremental_potential
from clothjax.simulation import characters, rollout, time_step
from clothjax.simulation.scene import Scene
from clothjax.training import pool, sampling
from clothjax.types import Array

FRAMES = 16  # of the closed loops at whose ends the Hessian is taken


def measure(
    model: dict,
    scene: Scene,
    clips: Clips,
    config: Config,
    progress: Callable[[int], None] = lambda done: None,
    device_mesh: Mesh | None = None,
) -> np.ndarray:
    """The inverse mean Hessian [L, L] in 1/J at the ends of `model.descent_samples` short closed loops of Phi.

    Each is of its own clip, betas and material. Other than the Hessian at rest it knows what contact, tension and the
    weight of the body's turns make of the cloth. Directions in which a Hessian is negative count as flat.

    Args:
        model: Phi's `params`, with any preconditioner, and `statistics`.

    Raises:
        ValueError: if no loop stayed finite.
    """

    def sequence(key: Array, model: dict, clips: Clips) -> Array:
        simulation = pool.begin(key, scene, clips, config)
        character = pool.dressed(scene, simulation.betas, simulation.material, config)
        poses = motion_clips.there_and_back(clips, simulation.frame, FRAMES)
        _, states, latents = rollout.play(
            animators.phi_animator(model, scene, character, config), scene, character, poses, config
        )
        state, last = jax.tree.map(lambda x: x[-1], (states, poses))
        window = characters.window(scene, character, last)
        step = time_step.time_step(scene, character, state, window, 1.0 / config.fps, config)

        def energy(latent: Array) -> Array:
            new = phi.decode(model["params"]["garment"], scene, character, latent, window, config.model)
            return incremental_potential.potential(new, step, scene.mesh, config.physics)

        return descent.nearest_convex(descent.hessian(energy, latents[-1]))

    clips = jax.tree.map(jnp.asarray, clips)
    found = sampling.sample(
        sequence, (model, clips), config.model.descent_samples, config.stage1.seed, progress, device_mesh
    )
    good = np.isfinite(found).all(axis=(1, 2))
    if not good.any():
        raise ValueError(
            "no closed loop of an untrained Phi stayed finite: look at the garment on the body, or set "
            "model.descent_samples: 0 to descend by the Hessian at rest"
        )
    return np.asarray(descent.regularised_inverse(found[good].mean(axis=0), config.model.descent_damping))
