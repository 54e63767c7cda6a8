"""Psi's network (METHOD.md, Psi): the next latent code from the current one and what a game engine knows."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import rotation, skinning
from clothjax.config import Config, MaterialConfig, Stage2Config
from clothjax.material import material_inputs, scaled
from clothjax.networks.mlp import MLP, Params
from clothjax.networks.normalisation import bounded
from clothjax.types import Array, Material, Pose


def input_joints(names: tuple[str, ...], config: Stage2Config) -> np.ndarray:
    """Indices of the joints that are inputs: all but hands, fingers and toes, which move no garment."""
    excluded = [word.lower() for word in config.excluded_joints]
    kept = [i for i, name in enumerate(names) if not any(word in name.lower() for word in excluded)]
    return np.array(kept, np.int32)


def pose_inputs(rotations: Array, positions: Array, advance: Array, kept: np.ndarray, fps: float) -> Array:
    """Psi's inputs from the motion, [6 + 3 * 6 * Jk + 3 * 3 * (Jk - 1)], without place or heading.

    Args:
        rotations: [3, J, 3, 3] local, at t + 1, t, t - 1.
        positions: [3, J, 3] m of the joints in the same frames, from forward kinematics.
        advance: [2, 3] m, the root's steps t -> t + 1 and t - 1 -> t.
        kept: joint indices, the root first.
        fps: frames a second.

    The heading at t is removed from all three frames, so that turning is seen and facing is not.
    """
    root = int(kept[0])
    turn = rotation.heading(rotations[1, root]).T
    velocity = jnp.einsum("ab,nb->na", turn, advance, precision="highest") * fps
    first = jnp.matmul(turn[None], rotations[:, root], precision="highest")
    codes = rotation.to_6d(jnp.concatenate([first[:, None], rotations[:, kept[1:]]], axis=1))
    relative = jnp.einsum("ab,tjb->tja", turn, positions[:, kept[1:]] - positions[:, None, root], precision="highest")
    return jnp.concatenate([velocity.reshape(-1), codes.reshape(-1), relative.reshape(-1)])


def window_inputs(poses: Pose, joints: Array, parents: np.ndarray, kept: np.ndarray, fps: float) -> Array:
    """`pose_inputs` of a window of three poses, as `clips.poses` gives it."""
    advance = jnp.stack([poses.translation[2], -poses.translation[0]])
    rotations = poses.rotations[::-1]
    _, positions = jax.vmap(lambda local: skinning.forward_kinematics(local, joints, parents))(rotations)
    return pose_inputs(rotations, positions, advance, kept, fps)


def constant_inputs(betas: Array, material: Material, config: MaterialConfig) -> Array:
    """Betas [S] and the material scaled to [0, 1] [4]: what does not change while a character wears a garment.

    Where all garments are of one material it is no input.
    """
    if not config.sample:
        return betas
    density = scaled(material.density, config.density_range)
    return jnp.concatenate([betas, density[None], material_inputs(material, config)])


def bounded_constants(constants: Array, config: Config) -> tuple[Array, Array]:
    """Constants of `constant_inputs` brought into the range that training draws from, and whether they were there."""
    materials = jnp.ones(len(Material._fields) if config.material.sample else 0)
    betas = jnp.full(len(constants) - len(materials), config.stage1.betas)
    return bounded(constants, jnp.concatenate([-betas, 0 * materials]), jnp.concatenate([betas, materials]))


class Psi(nn.Module):
    """The latent predictor. Its last layer starts small, so that it first keeps the code as it is."""

    config: Stage2Config

    @nn.compact
    def __call__(self, latent: Array, pose: Array, constants: Array) -> Array:
        """The next code [L] in standard deviations, from the current one, normalised pose inputs [P] and constants [C].

        A part `latent_decay` of the code is forgotten unless the network gives it back, so that no direction of the
        code drifts.
        """
        inputs = jnp.concatenate([latent, pose, constants])
        mlp = MLP((len(inputs), *self.config.hidden, len(latent)), norm=False, last_gain=0.01)
        nn.share_scope(self, mlp)  # its layers are Psi's own, as in older models
        return (1.0 - self.config.latent_decay) * latent + mlp(inputs)


def init(key: Array, latent: int, pose: int, constants: int, config: Stage2Config) -> Params:
    """Parameters of Psi for so many codes L, pose inputs P and constants C."""
    return Psi(config).init(key, jnp.zeros(latent), jnp.zeros(pose), jnp.zeros(constants))["params"]
