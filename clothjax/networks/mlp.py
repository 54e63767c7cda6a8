"""Dense layers, MLPs, layer normalisation."""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp

from clothjax.types import Array

Params = dict
CHUNK = 1024  # rows of an MLP at a time, where a CPU recomputes it: its layers then stay in the cache


# --- multilayer perceptrons ---------------------------------------------------------------------------------------


def init_dense(key: Array, inputs: int, outputs: int, gain: float = 2.0) -> Params:
    """A dense layer with kernel variance gain / inputs and zero bias; the gain 2 suits a ReLU behind it."""
    kernel = nn.initializers.variance_scaling(gain, "fan_in", "truncated_normal")
    return nn.Dense(outputs, kernel_init=kernel).init(key, jnp.zeros((1, inputs)))["params"]


def dense(params: Params, x: Array) -> Array:
    """A dense layer on [..., inputs]."""
    bias = params["bias"]
    return times(x, params["kernel"]) + bias.reshape((1,) * (x.ndim - 1) + bias.shape)


def times(x: Array, kernel: Array) -> Array:
    """x [..., inputs] times a kernel [inputs, outputs]; where that is in bfloat16, so is the product."""
    if kernel.dtype == jnp.bfloat16:
        return (x.astype(jnp.bfloat16) @ kernel).astype(x.dtype)
    return x @ kernel


def in_bfloat16(params: Params) -> Params:
    """The same layers with their kernels in bfloat16, so that products are, and the gradients of these."""

    def rounded(path, leaf):
        return leaf.astype(jnp.bfloat16) if path[-1] == jax.tree_util.DictKey("kernel") else leaf

    return jax.tree_util.tree_map_with_path(rounded, params)


def init_mlp(key: Array, sizes: tuple[int, ...], norm: bool = True, last_gain: float = 1.0) -> Params:
    """An MLP through `sizes`, ReLU between the layers, with a LayerNorm at the end if `norm`."""
    keys = jax.random.split(key, len(sizes) - 1)
    last = len(sizes) - 2
    params = {
        f"dense_{i}": init_dense(keys[i], sizes[i], sizes[i + 1], last_gain if i == last else 2.0)
        for i in range(len(sizes) - 1)
    }
    if norm:
        params["norm"] = {"scale": jnp.ones(sizes[-1]), "bias": jnp.zeros(sizes[-1])}
    return params


def apply_mlp(params: Params, x: Array) -> Array:
    """The MLP of `init_mlp` on [N, inputs], or without a LayerNorm on [..., inputs]."""
    return mlp_tail(params, dense(params["dense_0"], x))


def mlp_tail(params: Params, first: Array) -> Array:
    """An MLP from the pre-activation of its first layer."""
    x, layers = first, sum(name.startswith("dense") for name in params)
    for i in range(1, layers):
        x = dense(params[f"dense_{i}"], nn.relu(x))
    if "norm" not in params:
        return x
    return _affine(jax.nn.standardize(x, epsilon=1e-5), params["norm"]["scale"], params["norm"]["bias"])


def mlp_tail_in_chunks(params: Params, first: Array) -> Array:
    """`_mlp_tail`, some rows at a time, that keeps nothing but `first` for the backward pass."""
    count, width = first.shape
    chunks = -(-count // CHUNK)
    rows = -(-count // chunks)
    parts = jnp.pad(first, ((0, chunks * rows - count), (0, 0))).reshape(chunks, rows, width)
    done = jax.lax.map(jax.checkpoint(partial(mlp_tail, params), prevent_cse=False), parts)
    return done.reshape(chunks * rows, -1)[:count]


@jax.custom_vjp
def _affine(x: Array, scale: Array, bias: Array) -> Array:
    """x [N, W] times scale [W] plus bias [W]. Its gradient sums rows by a product: XLA's own sum took an eighth of a
    training step on a CPU. A custom rule for the backward pass: there is no forward-mode derivative of it."""
    return x * scale[None] + bias[None]


def _affine_forward(x, scale, bias):
    return _affine(x, scale, bias), (x, scale)


def _affine_backward(kept, gradient):
    x, scale = kept

    def row_sum(rows):
        return jnp.matmul(jnp.ones((1, len(rows)), rows.dtype), rows, precision="highest")[0]

    return gradient * scale[None], row_sum(gradient * x), row_sum(gradient)


_affine.defvjp(_affine_forward, _affine_backward)
