"""The training loss: the energies of a time step, weighted by constants or ramps (METHOD.md, Training)."""

from collections.abc import Callable

import jax.numpy as jnp

from clothjax.config import LossConfig, Ramp
from clothjax.types import Array


def weighing(config: LossConfig, training_step: Array) -> Callable[[dict[str, Array]], tuple[Array, dict[str, Array]]]:
    """Return the function that weighs the energies of a time step at a training step.

    It takes the energies in J by name. It returns the loss, and the energies whose weight is not always zero.
    """

    def weigh(terms: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        present = present_terms(terms, config)
        return weighted_loss(present, config, training_step), present

    return weigh


def present_terms(terms: dict[str, Array], config: LossConfig) -> dict[str, Array]:
    """Return the energies whose weight is not always zero; a compiled program leaves out what only the others need."""
    return {name: value for name, value in terms.items() if not getattr(config, name).absent}


def weighted_loss(terms: dict[str, Array], config: LossConfig, training_step: Array) -> Array:
    """Compute the training loss: the weighted sum of energies in J, divided by `config.scale` J."""
    total = sum(loss_weight(getattr(config, name), training_step) * value for name, value in terms.items())
    return jnp.asarray(total / config.scale)


def loss_weight(ramp: Ramp, training_step: Array) -> Array | float:
    """Return the value of a loss weight at a training step: constant, or on its ramp."""
    if ramp.end is None:
        return ramp.start
    progress = (training_step - ramp.first_step) / (ramp.last_step - ramp.first_step)
    return ramp.start + (ramp.end - ramp.start) * jnp.clip(progress, 0.0, 1.0)
