"""The training loop of all stages: progress, metrics, checkpoints, exact resume, a stop when training diverges."""

import contextlib
import json
import math
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from clothjax import progress
from clothjax.files import checkpoint
from clothjax.training import devices, run_folder, session
from clothjax.training.session import Call

State = TypeVar("State")
Data = TypeVar("Data")
MAX_NONFINITE = 10  # skipped steps in a row that are tolerated
Metrics = dict[str, Any]


class Fitted(NamedTuple):
    """The state of a training, and the time that it took so far: what `fit` returns."""

    state: Any
    seconds: float  # in calls of `update`, over all sessions, without compilation
    compile_seconds: float  # the first call of each session, until it returned

    def after(self, call: Call) -> "Fitted":
        """Return this training after one more call of `update`."""
        return Fitted(call.state, self.seconds + call.seconds, self.compile_seconds + call.compile_seconds)


def fit(
    update: Callable[[State], tuple[State, Metrics]],
    state: State,
    *,
    steps: int,
    steps_per_call: int,
    directory: str | Path,
    config: dict,
    description: str = "",
    may_differ: tuple[str, ...] = (),
    checkpoint_seconds: float = 120.0,
    report_seconds: float = 10.0,
    max_nonfinite: int = MAX_NONFINITE,
) -> Fitted:
    """Train to `steps`, from the directory's newest checkpoint if there is one.

    The directory gets `checkpoints/`, `metrics.jsonl` and `training.json` (steps and seconds). A line of the metrics
    is a call: the median of every metric, its maximum as `<name>_max`, the number of `nonfinite` steps. The training
    depends on nothing but the state: a run that is stopped at any moment and resumed ends bit for bit as one that was
    not.

    Args:
        update: a jitted function that takes `steps_per_call` steps; it may donate its argument. Its metrics
            are arrays [steps_per_call], among them `loss` and, if it skips updates with non-finite gradients,
            `nonfinite`, which is not zero at these steps. Choose `steps_per_call` for calls of about a second.
        state: the first state, a pytree with an integer `step` as a key or a field. It is used up.
        config: what determines the training, as `configuration.to_dict` gives it; stored in every checkpoint.
        description: one line for a person, stored there too.
        may_differ: dotted names in `config` whose values may change between the sessions of a run.
        checkpoint_seconds: between two checkpoints; there is always one at the end.
        report_seconds: between two lines where there is no terminal to show a bar on.
        max_nonfinite: skipped steps in a row that are tolerated.

    Raises:
        ValueError: if the directory belongs to a run of another configuration or one under way, or if
            `update` is not as described.
        FloatingPointError: if training diverges; the last good checkpoint stays.
        SystemExit: after SIGINT or SIGTERM, with a checkpoint saved.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    checkpoints = directory / "checkpoints"
    config = json.loads(json.dumps(config))  # as it will be read back
    lock = run_folder.lock(directory) if _keeps_records() else contextlib.nullcontext()
    stop = 0
    with lock, session.interrupts() as interrupted, _advice(checkpoints):
        fitted = _resume(directory, state, config, may_differ)
        saved = time.monotonic()
        with _records(directory, _step(fitted.state), steps, report_seconds) as record:
            for call in _calls(update, fitted.state, steps, steps_per_call, max_nonfinite):
                fitted = fitted.after(call)
                record(call, fitted, _figures(call.metrics))
                stop = _anywhere(interrupted())
                due = _anywhere(time.monotonic() - saved >= checkpoint_seconds)
                if stop or due or call.step == steps:
                    _save(checkpoints, call, config, description)
                    saved = time.monotonic()
                if stop:
                    break
        stop = stop or _anywhere(interrupted())  # one that came during the last save, or as a finished one was read
    if stop:
        name = signal.Signals(stop).name
        progress.say(
            f"{name}: saved step {_step(fitted.state)} of {steps} in {directory}; run the same command again to go on"
        )
        raise SystemExit(128 + stop)
    return fitted


class Weights(NamedTuple):
    """The part of a training state that gradient descent changes: pytrees of one structure, and the optimiser's."""

    params: Any
    average: Any  # exponential moving average of params
    optimizer: optax.OptState


def update_weights(
    transform: optax.GradientTransformation, weights: Weights, loss: jax.Array, gradient: Any, ema: float
) -> tuple[Weights, Metrics]:
    """Take one step of gradient descent, or none if the loss or a gradient is not finite.

    Args:
        gradient: of `loss`, like weights.params; ema: decay of the average in a step.

    Returns:
        The weights, and the metrics `loss`, `gradient_norm` and `nonfinite` that `fit` looks for.
    """
    norm = optax.tree.norm(gradient)
    good = jnp.isfinite(norm) & jnp.isfinite(loss)

    def step(weights: Weights) -> Weights:
        with jax.numpy_dtype_promotion("standard"):  # optax raises floats to integer powers
            updates, optimizer = transform.update(gradient, weights.optimizer, weights.params)
        params = optax.apply_updates(weights.params, updates)
        average = jax.tree.map(lambda a, p: ema * a + (1 - ema) * p, weights.average, params)
        return Weights(params, average, optimizer)

    # a branch, not a select of every array: half the program to compile
    weights = jax.lax.cond(good, step, lambda same: same, weights)
    return weights, {"loss": loss, "gradient_norm": norm, "nonfinite": ~good}


