"""Stage 2 of a Psi with forces: regression on labelled frames, round after round (METHOD.md, Psi with forces)."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from clothjax.config import Config
from clothjax.networks import mlp, psi
from clothjax.networks.forces import KINDS
from clothjax.networks.normalisation import ForceScales, Whitening
from clothjax.networks.psi import ForcePsi
from clothjax.training import loop
from clothjax.training.labels import Labels
from clothjax.types import Array

SMALL = 0.3  # of the mean square of an ordinary change; frames that change less weigh no more
WIDER = 0.1  # of the range of the labels' codes, which Psi may go beyond at either end


class TrainingState(NamedTuple):
    """State of stage 2 at a step; resuming from it is exact."""

    step: Array  # int32
    key: Array
    params: dict
    average: dict
    optimizer: optax.OptState
    normalizers: ForceScales
    garment: dict  # the frozen decoder and blend shapes; with them, a checkpoint is a complete Psi


def blank(garment: dict, whitening: Whitening, constants: int, config: Config) -> TrainingState:
    """Return the state without any labels: its Psi holds the code.

    Args:
        garment: parameters of the decoder.
        constants: number of the constant inputs.
    """
    latent = len(whitening.to)
    size = (2 + len(KINDS)) * latent + constants
    key, model_key = jax.random.split(jax.random.key(config.labels.seed))
    params = mlp.init(ForcePsi(config.stage2, latent), model_key, jnp.zeros(size))
    params = params | {"linear": jax.tree.map(jnp.zeros_like, params["linear"])}
    far = jnp.full(latent, 1e6)
    whitening = jax.tree.map(jnp.array, whitening)
    scales = ForceScales(jnp.zeros(size), jnp.ones(size), jnp.float32(0.0), whitening, -far, jnp.array(far))
    average = jax.tree.map(jnp.array, params)
    garment = jax.tree.map(jnp.array, garment)
    return TrainingState(jnp.int32(0), key, params, average, optimizer(config).init(params), scales, garment)


def first(state: TrainingState, labels: Labels, config: Config) -> TrainingState:
    """Return the state before the first training step: scales measured on the labels, the linear map by ridge."""
    scales = measure(labels, state.normalizers.whitening)
    inputs, targets = (np.asarray(part, np.float64) for part in examples(labels, scales))
    weights = weight(targets)[:, None]
    bordered = np.concatenate([inputs, np.ones((len(inputs), 1))], axis=1)
    penalty = np.diag([config.labels.ridge] * inputs.shape[1] + [1e-3])
    solution = np.linalg.solve((weights * bordered).T @ bordered + penalty, (weights * bordered).T @ targets)
    linear = {"kernel": jnp.asarray(solution[:-1], jnp.float32), "bias": jnp.asarray(solution[-1], jnp.float32)}
    params = state.params | {"linear": linear}
    return state._replace(params=params, average=jax.tree.map(jnp.array, params), normalizers=scales)


def measure(labels: Labels, whitening: Whitening) -> ForceScales:
    """Measure the scales of labels. Medians and quantiles: forces of contact have long tails."""
    inputs = _inputs(labels, whitening)
    middle = np.median(inputs, axis=0)
    quantile = np.quantile(np.abs(inputs - middle), 0.84, axis=0)
    spread = np.maximum(np.minimum(inputs.std(axis=0), 1.5 * quantile), 1e-6)
    size = np.median(np.sqrt(np.mean(_changes(labels, whitening) ** 2, axis=1)))
    low, high = labels.target.min(axis=0), labels.target.max(axis=0)
    margin = WIDER * (high - low)
    numbers = (jnp.asarray(x, jnp.float32) for x in (middle, spread, size))
    return ForceScales(*numbers, whitening, jnp.asarray(low - margin), jnp.asarray(high + margin))


def examples(labels: Labels, scales: ForceScales) -> tuple[np.ndarray, np.ndarray]:
    """Return scaled inputs [n, N] and targets [n, L] of the labels."""
    inputs = jax.vmap(psi.scaled_inputs, (None, 0))(scales, _inputs(labels, scales.whitening))
    return np.asarray(inputs), _changes(labels, scales.whitening) / np.float32(scales.output)


def _changes(labels: Labels, whitening: Whitening) -> np.ndarray:
    """Return the changes [n, L] sqrt(J) of the whitened code that the labels ask for."""
    return (labels.target - labels.code) @ np.asarray(whitening.to)


def _inputs(labels: Labels, whitening: Whitening) -> np.ndarray:
    """Return `psi.force_inputs` of all labels."""
    rows = jax.vmap(psi.force_inputs, (0, 0, 0, 0, None))
    return np.asarray(rows(labels.code, labels.change, labels.forces, labels.constants, whitening))


def weight(targets: Array) -> Array:
    """Return weights [n] of frames by their targets [n, L]: large changes must not drown small ones."""
    return 1.0 / (SMALL + (targets**2).mean(axis=-1))


def optimizer(config: Config) -> optax.GradientTransformation:
    """Build AdamW, whose rate falls to zero along a cosine in every round."""
    settings = config.labels

    def rate(step):
        return settings.learning_rate * 0.5 * (1.0 + jnp.cos(jnp.pi * (step % settings.steps) / settings.steps))

    return optax.adamw(rate, weight_decay=settings.decay)


def make_update(
    labels: Labels, scales: ForceScales, config: Config, steps: int, device_mesh: Mesh | None = None
) -> Callable[[TrainingState], tuple[TrainingState, dict[str, Array]]]:
    """Return a jitted function that takes `steps` training steps, and their metrics [steps].

    The loss is the squared error of the whitened change, relative to its size. The function consumes its argument.
    """
    settings, transform = config.labels, optimizer(config)
    network = ForcePsi(config.stage2, labels.code.shape[1])
    data = tuple(jnp.asarray(part) for part in examples(labels, scales))

    def loss(params, data, key):
        rows = jax.random.randint(key, (settings.batch,), 0, len(data[0]))
        inputs, targets = (part[rows] for part in data)
        errors = jnp.mean((mlp.apply(network, params, inputs) - targets) ** 2, axis=-1)
        return jnp.mean(weight(targets) * errors)

    def train_step(data, state: TrainingState):
        key = jax.random.fold_in(state.key, state.step)
        value, gradient = jax.value_and_grad(loss)(state.params, data, key)
        return loop.apply_gradient(transform, state, value, gradient, ema=0.99)

    return loop.scan_steps(train_step, data, steps, device_mesh)
