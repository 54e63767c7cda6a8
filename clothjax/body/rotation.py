"""Representations of a 3-D rotation, finite with finite gradients at every angle."""

import jax.numpy as jnp
from jaxtyping import Float

from clothjax.types import Array


def to_6d(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 6"]:
    """Return the 6D representation [..., 6] of rotation matrices [..., 3, 3]: two columns (Zhou et al. 2019)."""
    return jnp.concatenate([matrix[..., :, 0], matrix[..., :, 1]], axis=-1)


def heading(matrix: Float[Array, "3 3"], epsilon: float = 1e-12) -> Float[Array, "3 3"]:
    """Find the rotation about +Y nearest to a rotation matrix [3, 3]: the direction its subject faces.

    It maximises trace(R_y^T R), so it commutes with rotations of the world about the vertical. It is undefined only
    for half turns about a horizontal axis, where it falls back to the identity.
    """
    cosine = matrix[0, 0] + matrix[2, 2]
    sine = matrix[0, 2] - matrix[2, 0]
    squared = cosine * cosine + sine * sine
    degenerate = squared < epsilon
    length = jnp.sqrt(jnp.where(degenerate, 1.0, squared))
    c = jnp.where(degenerate, 1.0, cosine / length)
    s = jnp.where(degenerate, 0.0, sine / length)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)
