"""Lengths and directions, also of the zero vector and in gradients."""

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.geometry import vectors


def test_norm_and_unit():
    rows = jnp.asarray([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(vectors.norm(rows), [5.0, 0.0])
    np.testing.assert_array_equal(vectors.norm(rows, keepdims=True), [[5.0], [0.0]])
    np.testing.assert_allclose(vectors.unit(rows), [[0.6, 0.0, 0.8], [0.0, 0.0, 0.0]], rtol=1e-6)


def test_gradients_of_the_zero_vector_are_zero():
    zero = jnp.zeros((2, 3))
    for function in (vectors.norm, vectors.unit):
        np.testing.assert_array_equal(jax.grad(lambda x, f=function: jnp.sum(f(x)))(zero), zero)
