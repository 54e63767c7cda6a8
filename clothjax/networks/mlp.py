"""Dense layers, MLPs, layer normalisation."""

from collections.abc import Callable
from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from clothjax.types import Array

Params = dict
CHUNK = 1024  # rows of an MLP at a time, where a CPU recomputes it: its layers then stay in the cache


def scaled(gain: float) -> Callable:
    """Return an initialiser of kernels with variance gain / inputs; the gain 2 suits a ReLU behind the layer."""
    return nn.initializers.variance_scaling(gain, "fan_in", "truncated_normal")


# --- multilayer perceptrons ---------------------------------------------------------------------------------------


class Dense(nn.Module):
    """A dense layer whose kernel can be applied in parts, before its inputs are gathered or concatenated."""

    inputs: int
    outputs: int
    gain: float = 2.0

    def setup(self):
        self.kernel = self.param("kernel", scaled(self.gain), (self.inputs, self.outputs))
        self.bias = self.param("bias", nn.initializers.zeros, (self.outputs,))

    def __call__(self, x: Array) -> jax.Array:
        """Return [..., outputs] of x [..., inputs]."""
        return self.biased(self.product(x))

    def product(self, x: Array, begin: int = 0) -> jax.Array:
        """Multiply x [..., n] by the n rows of the kernel from `begin` on, without the bias."""
        return x @ self.kernel[begin : begin + x.shape[-1]]

    def biased(self, product: jax.Array) -> jax.Array:
        """Add the bias to products [..., outputs]."""
        return product + self.bias.reshape((1,) * (product.ndim - 1) + self.bias.shape)


def apply(module: nn.Module, params: Params, *arguments: Any, **options: Any) -> Any:
    """Call a module with given parameters, and return what it returns."""
    return module.apply({"params": params}, *arguments, **options)


def init(module: nn.Module, key: Any, *arguments: Any, **options: Any) -> Params:
    """Return the initial parameters of a module, from a key and examples of its arguments."""
    return dict(module.init(key, *arguments, **options)["params"])


class LayerNorm(nn.Module):
    """Layer normalisation: each row of [N, W] gets mean 0 and variance 1, then a learned scale [W] and bias [W]."""

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Return the normalised rows [N, W] of x [N, W]."""
        scale = self.param("scale", nn.initializers.ones, (x.shape[-1],))
        bias = self.param("bias", nn.initializers.zeros, (x.shape[-1],))
        return _affine(jax.nn.standardize(x, epsilon=1e-5), scale, bias)


class MLP(nn.Module):
    """Dense layers through `sizes`, inputs first, with ReLU between them and a LayerNorm at the end if `norm`."""

    sizes: tuple[int, ...]
    norm: bool = True
    last_gain: float = 1.0

    def setup(self):
        gains = (*(2.0,) * (len(self.sizes) - 2), self.last_gain)
        self.dense = [Dense(*each) for each in zip(self.sizes[:-1], self.sizes[1:], gains, strict=True)]
        self.layer_norm = LayerNorm(name="norm") if self.norm else None

    def __call__(self, x: Array) -> Array:
        """Return [N, outputs] of x [N, inputs]; without a LayerNorm, [..., outputs] of [..., inputs]."""
        return self.tail(self.dense[0](x))

    def tail(self, first: Array, in_chunks: bool = False) -> Array:
        """Return the outputs [N, outputs], given what the first layer has computed: `first` [N, W], before its ReLU.

        Args:
            in_chunks: take some rows at a time, and store nothing but `first` for the backward pass.
        """
        if in_chunks and not self.is_initializing():
            return self._in_chunks(first)
        x = first
        for layer in self.dense[1:]:
            x = layer(nn.relu(x))
        return x if self.layer_norm is None else self.layer_norm(x)

    @nn.nowrap
    def _in_chunks(self, first: Array) -> Array:
        count, width = first.shape
        chunks = -(-count // CHUNK)
        rows = -(-count // chunks)
        parts = jnp.pad(first, ((0, chunks * rows - count), (0, 0))).reshape(chunks, rows, width)
        mlp, variables = self.unbind()
        tail = partial(mlp.apply, variables, method="tail")
        outputs = jax.lax.map(jax.checkpoint(tail, prevent_cse=False), parts)
        return outputs.reshape(chunks * rows, -1)[:count]


@jax.custom_vjp
def _affine(x: Array, scale: Array, bias: Array) -> Array:
    """Return x [N, W] times scale [W] plus bias [W].

    Its gradient sums rows by a product: XLA's own sum took an eighth of a training step on a CPU. The custom rule is
    for the backward pass alone: it has no forward-mode derivative.
    """
    return x * scale[None] + bias[None]


def _affine_forward(x, scale, bias):
    return _affine(x, scale, bias), (x, scale)


def _affine_backward(residuals, gradient):
    x, scale = residuals

    def row_sum(rows):
        return jnp.matmul(jnp.ones((1, len(rows)), rows.dtype), rows, precision="highest")[0]

    return gradient * scale[None], row_sum(gradient * x), row_sum(gradient)


_affine.defvjp(_affine_forward, _affine_backward)
