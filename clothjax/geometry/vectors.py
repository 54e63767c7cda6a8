"""Lengths and directions of vectors whose gradients are zero, not NaN, at the zero vector."""

import jax.numpy as jnp

from clothjax.types import Array


def norm(vectors: Array, keepdims: bool = False) -> Array:
    """Return the lengths [...] of vectors [..., 3], or [..., 1] with `keepdims`."""
    squared = jnp.sum(vectors * vectors, axis=-1, keepdims=keepdims)
    zero = squared == 0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def unit(vectors: Array) -> Array:
    """Return the directions [..., 3] of vectors [..., 3]; zero for the zero vector."""
    squared = jnp.sum(vectors * vectors, axis=-1, keepdims=True)
    return jnp.where(squared > 0, vectors / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)
