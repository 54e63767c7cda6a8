"""Stage 2 of a Psi with forces: regression on labelled frames, round after round (METHOD.md, Psi with forces)."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from clothjax.config import Config
from clothjax.networks import mlp, psi
from clothjax.networks.normalisation import ForceScales, Whitening
from clothjax.networks.psi import ForcePsi
from clothjax.training import loop
from clothjax.training.labels import Labels
from clothjax.types import Array

SMALL = 0.3  # of the mean square of an ordinary change; frames that change less weigh no more
WIDER = 0.1  # of the range of the labels' codes, which Psi may go beyond at either end
SETTLING = 0.35  # share of the training steps of all rounds, the last ones, in which the rate falls (not `anew`), ...
LAST_SETTLING = 0.6  # ... and of those on all frames
OWN_RIDGE, BIAS_RIDGE = 10.0, 1e-3  # penalties on what the linear map takes of a direction's own inputs, and on biases


class Data(NamedTuple):
    """The frames to learn from: those of the rounds so far, in arrays that have room for all rounds."""

    inputs: Array  # [n, N] of `psi.scaled_inputs`
    targets: Array  # [n, L] whitened changes over `ForceScales.output`
    count: Array  # int32, of the frames that are there
    low: Array  # [L] the least code that Psi may give, from those frames, and ...
    high: Array  # [L] ... the greatest


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
    size = psi.DIRECTED * latent + constants
    key, model_key = jax.random.split(jax.random.key(config.labels.seed))
    params = mlp.init(ForcePsi(config.stage2, latent, constants), model_key, jnp.zeros(size))
    params = params | {"linear": jax.tree.map(jnp.zeros_like, params["linear"])}
    far = jnp.full(latent, 1e6)
    whitening = jax.tree.map(jnp.array, whitening)
    scales = ForceScales(jnp.zeros(size), jnp.ones(size), jnp.float32(0.0), whitening, -far, jnp.array(far))
    average = jax.tree.map(jnp.array, params)
    garment = jax.tree.map(jnp.array, garment)
    return TrainingState(jnp.int32(0), key, params, average, optimizer(config).init(params), scales, garment)


def first(state: TrainingState, labels: Labels) -> TrainingState:
    """Return the state before the first training step: scales measured on the labels."""
    return state._replace(normalizers=measure(labels, state.normalizers.whitening))


def measure(labels: Labels, whitening: Whitening) -> ForceScales:
    """Measure the scales of labels. Medians and quantiles: forces of contact have long tails."""
    inputs = _inputs(labels, whitening)
    middle = np.median(inputs, axis=0)
    quantile = np.quantile(np.abs(inputs - middle), 0.84, axis=0)
    spread = np.maximum(np.minimum(inputs.std(axis=0), 1.5 * quantile), 1e-6)
    size = np.median(np.sqrt(np.mean(_changes(labels, whitening) ** 2, axis=1)))
    middle, spread, size = (jnp.asarray(x, jnp.float32) for x in (middle, spread, size))
    low, high = map(jnp.asarray, _range(labels))
    return ForceScales(middle, spread, size, whitening, low, high)


def room(labels: Labels, scales: ForceScales, config: Config) -> Data:
    """Return data without frames, with room for as many rounds as the first one's labels."""
    rows = config.labels.rounds * len(labels.code)
    inputs, targets = jnp.zeros((rows, len(scales.middle))), jnp.zeros((rows, len(scales.low)))
    return Data(inputs, targets, jnp.int32(0), jnp.array(scales.low), jnp.array(scales.high))


def extended(data: Data, labels: Labels, scales: ForceScales) -> Data:
    """Return data with the frames of one more round, and with its codes in the range; `data` is used up."""
    inputs, targets = examples(labels, scales)
    low, high = _range(labels)
    return Data(
        inputs=_put(data.inputs, inputs, data.count),
        targets=_put(data.targets, targets, data.count),
        count=data.count + len(inputs),
        low=jnp.minimum(data.low, low),
        high=jnp.maximum(data.high, high),
    )


