"""Normalisation: running statistics of Phi's features; scales and ranges of Psi's codes and pose inputs."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.types import Array


class Statistics(NamedTuple):
    """Running mean and variance of a set of feature columns."""

    mean: Array  # [N]
    variance: Array  # [N]
    count: Array  # rows seen


# --- normalisation ------------------------------------------------------------------------------------------------


def empty_statistics(columns: int) -> Statistics:
    """Return statistics [columns] before any row: mean 0 and variance 1, which leave features as they are."""
    return Statistics(jnp.zeros(columns), jnp.ones(columns), jnp.zeros(()))


def observe(statistics: Statistics, rows: Array, counted: Array | None = None) -> Statistics:
    """Return statistics that have also seen `rows` [N, columns], or only those that are `counted` [N] bool.

    Chan's update of mean and variance: E[x^2] - E[x]^2 would lose constant columns to rounding.
    """
    weight = jnp.ones_like(rows[:, :1]) if counted is None else counted[:, None].astype(rows.dtype)
    rows = jnp.where(weight > 0, rows, 0.0)
    new = jnp.maximum(jnp.sum(weight), 1.0)
    mean = jnp.sum(weight * rows, axis=0) / new
    variance = jnp.sum(weight * jnp.square(rows - mean[None]), axis=0) / new
    count = statistics.count + jnp.sum(weight)
    share = jnp.sum(weight) / jnp.maximum(count, 1.0)
    shift = mean - statistics.mean
    return Statistics(
        mean=statistics.mean + share * shift,
        variance=(1.0 - share) * statistics.variance + share * variance + share * (1.0 - share) * shift * shift,
        count=count,
    )


def standardise(statistics: Statistics, rows: Array, bound: float = 10.0, least: float = 1e-6) -> Array:
    """Standardise features [N, columns] by mean and deviation, at least `least`; clip them to `bound` deviations."""
    deviation = jnp.sqrt(jnp.maximum(statistics.variance, least**2))
    return jnp.clip((rows - statistics.mean[None]) / deviation[None], -bound, bound)


# inputs this far out of their range still count as inside
SLACK = 0.02  # of an input: m/s, m or an entry of a rotation matrix
CODE_SLACK = 0.1  # of a normalised code or constant


class Scale(NamedTuple):
    """Mean and deviation to normalise rows [N] by, and the range seen in training."""

    mean: Array  # [N]
    deviation: Array  # [N]
    low: Array  # [N] the least and ...
    high: Array  # [N] ... the greatest seen, in standard deviations from the mean


class Normalizers(NamedTuple):
    """Scales of the latent predictor's codes and pose inputs."""

    latent: Scale  # [L]
    pose: Scale  # [P]


class Whitening(NamedTuple):
    """Maps between codes and whitened codes, in which the mean Hessian of the potential is the identity."""

    to: Array  # [L, L] H^(1/2), symmetric: whitened = to @ code
    back: Array  # [L, L] H^(-1/2), symmetric: code = back @ whitened


class ForceScales(NamedTuple):
    """Constants of a Psi with forces: scales of its inputs and its output, range of codes."""

    middle: Array  # [N] medians of `psi.force_inputs`, subtracted first
    spread: Array  # [N] their spread, divided by
    output: Array  # sqrt(J), the rms of an ordinary change of a whitened code
    whitening: Whitening
    low: Array  # [L] the least and ...
    high: Array  # [L] ... the greatest code of the labels


def identity(size: int) -> Scale:
    """Return the scale [size] that changes nothing: mean 0, deviation 1, and a range of +-1e6.

    It takes the place of a measured scale where there is none, as for Psi without stage 1.
    """
    far = np.full(size, 1e6, np.float32)
    return Scale(np.zeros(size, np.float32), np.ones(size, np.float32), -far, far)


def normalise(scale: Scale, row: Array) -> Array:
    """Express a row [N] in standard deviations from the mean."""
    return (row - scale.mean) / scale.deviation


def denormalise(scale: Scale, row: Array) -> Array:
    """Invert `normalise`: return a row [N] in its own units."""
    return row * scale.deviation + scale.mean


def bounded(row: Array, low: Array, high: Array, slack: Array | float = CODE_SLACK) -> tuple[Array, Array]:
    """Clip a row to a range; NaN becomes the middle of it.

    Args:
        row, low, high: [N].
        slack: how far out of the range still counts as inside.

    Returns:
        The row [N], and a bool: whether all of it was inside.
    """
    inside = jnp.where(jnp.isnan(row), 0.5 * (low + high), jnp.clip(row, low, high))
    return inside, jnp.all(jnp.abs(inside - row) <= slack)


def widened(scale: Scale, rows: np.ndarray) -> Scale:
    """Return the same scale with its range widened to hold rows [n, N], which are not normalised."""
    rows = np.asarray(normalise(jax.tree.map(np.asarray, scale), rows))
    return scale._replace(low=np.minimum(scale.low, rows.min(0)), high=np.maximum(scale.high, rows.max(0)))


def measure(rows: Array) -> Scale:
    """Return mean, deviation and range of the columns of rows [n, N], as a `Scale` in float32."""
    rows = np.asarray(rows, np.float64)
    mean, deviation = rows.mean(0), rows.std(0)
    # a column that never changed in training is left alone, not blown up
    deviation = np.where(deviation > 1e-6, deviation, 1.0)
    low, high = (rows.min(0) - mean) / deviation, (rows.max(0) - mean) / deviation
    return Scale(*(jnp.asarray(x, jnp.float32) for x in (mean, deviation, low, high)))
