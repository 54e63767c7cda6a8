"""Psi after its regression, trained on by the physics of its own closed loop."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import compact_latent, latent_predictor, stage1
from clothjax.character import Character, Window
from clothjax.clips import Clips
from clothjax.config import Config, Ramp, Stage1Config
from clothjax.latent_predictor import Normalizers
from clothjax.losses import TimeStep
from clothjax.rollout import Animator, MakeAnimator
from clothjax.scene import Scene
from clothjax.types import Array, ClothState, Pose


def settings(config: Config) -> Config:
    """The configuration with that of the tuning in the place of stage 1's: for its bodies, at its last loss weights."""
    names = [field.name for field in dataclasses.fields(Stage1Config)]
    stage = Stage1Config(**{name: getattr(config.tuning, name) for name in names} | {"betas": config.stage1.betas})
    ramps = {field.name: getattr(config.loss, field.name) for field in dataclasses.fields(config.loss)}
    last = {
        name: Ramp(ramp.start if ramp.end is None else ramp.end)
        for name, ramp in ramps.items()
        if isinstance(ramp, Ramp)
    }
    return dataclasses.replace(config, stage1=stage, loss=dataclasses.replace(config.loss, **last))


def init(predictor: dict, scene: Scene, clips: Clips, config: Config) -> stage1.TrainingState:
    """The state before the first step."""
    key, pool_key = jax.random.split(jax.random.key(config.tuning.seed))
    clips = jax.tree.map(jnp.asarray, clips)
    return stage1.starting(jax.tree.map(jnp.array, predictor), {}, key, pool_key, scene, clips, settings(config))


@jax.custom_vjp
def precondition(matrix: Array, code: Array) -> Array:
    """The same code [L], whose gradient is multiplied by a symmetric matrix [L, L]."""
    return code


precondition.defvjp(lambda matrix, code: (code, matrix), lambda matrix, g: (jnp.zeros_like(matrix), matrix @ g))


def preconditioner(inverse: np.ndarray, normalizers: Normalizers, power: float) -> Array:
    """The matrix [L, L] for gradients of normalised codes: an inverse Hessian to a power, without its scale.

    Args:
        inverse: [L, L] in 1/J, of codes as they are.
    """
    deviation = np.asarray(normalizers.latent.deviation, np.float64)
    values, vectors = np.linalg.eigh(np.asarray(inverse, np.float64) / np.outer(deviation, deviation))
    values = np.maximum(values, 1e-12 * values[-1]) ** power
    return jnp.asarray((vectors * values / np.sqrt(np.mean(values**2))) @ vectors.T, jnp.float32)


def psi(
    garment: dict, normalizers: Normalizers, kept: np.ndarray, inverse: np.ndarray | None = None, power: float = 0.0
) -> MakeAnimator:
    """Psi, of `params`, as what moves a character's garment: with a frozen decoder, on the joints `kept`.

    Args:
        inverse: the inverse Hessian [L, L] of Phi's descent, whose `power` preconditions the gradients of codes.
    """
    matrix = None if inverse is None or power == 0 else preconditioner(inverse, normalizers, power)

    def make(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
        constants = latent_predictor.constant_inputs(character.betas, character.material, config.material)

        def animate(state: ClothState, poses: Pose, window: Window, _step: TimeStep, _potential: Callable):
            latent = latent_predictor.advance(
                model["params"], state.latent, poses, character.joints, constants, scene.body.parents, kept,
                normalizers, config,
            )  # fmt: skip
            shown = latent if matrix is None else precondition(matrix, latent)
            code, shown = (latent_predictor.denormalise(normalizers.latent, z) for z in (latent, shown))
            new = compact_latent.decode({"garment": garment}, scene, character, shown, window, config.model)
            return new, code, None

        return animate

    return make
