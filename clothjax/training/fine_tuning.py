"""Psi after its regression, trained on by the physics of its own closed loop."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body.motion_clips import Clips
from clothjax.config import Config, PhysicsTrainingConfig, Ramp, Stage1Config
from clothjax.networks import normalisation
from clothjax.networks.animators import Preconditioners
from clothjax.networks.normalisation import Normalizers
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.scene import Scene
from clothjax.training import stage1, stage2
from clothjax.types import Array

DAMPING = 1e-3  # variances of normalised pose inputs; along half of their axes poses differ less


def settings(config: Config) -> Config:
    """The configuration with that of the tuning in the place of stage 1's: for its bodies, at its last loss weights."""
    names = [field.name for field in dataclasses.fields(PhysicsTrainingConfig)]
    shared = {name: getattr(config.tuning, name) for name in names}
    stage = Stage1Config(**shared, betas=config.stage1.betas, start_timestep=0.0)
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
    return stage1.initial_state(jax.tree.map(jnp.array, predictor), {}, key, pool_key, scene, clips, settings(config))


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
    poses = jax.vmap(normalisation.normalise, (None, 0))(normalizers.pose, poses)
    inverse = phi.get("inverse_hessian")
    return Preconditioners(
        pose=pose_preconditioner(poses, power),
        code=None if inverse is None else code_preconditioner(inverse, normalizers, power),
    )