@partial(jax.jit, donate_argnums=0)
def _put(rows: Array, new: Array, begin: Array) -> Array:
    return jax.lax.dynamic_update_slice(rows, new, (begin, 0))


def _range(labels: Labels) -> tuple[Array, Array]:
    """Return the least and greatest codes [L] that Psi may give, from those of the labels."""
    low, high = labels.target.min(axis=0), labels.target.max(axis=0)
    margin = WIDER * (high - low)
    return low - margin, high + margin


def examples(labels: Labels, scales: ForceScales) -> tuple[np.ndarray, np.ndarray]:
    """Return scaled inputs [n, N] and targets [n, L] of the labels."""
    inputs = jax.vmap(psi.scaled_inputs, (None, 0))(scales, _inputs(labels, scales.whitening))
    return np.asarray(inputs), _changes(labels, scales.whitening) / np.float32(scales.output)


def _changes(labels: Labels, whitening: Whitening) -> np.ndarray:
    """Return the changes [n, L] sqrt(J) of the whitened code that the labels ask for."""
    return np.asarray(labels.target - labels.code) @ np.asarray(whitening.to)


def _inputs(labels: Labels, whitening: Whitening) -> np.ndarray:
    """Return `psi.force_inputs` of all labels."""
    rows = jax.vmap(psi.force_inputs, (0, 0, 0, 0, None))
    return np.asarray(rows(labels.code, labels.change, labels.forces, labels.constants, whitening))


def weight(targets: Array) -> Array:
    """Return weights [n] of frames by their targets [n, L]: large changes must not drown small ones."""
    return 1.0 / (SMALL + (targets**2).mean(axis=-1))


def optimizer(config: Config, last: bool = False) -> optax.GradientTransformation:
    """Build AdamW, whose rate stays and then falls along a line to zero: at the end of all rounds, or of the `last`.

    Where each round begins anew (`labels.anew`), its steps count from 0: the rate falls in the `last` training alone. A
    linear map that stays as it is does not decay.
    """
    settings = config.labels
    steps, settling = settings.rounds * settings.steps, SETTLING
    if last:
        steps, settling = settings.last_steps, LAST_SETTLING

    def rate(step):
        return settings.learning_rate * jnp.clip((1.0 - step / steps) / settling, 0.0, 1.0)

    def learnt(params: dict) -> dict:
        all_of_it = jax.tree.map(lambda _: True, params)
        return all_of_it | {"linear": jax.tree.map(lambda _: not stays(config, last), params["linear"])}

    return optax.adamw(rate, weight_decay=settings.decay, mask=learnt)


def stays(config: Config, last: bool) -> bool:
    """Return whether training leaves the linear map as it is: where each round, or the `last` training, begins anew."""
    return config.labels.anew or last


def anew(state: TrainingState, data: Data, network: ForcePsi, config: Config, last: bool) -> TrainingState:
    """Return the state from which frames are learnt: the linear map is `linear_map`, all else drawn anew.

    A network that learnt the frames of the first rounds first, and longest, generalises worse (Ash & Adams 2020).
    """
    key = jax.random.fold_in(state.key, state.step)
    linear = linear_map(data, state.normalizers, config)
    params = mlp.init(network, key, jnp.zeros(len(state.normalizers.middle))) | {"linear": linear}
    return state._replace(params=params, average=params, optimizer=optimizer(config, last).init(params))


