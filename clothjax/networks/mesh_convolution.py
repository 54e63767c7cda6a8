"""Mesh convolution with a shared weight basis: vcDownConv and vdDownRes of Zhou et al. 2020, one block."""

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.types import Array

Params = dict[str, Array]


class Table(Protocol):
    """Which of N inputs each of P outputs reads, as in `graph_sampling.Level`."""

    ids: Array  # [P, K] int32, padded with N
    mask: Array  # [P, K] bool


def init(
    key: Array,
    table: Table,
    in_features: int,
    out_features: int,
    bases: int,
    residual_rate: float = 0.5,
) -> Params:
    """Parameters of a block; only those that the rate and the shapes call for.

    Initial values keep the mean square of the features through a block with ReLU, if neighbours resemble each
    other. The paper's, N(0, 1) for `basis`, N(0, 1) / (mean count M) for `coefficients` and N(0, 1) / O for
    `skip`, do not: from 128 to 256 features the skip leaves less than a twentieth, and stacked blocks fade.

    Args:
        key: random key.
        table: its `ids` and `mask` [P, K] as host arrays.
        in_features, out_features: channels I and O.
        bases: size M of the weight basis.
        residual_rate: r in [0, 1], as for `apply`.

    Returns:
        `basis` [I, M, O], `coefficients` [P, K, M] and `bias` [O] if r < 1;
        `density` [P, K] if r > 0 and P != N; `skip` [I, O] if r > 0 and I != O.

    Raises:
        ValueError: a rate outside [0, 1].
    """
    if not 0 <= residual_rate <= 1:
        raise ValueError(f"residual_rate is {residual_rate}; it must be from 0 to 1")
    ids, mask = np.asarray(table.ids), np.asarray(table.mask)
    inputs = int(ids.max()) + int(mask.all())  # padding, where there is any, is N
    basis_key, coefficient_key, skip_key = jax.random.split(key, 3)
    params = {}
    if residual_rate < 1:
        # Each output sums count M I products of three independent numbers; 2 / I makes up for ReLU (He 2015).
        basis = jax.random.normal(basis_key, (in_features, bases, out_features))
        coefficients = jax.random.normal(coefficient_key, (*ids.shape, bases))
        count = np.maximum(mask.sum(axis=1), 1)[:, None, None]
        spread = mask[..., None] / np.sqrt(bases * count)
        params["basis"] = basis * (2 / in_features) ** 0.5
        params["coefficients"] = coefficients * jnp.asarray(spread, coefficients.dtype)
        params["bias"] = jnp.zeros(out_features)
    if residual_rate > 0 and len(ids) != inputs:
        params["density"] = jnp.ones(ids.shape)  # a plain mean over the neighbours
    if residual_rate > 0 and in_features != out_features:
        params["skip"] = jax.random.normal(skip_key, (in_features, out_features)) / in_features**0.5
    return params


def apply(
    params: Params,
    x: Array,
    ids: Array,
    mask: Array,
    *,
    residual_rate: float = 0.5,
    activation: Callable[[Array], Array] = jax.nn.relu,
) -> Array:
    """sqrt(1 - r) activation(convolution) + sqrt(r) residual, of one example.

    The convolution is b + sum_k x[ids[p, k]] (sum_m a[p, k, m] W[m]). The residual pools the neighbours with
    weights |density| that sum to one, if P != N, and maps channels, if I != O.

    Args:
        params: from `init`.
        x: [N, I] features.
        ids: [P, K] int32 inputs that each output reads; padding is any number.
        mask: [P, K] bool, false at padding, which then has no effect and no gradient.
        residual_rate: r, at which `params` were made; 0 is the convolution alone, 1 the residual alone.
        activation: of the convolution only; the paper has ELU, and none in a network's last block.

    Returns:
        [P, O] features.
    """
    ids = jnp.where(mask, ids, 0)
    weights = jnp.asarray(mask, x.dtype)
    out = 0.0
    if residual_rate < 1:
        convolved = _convolve(params["basis"], params["coefficients"] * weights[..., None], x, ids)
        out = (1 - residual_rate) ** 0.5 * activation(convolved + params["bias"][None])
    if residual_rate > 0:
        residual = x
        if "density" in params:
            density = jnp.abs(params["density"]) * weights
            # The sum is zero only where all weights are; 1e-8 is the paper's guard.
            density = density / (density.sum(axis=1, keepdims=True) + 1e-8)
            residual = jnp.einsum("pki,pk->pi", _gather(x, ids), density)
        if "skip" in params:
            residual = residual @ params["skip"]
        out = out + residual_rate**0.5 * residual
    return out


def _convolve(basis: Array, coefficients: Array, x: Array, ids: Array) -> Array:
    """[P, O] of basis [I, M, O], masked coefficients [P, K, M], inputs [N, I] and neighbours [P, K]."""
    features, bases, outputs = basis.shape
    if _basis_first(x.shape[0], *ids.shape, features, outputs, bases):
        transformed = (x @ basis.reshape(features, -1)).reshape(-1, bases, outputs)
        return jnp.einsum("pkmo,pkm->po", _gather(transformed, ids), coefficients)
    # This order of operands, with M innermost, is the fastest of those tried under vmap on a CPU.
    gathered = jnp.einsum("pki,pkm->pim", _gather(x, ids), coefficients)
    return gathered.reshape(len(ids), -1) @ basis.reshape(-1, outputs)


def _basis_first(inputs: int, outputs: int, slots: int, features: int, channels: int, bases: int) -> bool:
    """Whether to transform all inputs before gathering them: narrow last blocks, where it is far cheaper."""
    gather_first = outputs * slots * bases * features + outputs * bases * features * channels
    basis_first = inputs * bases * features * channels + outputs * slots * bases * channels
    return 2 * basis_first <= gather_first and bases * channels <= features


def _gather(x: Array, ids: Array) -> Array:
    return jnp.asarray(x).at[ids].get(mode="promise_in_bounds")
