"""Psi after its regression, trained on by the physics of its own closed loop."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import compact_latent, latent_predictor, stage1, stage2
from clothjax.character import Character, Window
from clothjax.clips import Clips
from clothjax.config import Config, Ramp, Stage1Config
from clothjax.experiment import Experiment
from clothjax.graph_network import Params
from clothjax.latent_predictor import Normalizers
from clothjax.losses import TimeStep
from clothjax.rollout import Animator, MakeAnimator
from clothjax.scene import Scene
from clothjax.types import Array, ClothState, Pose

DAMPING = 1e-3  # variances of normalised pose inputs; along half of their axes poses differ less


class Preconditioners(NamedTuple):
    """What gradients are multiplied by where they enter Psi and where they leave it: a Kronecker-factored
    preconditioner (Martens and Grosse 2015) of its first layer's inputs and its last layer's outputs."""

    pose: Array  # [P, P] of normalised pose inputs
    code: Array | None  # [L, L] of normalised codes


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


def learning_from(params: Params, inputs: Array) -> Params:
    """The same predictor, whose first layer gets its gradient as if it had been given other inputs [N]."""
    first, still = params["dense_0"], jax.lax.stop_gradient
    outputs = still(inputs) @ first["kernel"]
    return params | {"dense_0": {"kernel": still(first["kernel"]), "bias": first["bias"] + (outputs - still(outputs))}}


def pose_preconditioner(poses: np.ndarray, power: float) -> Array:
    """The matrix [P, P] for gradients by normalised pose inputs [n, P]: their inverse covariance to a power.

    The three frames of a window are much alike: what tells velocities and accelerations is a thousandth and less of the
    variance of the inputs, and without this is learnt late. Multiplied, inputs have the mean square that they had.
    """
    covariance = np.cov(np.asarray(poses, np.float64).T)
    values, vectors = np.linalg.eigh(covariance)
    scale = (np.maximum(values, 0.0) + DAMPING) ** -power
    matrix = (vectors * scale) @ vectors.T
    return jnp.asarray(matrix * np.sqrt(np.trace(covariance) / np.trace(matrix @ covariance @ matrix)), jnp.float32)


def code_preconditioner(inverse: np.ndarray, normalizers: Normalizers, power: float) -> Array:
    """The matrix [L, L] for gradients of normalised codes: an inverse Hessian to a power, without its scale.

    Args:
        inverse: [L, L] in 1/J, of codes as they are.
    """
    deviation = np.asarray(normalizers.latent.deviation, np.float64)
    values, vectors = np.linalg.eigh(np.asarray(inverse, np.float64) / np.outer(deviation, deviation))
    values = np.maximum(values, 1e-12 * values[-1]) ** power
    return jnp.asarray((vectors * values / np.sqrt(np.mean(values**2))) @ vectors.T, jnp.float32)


def preconditioners(
    experiment: Experiment, reel: Clips, phi: dict, normalizers: Normalizers, kept: np.ndarray
) -> Preconditioners | None:
    """As configured, by the poses of a reel and the inverse Hessian of the descent of a Phi of these parameters."""
    config, power = experiment.config, experiment.config.tuning.preconditioning
    if power == 0:
        return None
    poses = stage2.ordinary_poses(experiment.scene, reel, kept, config)
    poses = jax.vmap(latent_predictor.normalise, (None, 0))(normalizers.pose, poses)
    inverse = phi.get("inverse_hessian")
    return Preconditioners(
        pose=pose_preconditioner(poses, power),
        code=None if inverse is None else code_preconditioner(inverse, normalizers, power),
    )


def psi(
    garment: dict, normalizers: Normalizers, kept: np.ndarray, gradients: Preconditioners | None = None
) -> MakeAnimator:
    """Psi, of `params`, as what moves a character's garment: with a frozen decoder, on the joints `kept`.

    Codes are brought into their range as in use; gradients pass as if none had been out of it.
    """

    def make(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
        constants = latent_predictor.constant_inputs(character.betas, character.material, config.material)

        def animate(state: ClothState, poses: Pose, window: Window, _step: TimeStep, _potential: Callable):
            params = model["params"]
            pose = latent_predictor.window_inputs(poses, character.joints, scene.body.parents, kept, config.fps)
            pose = latent_predictor.normalise(normalizers.pose, pose)
            now = latent_predictor.normalise(normalizers.latent, state.latent)
            if gradients is not None:
                params = learning_from(params, jnp.concatenate([now, gradients.pose @ pose, constants]))
            latent = latent_predictor.predict(params, now, pose, constants, config.stage2.latent_decay)
            inside, _ = latent_predictor.bounded(latent, normalizers.latent.low, normalizers.latent.high)
            latent += jax.lax.stop_gradient(inside - latent)
            shown = latent
            if gradients is not None and gradients.code is not None:
                shown = precondition(gradients.code, latent)
            code, shown = (latent_predictor.denormalise(normalizers.latent, z) for z in (latent, shown))
            new = compact_latent.decode({"garment": garment}, scene, character, shown, window, config.model)
            return new, code, None

        return animate

    return make
