"""Maps between representations of a 3-D rotation, finite with finite gradients at every angle."""

import jax.numpy as jnp
from jaxtyping import Float

from clothjax.types import Array


def from_axis_angle(vector: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Rotation matrices [..., 3, 3] from axis-angle vectors [..., 3] in radians (Rodrigues).

    Sine and cosine coefficients are switched to their series below 1e-3 rad, so the gradient at zero is finite.
    """
    squared = jnp.sum(vector * vector, axis=-1)
    small = squared < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    sine = jnp.where(small, 1.0 - squared / 6.0, jnp.sin(angle) / angle)
    half = jnp.sin(0.5 * angle) / angle  # (1 - cos a) / a^2 = 2 sin^2(a/2) / a^2 loses no digits
    cosine = jnp.where(small, 0.5 - squared / 24.0, 2.0 * half * half)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = jnp.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    cross = jnp.stack(rows, axis=-1).reshape(*vector.shape[:-1], 3, 3)
    outer = vector[..., :, None] * vector[..., None, :]
    eye = jnp.broadcast_to(jnp.eye(3, dtype=vector.dtype), outer.shape)
    # K^2 = v v^T - |v|^2 I
    return eye + sine[..., None, None] * cross + cosine[..., None, None] * (outer - squared[..., None, None] * eye)


def to_6d(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 6"]:
    """Return the 6D representation [..., 6] of rotation matrices [..., 3, 3]: two columns (Zhou et al. 2019)."""
    return jnp.concatenate([matrix[..., :, 0], matrix[..., :, 1]], axis=-1)


def from_6d(code: Float[Array, "*n 6"], epsilon: float = 1e-12) -> Float[Array, "*n 3 3"]:
    """Rotation matrices [..., 3, 3] from the 6D representation [..., 6] of `to_6d`, by Gram-Schmidt; always finite."""
    first, second = code[..., :3], code[..., 3:]
    x = _unit(first, epsilon)
    y = _unit(second - jnp.sum(x * second, axis=-1, keepdims=True) * x, epsilon)
    return jnp.stack([x, y, jnp.cross(x, y)], axis=-1)


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


def _unit(vector: Array, epsilon: float) -> Array:
    squared = jnp.sum(vector * vector, axis=-1, keepdims=True)
    return vector / jnp.sqrt(squared + epsilon)
