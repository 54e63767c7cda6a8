"""Vectors: lengths and directions with gradients that are zero, not NaN, at the zero vector; and vectors by component.

A `Vector` is a tuple of its x, y and z, each [N] over the elements of a mesh. XLA computes with these three times as
fast as with the rows of an array [N, 3], and their derivatives are as fast.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from clothjax.types import Array

Vector = tuple[Array, Array, Array]


def norm(vectors: Array, keepdims: bool = False) -> Array:
    """Return the lengths [...] of vectors [..., 3], or [..., 1] with `keepdims`."""
    return _root(jnp.sum(vectors * vectors, axis=-1, keepdims=keepdims))


def _root(squared: Array) -> Array:
    zero = squared == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def unit(vectors: Array) -> Array:
    """Return the directions [..., 3] of vectors [..., 3]; zero for the zero vector."""
    squared = jnp.sum(vectors * vectors, axis=-1, keepdims=True)
    return jnp.where(squared > 0, vectors / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)


def at_corners(points: Float[Array, "V 3"], elements: Int[Array, "N k"]) -> Float[Array, "N k 3"]:
    """Return the points [N, k, 3] at the corners of elements: `points[elements]`, gathered by component."""
    columns = _unstack(points, 1)
    corners = _unstack(jnp.asarray(elements), 1)
    return jnp.stack([jnp.stack([column[corner] for column in columns], axis=1) for corner in corners], axis=1)


def corners(points: Float[Array, "N k 3"]) -> list[Vector]:
    """Return the k corners of elements, each a `Vector` of components [N]."""
    x, y, z = (_unstack(component, 1) for component in _unstack(points, 2))
    return list(zip(x, y, z, strict=True))


def _unstack(array: Array, axis: int) -> list[Array]:
    # the derivative of a split is a concatenation, of an index a scatter
    parts = jax.lax.split(array, (1,) * array.shape[axis], axis)
    return [jnp.squeeze(part, axis) for part in parts]


def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def minus(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def times(scale: Array | float, a: Vector) -> Vector:
    """Return a vector times a scale."""
    return (scale * a[0], scale * a[1], scale * a[2])


def dot(a: Vector, b: Vector) -> Array:
    """Return the inner product of a and b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product of a and b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def length(a: Vector) -> Array:
    """Return the lengths of a."""
    return _root(dot(a, a))
