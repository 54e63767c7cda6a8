"""Psi's network: the next latent code from the current one and what a game engine knows (method section 5)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import features, rotation, skinning
from clothjax.config import MaterialConfig, Stage2Config
from clothjax.features import Statistics
from clothjax.graph_network import Params, init_mlp, mlp
from clothjax.types import Array, Material

POSE_BOUND = 10.0  # standard deviations beyond which a pose input tells nothing that training has seen


class Normalizers(NamedTuple):
    """Statistics of the predictor's inputs and outputs over the teacher's rollouts."""

    latent: Statistics  # [L]
    pose: Statistics  # [P]


def kept_joints(names: tuple[str, ...], config: Stage2Config) -> np.ndarray:
    """Indices of the joints that are inputs: all but hands, fingers and toes, which move no garment."""
    kept = [i for i, name in enumerate(names) if not any(word in name for word in config.excluded_joints)]
    return np.array(kept, np.int32)


def pose_inputs(
    rotations: Array, advance: Array, joints: Array, parents: np.ndarray, kept: np.ndarray, fps: float
) -> Array:
    """What X_c holds of the motion, [6 + 3 * 6 * Jk + 3 * 3 * (Jk - 1)], without place or heading.

    Args:
        rotations: [3, J, 3, 3] local, at t + 1, t, t - 1.
        advance: [2, 3] m, the root's steps t -> t + 1 and t - 1 -> t.
        joints: [J, 3] m canonical; parents: [J] static; kept: joint indices, the root first.
        fps: frames a second.

    The heading at t is removed from all three frames, so that turning is seen and facing is not.
    """
    root = int(kept[0])
    turn = rotation.heading(rotations[1, root]).T
    velocity = jnp.einsum("ab,nb->na", turn, advance, precision="highest") * fps
    local = rotations.at[:, root].set(jnp.matmul(turn[None], rotations[:, root], precision="highest"))
    codes = rotation.to_6d(local[:, kept])
    _, positions = jax.vmap(lambda turns: skinning.forward_kinematics(turns, joints, parents))(local)
    relative = positions[:, kept[1:]] - positions[:, None, root]
    return jnp.concatenate([velocity.reshape(-1), codes.reshape(-1), relative.reshape(-1)])


def constant_inputs(betas: Array, material: Material, config: MaterialConfig) -> Array:
    """Betas [S] and the material scaled to [0, 1]: what does not change while a character wears a garment."""
    density = features.scaled(material.density, config.density_range)
    return jnp.concatenate([betas, density[None], features.material_inputs(material, config)])


def init(key: Array, latent: int, pose: int, constants: int, config: Stage2Config) -> Params:
    """Parameters of the predictor; its last layer starts small, so that it first keeps the code as it is."""
    sizes = (latent + pose + constants, *config.hidden, latent)
    return init_mlp(key, sizes, norm=False, last_gain=0.01)


def predict(params: Params, latent: Array, pose: Array, constants: Array, decay: float) -> Array:
    """The next latent code [L] in standard deviations, from the current one and normalised inputs.

    A part `decay` of the code is forgotten unless the network gives it back, so that no direction of the code drifts.
    """
    return (1.0 - decay) * latent + mlp(params, jnp.concatenate([latent, pose, constants]))


def normalise(statistics: Statistics, row: Array, bound: float = jnp.inf) -> Array:
    """A row [N] in standard deviations from the mean, clipped to `bound` of them."""
    return jnp.clip((row - statistics.mean) / _deviation(statistics), -bound, bound)


def denormalise(statistics: Statistics, row: Array) -> Array:
    """The inverse of `normalise` within its bound."""
    return row * _deviation(statistics) + statistics.mean


def measure(rows: np.ndarray) -> Statistics:
    """Statistics of rows [N, columns]."""
    rows = np.asarray(rows, np.float64)
    return Statistics(
        jnp.asarray(rows.mean(0), jnp.float32), jnp.asarray(rows.var(0), jnp.float32), jnp.float32(len(rows))
    )


def _deviation(statistics: Statistics) -> Array:
    # a column that never changed in training is left alone, not blown up
    deviation = jnp.sqrt(statistics.variance)
    return jnp.where(deviation > 1e-6, deviation, 1.0)
