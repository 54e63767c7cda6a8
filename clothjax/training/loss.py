"""Loss weights and their ramps: from the terms of the potential to one number."""

from collections.abc import Callable

import jax.numpy as jnp

from clothjax.config import LossConfig, Ramp
from clothjax.types import Array


def weighing(config: LossConfig, training_step: Array) -> Callable[[dict[str, Array]], tuple[Array, dict[str, Array]]]:
    """Return a function from the energies of a step in J to the training loss and the energies in it."""

    def weigh(terms: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        present = present_terms(terms, config)
        return weighted_loss(present, config, training_step), present

    return weigh


def present_terms(terms: dict[str, Array], config: LossConfig) -> dict[str, Array]:
    """Return the terms whose weight is not always zero; the others are then not computed."""
    return {name: value for name, value in terms.items() if not getattr(config, name).absent}


def weighted_loss(terms: dict[str, Array], config: LossConfig, training_step: Array) -> Array:
    """Compute the training loss: the weighted sum of terms in J over `config.scale`."""
    total = sum(loss_weight(getattr(config, name), training_step) * value for name, value in terms.items())
    return jnp.asarray(total / config.scale)


def loss_weight(ramp: Ramp, training_step: Array) -> Array | float:
    """Return a loss weight at a training step."""
    if ramp.end is None:
        return ramp.start
    progress = (training_step - ramp.first_step) / (ramp.last_step - ramp.first_step)
    return ramp.start + (ramp.end - ramp.start) * jnp.clip(progress, 0.0, 1.0)