def apply_gradient(
    transform: optax.GradientTransformation, state: Any, loss: jax.Array, gradient: Any, ema: float
) -> tuple[Any, Metrics]:
    """Take `update_weights` on a training state: return the state one training step on, and the metrics.

    Args:
        state: a NamedTuple with the fields `step` and those of `Weights`.
        loss, gradient, ema: as of `update_weights`.
    """
    weights, metrics = update_weights(
        transform, Weights(state.params, state.average, state.optimizer), loss, gradient, ema
    )
    return state._replace(step=state.step + 1, **weights._asdict()), metrics


def scan_steps(
    train_step: Callable[[Data, State], tuple[State, Metrics]], steps: int, device_mesh: Mesh | None
) -> Callable[[Data, State], tuple[State, Metrics]]:
    """Return a jitted function of data and a state: it takes `steps` training steps, and donates the state.

    It returns the state after them, and their metrics [steps]. The data is the same on every device.

    Args:
        train_step: from the data and a state to the next state and its metrics.
    """

    @partial(jax.jit, donate_argnums=1, out_shardings=devices.replicated(device_mesh))
    def update(data, state):
        return jax.lax.scan(lambda state, _: train_step(data, state), state, None, length=steps)

    return update


def _calls(update: Callable, state: Any, steps: int, steps_per_call: int, max_nonfinite: int) -> Iterator[Call]:
    """Call `update` up to `steps`, and check what comes back."""
    step = _step(state)
    if steps_per_call < 1 or (steps - step) % steps_per_call:
        raise ValueError(f"steps_per_call {steps_per_call} does not divide the steps from {step} to {steps}")
    compile_seconds, skipped = None, 0
    while step < steps:
        began = time.monotonic()
        state, metrics = update(state)
        returned = time.monotonic()  # once compiled, a call returns at once and the device computes on
        metrics = {name: np.asarray(value) for name, value in jax.device_get(metrics).items()}
        seconds = time.monotonic() - began
        shapes = {name: value.shape for name, value in metrics.items()}
        if "loss" not in metrics or set(shapes.values()) != {(steps_per_call,)}:
            raise ValueError(f"`update` must return metrics [{steps_per_call}] with a `loss`, got {shapes}")
        if _step(state) != step + steps_per_call:
            raise ValueError(f"`update` went from step {step} to {_step(state)}, not {steps_per_call} steps on")
        skipped = check_finite(metrics, step, skipped, max_nonfinite)
        step += steps_per_call
        compile_seconds = returned - began if compile_seconds is None else 0.0
        yield Call(state, step, metrics, seconds - compile_seconds, compile_seconds)


def check_finite(metrics: Metrics, step: int, skipped: int, allowed: int) -> int:
    """Count the skipped steps in a row at the end of a call, given those before it.

    A skipped step does no harm, whatever its loss.

    Raises:
        FloatingPointError: for a step that was taken with a loss that is not finite, or too many skipped in a row.
    """
    bad_loss = ~np.isfinite(metrics["loss"])
    for i, flag in enumerate(metrics.get("nonfinite", np.zeros(bad_loss.shape))):
        now = step + i + 1
        if bad_loss[i] and not flag:
            raise FloatingPointError(f"the loss of step {now} is {metrics['loss'][i]}{_terms(metrics, i)}")
        skipped = skipped + 1 if flag else 0
        if skipped > allowed:
            raise FloatingPointError(
                f"steps {now - skipped + 1} to {now} had non-finite gradients, more than {allowed} in a row"
                f"{_terms(metrics, i)}"
            )
    return skipped


def _terms(metrics: Metrics, index: int) -> str:
    """Name the metrics that were not finite at a step of a call, for an error message."""
    wrong = [name for name in metrics if name != "loss" and not np.isfinite(metrics[name][index])]
    return f" (not finite: {', '.join(wrong)})" if wrong else ""


def _step(state: Any) -> int:
    return int(state["step"] if isinstance(state, dict) else state.step)


def _figures(metrics: Metrics) -> dict[str, float]:
    """Return the median and maximum of each metric of a call over its finite values; of `nonfinite`, the count."""
    figures = {}
    for name, values in metrics.items():
        if name == "nonfinite":
            figures[name] = int(np.count_nonzero(values))
            continue
        finite = values[np.isfinite(values)]
        figures[name] = float(np.median(finite)) if finite.size else math.nan
        figures[f"{name}_max"] = float(np.max(finite)) if finite.size else math.nan
    return figures


