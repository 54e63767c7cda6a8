"""The cloth: its configured constants, the ranges for sampling them, and their form as network inputs."""

import jax
import jax.numpy as jnp

from clothjax.config import Config, MaterialConfig, Range
from clothjax.types import Array, Material


def configured_material(config: Config) -> Material:
    """Return the configured cloth as scalars: density [kg/m^2], mu and lambda [Pa], bending [N m]."""
    cloth = config.material
    return Material(*(jnp.float32(value) for value in (cloth.density, cloth.mu, cloth.lam, cloth.bending)))


def material_inputs(material: Material, config: MaterialConfig) -> Array:
    """Return bending, mu and lambda [3] scaled to [0, 1] over their training ranges (HOOD's order); [0] if fixed."""
    if not config.sample:
        return jnp.zeros(0)
    pairs = (
        (material.bending, config.bending_range),
        (material.mu, config.mu_range),
        (material.lam, config.lam_range),
    )
    return jnp.stack([scaled(value, limits) for value, limits in pairs])


def scaled(value: Array, limits: Range) -> Array:
    """Scale a material constant to [0, 1] over its training range, logarithmically if the range is logarithmic."""
    if limits.low == limits.high:
        return jnp.zeros_like(jnp.asarray(value))
    low, high = jnp.log(limits.low), jnp.log(limits.high)
    if limits.log:
        return ((jnp.log(value) - low) / (high - low)).astype(jnp.asarray(value).dtype)
    return (value - limits.low) / (limits.high - limits.low)


def unscaled(share: Array, limits: Range) -> Array:
    """Invert `scaled`: return the constant for a value `share` in [0, 1] of its training range."""
    if limits.log:
        return limits.low * (limits.high / limits.low) ** share
    return limits.low + share * (limits.high - limits.low)


def sample_material(key: Array, config: Config) -> Material:
    """Draw a material, of scalars, from the training ranges; without `material.sample` return the configured one."""
    cloth = config.material
    if not cloth.sample:
        return configured_material(config)

    ranges = (cloth.density_range, cloth.mu_range, cloth.lam_range, cloth.bending_range)
    pairs = zip(jax.random.split(key, 4), ranges, strict=True)
    return Material(*(unscaled(jax.random.uniform(k), limits) for k, limits in pairs))
