"""Mesh convolution with a shared weight basis: vcDownConv and vdDownRes of Zhou et al. 2020."""

from collections.abc import Callable, Sequence
from typing import Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp

from clothjax.types import Array


class Table(Protocol):
    """The neighbours that a block reads: row p lists up to K of the N input vertices, which output vertex p reads.

    `scene.Table` and `mesh_hierarchy.Level` are such tables.
    """

    @property
    def ids(self) -> Array:
        """[P, K] int32, indices of input vertices; padding is any number."""
        ...

    @property
    def mask(self) -> Array:
        """[P, K] bool, false at padding, which has no effect and no gradient."""
        ...


class MeshConvolution(nn.Module):
    """One block: sqrt(1 - r) activation(convolution) + sqrt(r) residual, of one example.

    The convolution is b + sum_k x[ids[p, k]] (sum_m a[p, k, m] W[m]). The residual pools the neighbours with
    weights |density| that sum to one, if P != N, and maps channels, if I != O.

    Initial values preserve the mean square of the features through a block with ReLU, if neighbours resemble each
    other. The paper has N(0, 1) for `basis`, N(0, 1) / (mean count M) for `coefficients` and N(0, 1) / O for `skip`.
    With these, a skip from 128 to 256 features leaves less than a twentieth, and stacked blocks fade.

    Parameters if r < 1: `basis` [I, M, O], `coefficients` [P, K, M] and `bias` [O]. Parameters if r > 0: `density`
    [P, K] if P != N, and `skip` [I, O] if I != O.
    """

    features: int  # channels O
    bases: int  # size M of the weight basis
    residual_rate: float = 0.5  # r: 0 is the convolution alone, 1 the residual alone
    # of the convolution only; the paper has ELU, and none in a network's last block
    activation: Callable[[Array], Array] = jax.nn.relu

    @nn.compact
    def __call__(self, x: Array, table: Table) -> Array:
        """Return features [P, O] of x [N, I].

        Raises:
            ValueError: if `residual_rate` is outside [0, 1].
        """
        rate, inputs, outputs = self.residual_rate, x.shape[-1], self.features
        if not 0 <= rate <= 1:
            raise ValueError(f"residual_rate is {rate}; it must be from 0 to 1")
        ids = jnp.where(table.mask, table.ids, 0)
        weights = jnp.asarray(table.mask, x.dtype)
        normal = nn.initializers.normal
        out = jnp.zeros(())
        if rate < 1:

            def coefficient(key, shape):
                # each output sums count M I products of three independent numbers; 2 / I makes up for ReLU (He 2015)
                count = jnp.maximum(jnp.sum(weights, axis=1), 1.0)[:, None, None]
                return jax.random.normal(key, shape) * weights[..., None] / jnp.sqrt(self.bases * count)

            basis = self.param("basis", normal((2 / inputs) ** 0.5), (inputs, self.bases, outputs))
            coefficients = self.param("coefficients", coefficient, (*ids.shape, self.bases))
            bias = self.param("bias", nn.initializers.zeros, (outputs,))
            convolved = _convolve(basis, coefficients * weights[..., None], x, ids)
            out = (1 - rate) ** 0.5 * self.activation(convolved + bias[None])
        if rate > 0:
            residual = x
            if len(ids) != len(x):
                # initially a plain mean over the neighbours
                density = jnp.abs(self.param("density", nn.initializers.ones, ids.shape)) * weights
                # the sum is zero only where all weights are; 1e-8 is the paper's guard
                density = density / (density.sum(axis=1, keepdims=True) + 1e-8)
                residual = jnp.einsum("pki,pk->pi", _gather(x, ids), density)
            if inputs != outputs:
                residual = residual @ self.param("skip", normal(inputs**-0.5), (inputs, outputs))
            out = out + rate**0.5 * residual
        return out


class Convolution(nn.Module):
    """Blocks of mesh convolution, one after the other, each with a ReLU."""

    features: tuple[int, ...]  # of each block
    bases: int

    @nn.compact
    def __call__(self, x: Array, tables: Sequence[Table]) -> Array:
        """Return features [P, O] of the last block of x [N, I]; each block has its own table."""
        for index, (features, table) in enumerate(zip(self.features, tables, strict=True)):
            x = MeshConvolution(features, self.bases, name=str(index))(x, table)
        return x


def _convolve(basis: Array, coefficients: Array, x: Array, ids: Array) -> Array:
    """Convolve inputs [N, I] to [P, O] by a basis [I, M, O], masked coefficients [P, K, M] and neighbours [P, K]."""
    features, bases, outputs = basis.shape
    places, slots = ids.shape
    if _basis_first(len(x), places, slots, features, outputs, bases):
        transformed = (x @ basis.reshape(features, -1)).reshape(-1, bases, outputs)
        return jnp.einsum("pkmo,pkm->po", _gather(transformed, ids), coefficients)
    # This order of operands, with M innermost, is the fastest of those tried under vmap on a CPU.
    gathered = jnp.einsum("pki,pkm->pim", _gather(x, ids), coefficients)
    return gathered.reshape(len(ids), -1) @ basis.reshape(-1, outputs)


def _basis_first(inputs: int, outputs: int, slots: int, features: int, channels: int, bases: int) -> bool:
    """Return whether it is far cheaper to transform all inputs before gathering them, as in narrow last blocks."""
    gather_first = outputs * slots * bases * features + outputs * bases * features * channels
    basis_first = inputs * bases * features * channels + outputs * slots * bases * channels
    return 2 * basis_first <= gather_first and bases * channels <= features


def _gather(x: Array, ids: Array) -> Array:
    return jnp.asarray(x).at[ids].get(mode="promise_in_bounds")