def linear_map(data: Data, scales: ForceScales, config: Config) -> dict[str, Array]:
    """Return the linear map of the frames that are there, with the weights of the loss.

    A direction's change depends most on its own code, change and forces. Their coefficients are least squares; ridge
    regression of what they leave gives the others. Its penalty is of inputs in their own units: what varies little,
    tells little.
    """
    rounds, count = config.labels.rounds, len(data.inputs)
    there = (jnp.arange(count) < data.count).astype(jnp.float32)[:, None]
    rows = jax.tree.map(lambda x: x.reshape(rounds, count // rounds, -1), (data.inputs, data.targets, there))

    def add(sums: tuple[Array, Array], row: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
        inputs, targets, there = row
        bordered = jnp.concatenate([inputs, there], axis=1)
        weighted = bordered * (there[:, 0] * weight(targets))[:, None]
        squares, products = (jnp.matmul(weighted.T, x, precision="highest") for x in (bordered, targets))
        return (sums[0] + squares, sums[1] + products), None

    size = data.inputs.shape[1]
    (squares, products), _ = jax.lax.scan(
        add, (jnp.zeros((size + 1, size + 1)), jnp.zeros((size + 1, data.targets.shape[1]))), rows
    )
    latent = data.targets.shape[1]

    def solved(squares: Array, products: Array, penalty: Array) -> Array:
        return jax.scipy.linalg.solve(squares + jnp.diag(jnp.append(penalty, BIAS_RIDGE)), products, assume_a="pos")

    def of_own(own: Array, of_one: Array) -> Array:
        coefficients = solved(squares[jnp.ix_(own, own)], of_one[own], jnp.full(psi.DIRECTED, OWN_RIDGE))
        return jnp.zeros_like(of_one).at[own].set(coefficients)

    own = np.arange(psi.DIRECTED * latent).reshape(psi.DIRECTED, latent).T  # inputs of each direction, ...
    own = np.append(own, np.full((latent, 1), size), axis=1)  # ... and its bias
    solution = jax.vmap(of_own, in_axes=(0, 1), out_axes=1)(jnp.asarray(own), products)
    left = products - jnp.matmul(squares, solution, precision="highest")
    spread = scales.spread[: psi.DIRECTED * latent].reshape(psi.DIRECTED, latent)
    uneven = jnp.mean(spread**2, axis=1, keepdims=True) / spread**2
    penalty = jnp.append(uneven.reshape(-1), jnp.ones(size - uneven.size))
    solution += solved(squares, left, config.labels.ridge * penalty)
    return {"kernel": solution[:-1], "bias": solution[-1]}


def make_update(
    latent: int, constants: int, config: Config, steps: int, device_mesh: Mesh | None = None, last: bool = False
) -> Callable[[Data, TrainingState], tuple[TrainingState, dict[str, Array]]]:
    """Return a jitted function that takes `steps` training steps on data; it returns their metrics [steps] too.

    The loss is the squared error of the whitened change, relative to its size. The function consumes the state.

    Args:
        latent, constants: L and C.
        last: the training on all frames, after the last round.
    """
    settings, transform = config.labels, optimizer(config, last)
    network = ForcePsi(config.stage2, latent, constants)
    begin = settings.rounds * settings.steps if last else 0

    def train_step(data: Data, state: TrainingState):
        of_round = (state.step - begin) % settings.steps if settings.anew and not last else state.step - begin
        state = jax.lax.cond(
            of_round == 0, lambda before: anew(before, data, network, config, last), lambda same: same, state
        )
        key = jax.random.fold_in(state.key, state.step)
        rows = jax.random.randint(key, (settings.batch,), 0, data.count)
        inputs, targets = data.inputs[rows], data.targets[rows]

        dropout = {"rngs": {"dropout": jax.random.fold_in(key, 1)}} if config.stage2.gated else {}

        def loss(params):
            if stays(config, last):
                params = params | {"linear": jax.lax.stop_gradient(params["linear"])}
            errors = jnp.mean((mlp.apply(network, params, inputs, **dropout) - targets) ** 2, axis=-1)
            return jnp.mean(weight(targets) * errors)

        value, gradient = jax.value_and_grad(loss)(state.params)
        scales = state.normalizers
        scales = scales._replace(low=jnp.minimum(scales.low, data.low), high=jnp.maximum(scales.high, data.high))
        state = state._replace(normalizers=scales)
        return loop.apply_gradient(transform, state, value, gradient, ema=0.997)

    return loop.scan_steps(train_step, steps, device_mesh)
