"""The cloth: its configured constants, the ranges they are drawn from, and how networks see them."""

import jax
import jax.numpy as jnp

from clothjax.config import Config, MaterialConfig, Range
from clothjax.types import Array, Material


def configured_material(config: Config) -> Material:
    """The configured material."""
    cloth = config.material
    return Material(*(jnp.float32(value) for value in (cloth.density, cloth.mu, cloth.lam, cloth.bending)))


def material_inputs(material: Material, config: MaterialConfig) -> Array:
    """Bending, mu and lambda [3] scaled to [0, 1] over their training ranges (HOOD's order); [0] if they are fixed."""
    if not config.sample:
        return jnp.zeros(0)
    pairs = (
        (material.bending, config.bending_range),
        (material.mu, config.mu_range),
        (material.lam, config.lam_range),
    )
    return jnp.stack([scaled(value, limits) for value, limits in pairs])


def scaled(value: Array, limits) -> Array:
    """A material constant on [0, 1] over its training range, logarithmic where the range is."""
    if limits.low == limits.high:
        return jnp.zeros_like(jnp.asarray(value))
    low, high = jnp.log(limits.low), jnp.log(limits.high)
    if limits.log:
        return ((jnp.log(value) - low) / (high - low)).astype(jnp.asarray(value).dtype)
    return (value - limits.low) / (limits.high - limits.low)


def unscaled(share: Array, limits) -> Array:
    """The inverse of `scaled`."""
    if limits.log:
        return limits.low * (limits.high / limits.low) ** share
    return limits.low + share * (limits.high - limits.low)


def sample_material(key: Array, config: Config) -> Material:
    """A material from the training ranges, or the configured one."""
    cloth = config.material
    if not cloth.sample:
        return configured_material(config)

    def draw(key: Array, limits: Range) -> Array:
        uniform = jax.random.uniform(key)
        if limits.log:
            return limits.low * (limits.high / limits.low) ** uniform
        return limits.low + (limits.high - limits.low) * uniform

    ranges = (cloth.density_range, cloth.mu_range, cloth.lam_range, cloth.bending_range)
    return Material(*(draw(k, limits) for k, limits in zip(jax.random.split(key, 4), ranges)))
