"""Fine-tuning: Psi trained further after its regression, by the physics of its own autoregressive rollouts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body.motion_clips import Clips
from clothjax.config import Config, PhysicsTrainingConfig, Ramp, Stage1Config
from clothjax.networks import normalisation
from clothjax.networks.animators import MakeAnimator, Preconditioners, force_psi_animator, psi_animator
from clothjax.networks.normalisation import ForceScales, Normalizers
from clothjax.networks.psi import input_joints
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.scene import Scene
from clothjax.training import stage1, stage2
from clothjax.types import Array

DAMPING = 1e-3  # added to variances of normalised pose inputs; half of them are smaller


def settings(config: Config) -> Config:
    """Return the configuration with fine-tuning in the place of stage 1.

    Bodies are drawn as in stage 1; loss weights stay at their last values.
    """
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
    """Return the state before the first training step of fine-tuning.

    Args:
        predictor: parameters of the latent predictor after stage 2.
    """
    key, pool_key = jax.random.split(jax.random.key(config.tuning.seed))
    clips = jax.tree.map(jnp.asarray, clips)
    return stage1.initial_state(jax.tree.map(jnp.array, predictor), {}, key, pool_key, scene, clips, settings(config))


def pose_preconditioner(poses: np.ndarray, power: float) -> Array:
    """Compute the matrix [P, P] for gradients of Psi's first layer: the inverse covariance of pose inputs, to a power.

    The three frames of a window are much alike: velocities and accelerations make up a thousandth or less of the
    variance of the inputs, and are learnt late without this. The matrix preserves the mean square of the inputs.

    Args:
        poses: [n, P] pose inputs, normalised.
        power: `tuning.preconditioning`.
    """
    covariance = np.cov(np.asarray(poses, np.float64).T)
    values, vectors = np.linalg.eigh(covariance)
    scale = (np.maximum(values, 0.0) + DAMPING) ** -power
    matrix = (vectors * scale) @ vectors.T
    return jnp.asarray(matrix * np.sqrt(np.trace(covariance) / np.trace(matrix @ covariance @ matrix)), jnp.float32)


def code_preconditioner(inverse: np.ndarray, normalizers: Normalizers, power: float) -> Array:
    """Compute the matrix [L, L] for gradients of normalised codes: Phi's inverse Hessian to a power, at unit scale.

    Args:
        inverse: [L, L] in 1/J, the inverse Hessian of codes that are not normalised.
        power: `tuning.preconditioning`.
    """
    deviation = np.asarray(normalizers.latent.deviation, np.float64)
    values, vectors = np.linalg.eigh(np.asarray(inverse, np.float64) / np.outer(deviation, deviation))
    values = np.maximum(values, 1e-12 * values[-1]) ** power
    return jnp.asarray((vectors * values / np.sqrt(np.mean(values**2))) @ vectors.T, jnp.float32)


def animator(
    experiment: Experiment, clips: Clips, phi: dict, garment: dict, normalizers: Normalizers | ForceScales
) -> MakeAnimator:
    """Return what makes the Psi that is fine-tuned an animator, with the preconditioners of its gradients.

    Args:
        phi: parameters of Phi.
        garment: parameters of the decoder.
        normalizers: of Psi; `ForceScales` are those of a Psi with forces, whose whitening preconditions it in place of
            `tuning.preconditioning`.
    """
    if isinstance(normalizers, ForceScales):
        return force_psi_animator(garment, normalizers)
    joints = input_joints(experiment.names, experiment.config.stage2)
    return psi_animator(garment, normalizers, joints, preconditioners(experiment, clips, phi, normalizers, joints))


def preconditioners(
    experiment: Experiment, clips: Clips, phi: dict, normalizers: Normalizers, input_joints: np.ndarray
) -> Preconditioners | None:
    """Build the matrices that gradients of fine-tuning are multiplied by; None if `tuning.preconditioning` is 0.

    Args:
        phi: parameters of Phi, of which the inverse Hessian is used.
        input_joints: [Jk] indices of the joints that are inputs.
    """
    config, power = experiment.config, experiment.config.tuning.preconditioning
    if power == 0:
        return None
    poses = stage2.ordinary_poses(experiment.scene, clips, input_joints, config)
    poses = jax.vmap(normalisation.normalise, (None, 0))(normalizers.pose, poses)
    inverse = phi.get("inverse_hessian")
    return Preconditioners(
        pose=pose_preconditioner(np.asarray(poses), power),
        code=None if inverse is None else code_preconditioner(inverse, normalizers, power),
    )