def _resume(directory: Path, state: Any, config: dict, may_differ: tuple[str, ...]) -> Fitted:
    """Find where training goes on, and the seconds that it took so far."""
    # Three cases, in this order:
    # 1. finished: the newest checkpoint is of the last step; it is read, and `fit` makes no call
    # 2. checkpoint: there is one of this run; training goes on from the newest that is undamaged
    # 3. start: there is none yet; training begins with `state`
    checkpoints = directory / "checkpoints"
    newest = max(checkpoint.steps(checkpoints), default=0)
    if newest != _anywhere(newest) or newest != -_anywhere(-newest):
        raise ValueError(f"{directory} must be on a file system that all processes of a training share")
    if not checkpoint.steps(checkpoints):
        return _so_far(directory, state)
    _check_config(directory, checkpoint.latest(checkpoints).config, config, may_differ)
    state, restored = checkpoint.restore(checkpoints, state)
    if _keeps_records():
        checkpoint.set_aside(checkpoints, restored.step)
    progress.say(f"going on from step {restored.step} in {directory}")
    return _so_far(directory, state)


def _so_far(directory: Path, state: Any) -> Fitted:
    return Fitted(state, *(run_folder.read_seconds(directory) if _step(state) else (0.0, 0.0)))


def _check_config(directory: Path, stored: dict, config: dict, may_differ: tuple[str, ...]) -> None:
    """Raise a ValueError if a run of another configuration is in the directory."""
    there, here = _flat(stored), _flat(config)
    differ = [
        f"{name}: {there.get(name, 'absent')} there, {here.get(name, 'absent')} here"
        for name in sorted(there.keys() | here.keys())
        if there.get(name, "absent") != here.get(name, "absent")
        and not any(name == free or name.startswith(f"{free}.") for free in may_differ)
    ]
    if differ:
        raise ValueError(
            f"{directory} holds a run of another configuration ({'; '.join(differ)}): "
            "use another directory, or remove this one"
        )


@contextlib.contextmanager
def _records(
    directory: Path, first: int, steps: int, report_seconds: float
) -> Iterator[Callable[[Call, Fitted, dict[str, float]], None]]:
    """Yield a function that records a call, the training so far and the call's figures, in files and on the screen."""
    if not _keeps_records():
        yield lambda *_: None
        return
    with (
        run_folder.metrics_file(directory, first) as write,
        session.progress_report(first, steps, report_seconds) as report,
    ):

        def record(call: Call, fitted: Fitted, figures: dict[str, float]) -> None:
            write({"step": call.step, "seconds": round(fitted.seconds, 3)} | figures)
            run_folder.write_seconds(directory, fitted.seconds, fitted.compile_seconds, call.step, steps)
            report(call, figures["loss"])

        yield record


def _keeps_records() -> bool:
    """Return whether this is the process, of several, that keeps the run's folder."""
    return jax.process_index() == 0


def _flat(config: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(config, dict):
        return {prefix: config}
    return {k: v for key in config for k, v in _flat(config[key], f"{prefix}.{key}" if prefix else key).items()}


def _save(checkpoints: Path, call: Call, config: dict, description: str) -> None:
    """Save a checkpoint; raise a FloatingPointError if there is a NaN in the state."""
    leaves = jax.tree_util.tree_flatten_with_path(call.state)[0]
    named = {jax.tree_util.keystr(path): leaf for path, leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.inexact)}
    bad = [name for name, has_nan in jax.device_get(_any_nan(named)).items() if has_nan]
    if bad:
        raise FloatingPointError(f"the state of step {call.step} has NaN in {', '.join(bad[:5])}")
    checkpoint.save(checkpoints, call.step, call.state, config, description)


@jax.jit
def _any_nan(named: dict[str, jax.Array]) -> dict[str, jax.Array]:
    return {name: jnp.any(jnp.isnan(leaf)) for name, leaf in named.items()}


@contextlib.contextmanager
def _advice(checkpoints: Path) -> Iterator[None]:
    """Add to the error of a divergence which checkpoint is left and what to do."""
    try:
        yield
    except FloatingPointError as error:
        steps = checkpoint.steps(checkpoints)
        left = f"the last good checkpoint is {checkpoints / str(steps[-1])}" if steps else "there is no checkpoint"
        raise FloatingPointError(
            f"training diverged: {error}; {left}. Train in another directory with a lower learning rate"
        ) from error


def _anywhere(flag: int) -> int:
    """Return the largest flag that any process of this training gives: all processes then decide alike."""
    if jax.process_count() == 1:
        return flag
    return int(np.max(multihost_utils.process_allgather(np.int32(flag))))
