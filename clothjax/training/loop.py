"""The one training loop: progress, metrics, checkpoints, exact resume, and a stop where training diverges."""

import contextlib
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.experimental import multihost_utils
from tqdm import tqdm

from clothjax import progress
from clothjax.files import checkpoint
from clothjax.training import run_folder

State = TypeVar("State")
MAX_NONFINITE = 10  # skipped steps in a row that are put up with
Metrics = dict[str, Any]


class Fitted(NamedTuple):
    """A finished training."""

    state: Any
    seconds: float  # in calls of `update`, over all sessions, without compilation
    compile_seconds: float  # the first call of each session, until it returned


class _Call(NamedTuple):
    state: Any
    step: int  # after the call
    metrics: Metrics
    seconds: float  # without compilation
    compile_seconds: float  # zero but for the first


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
    evaluate: Callable[[State], dict[str, float]] | None = None,
    evaluate_steps: int = 1000,
    checkpoint_seconds: float = 120.0,
    keep: int = 3,
    report_seconds: float = 10.0,
    max_nonfinite: int = MAX_NONFINITE,
) -> Fitted:
    """Trains to `steps`, going on from the directory's newest checkpoint if there is one.

    The directory gets `checkpoints/`, `metrics.jsonl` (one line a call: the median of every metric, its
    maximum as `<name>_max`, the number of `nonfinite` steps, what `evaluate` returns) and `training.json`
    (steps and seconds). All that the training depends on is in the state, so a run that is stopped at any
    moment and resumed ends bit for bit as one that was not.

    Args:
        update: a jitted function that takes `steps_per_call` steps; it may donate its argument. Its metrics
            are arrays [steps_per_call], among them `loss` and, if it skips updates with non-finite gradients,
            `nonfinite`, which is not zero at these steps. Choose them for calls of about a second.
        state: the first state, a pytree with an integer `step` as a key or a field. It is used up.
        config: what determines the training, as `configuration.to_dict` gives it; kept in every checkpoint.
        description: one line for a person, kept there too.
        may_differ: dotted names in `config` whose values may change between the sessions of a run.
        evaluate: figures of a state, taken about every `evaluate_steps` steps.
        checkpoint_seconds: between two checkpoints, of which `keep` are kept; there is always one at the end.
        report_seconds: between two lines where there is no terminal to show a bar on.
        max_nonfinite: skipped steps in a row that are put up with.

    Raises:
        ValueError: if the directory belongs to a run of another configuration or one under way, or if
            `update` does not keep to the above.
        FloatingPointError: if training diverges; the last good checkpoint stays.
        SystemExit: after SIGINT or SIGTERM, with a checkpoint saved.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    checkpoints = directory / "checkpoints"
    config = json.loads(json.dumps(config))  # as it will be read back
    leader = jax.process_index() == 0  # of several processes, the one that keeps records
    lock = run_folder.lock(directory) if leader else contextlib.nullcontext()
    stop = 0
    with lock, _interrupts() as interrupted, _advice(checkpoints):
        state = _resume(checkpoints, state, config, may_differ)
        first = _step(state)
        seconds, compile_seconds = run_folder.read_seconds(directory) if first else (0.0, 0.0)
        rows = run_folder.metrics_file(directory, first) if leader else contextlib.nullcontext(lambda row: None)
        saved = time.monotonic()
        with rows as write, _progress(first, steps, report_seconds) as report:
            for call in _calls(update, state, first, steps, steps_per_call, max_nonfinite):
                state = call.state
                seconds, compile_seconds = seconds + call.seconds, compile_seconds + call.compile_seconds
                figures = _figures(call.metrics)
                if evaluate and call.step // evaluate_steps > (call.step - steps_per_call) // evaluate_steps:
                    figures |= {name: float(value) for name, value in evaluate(state).items()}
                write({"step": call.step, "seconds": round(seconds, 3)} | figures)
                if leader:
                    run_folder.write_seconds(directory, seconds, compile_seconds, call.step, steps)
                report(call, figures["loss"])
                stop = _anywhere(interrupted())
                due = _anywhere(time.monotonic() - saved >= checkpoint_seconds)
                if stop or due or call.step == steps:
                    _save(checkpoints, call, config, description, keep)
                    saved = time.monotonic()
                if stop:
                    break
    if stop:
        name = signal.Signals(stop).name
        progress.say(f"{name}: saved step {call.step} of {steps} in {directory}; run the same command again to go on")
        raise SystemExit(128 + stop)
    return Fitted(state, seconds, compile_seconds)


class Weights(NamedTuple):
    """What gradient descent changes."""

    params: Any
    average: Any  # exponential moving average of params
    optimizer: optax.OptState


def update_weights(
    transform: optax.GradientTransformation, weights: Weights, loss: jax.Array, gradient: Any, ema: float
) -> tuple[Weights, Metrics]:
    """One step of gradient descent; where the loss or a gradient is not finite, none.

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


def _calls(
    update: Callable, state: Any, step: int, steps: int, steps_per_call: int, max_nonfinite: int
) -> Iterator[_Call]:
    """Calls `update` up to `steps`, and checks what comes back."""
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
        yield _Call(state, step, metrics, seconds - compile_seconds, compile_seconds)


def check_finite(metrics: Metrics, step: int, skipped: int, allowed: int) -> int:
    """The skipped steps in a row at the end of a call, given those before it.

    A step that was skipped did no harm, whatever its loss; one that was not and has no finite loss did.
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
    """Which metrics were not finite at a step of a call."""
    wrong = [name for name in metrics if name != "loss" and not np.isfinite(metrics[name][index])]
    return f" (not finite: {', '.join(wrong)})" if wrong else ""


def _step(state: Any) -> int:
    return int(state["step"] if isinstance(state, dict) else state.step)


def _figures(metrics: Metrics) -> dict[str, float]:
    """One number or two for each metric of a call, over its finite values."""
    figures = {}
    for name, values in metrics.items():
        if name == "nonfinite":
            figures[name] = int(np.count_nonzero(values))
            continue
        finite = values[np.isfinite(values)]
        figures[name] = float(np.median(finite)) if finite.size else math.nan
        figures[f"{name}_max"] = float(np.max(finite)) if finite.size else math.nan
    return figures


def _resume(checkpoints: Path, state: Any, config: dict, may_differ: tuple[str, ...]) -> Any:
    """The state of the newest undamaged checkpoint of this run; `state` where there is none yet."""
    newest = max(checkpoint.steps(checkpoints), default=0)
    if newest != _anywhere(newest) or newest != -_anywhere(-newest):
        raise ValueError(f"{checkpoints.parent} must be on a file system that all processes of a training share")
    if not checkpoint.steps(checkpoints):
        return state
    stored, here = _flat(checkpoint.latest(checkpoints).config), _flat(config)
    differ = [
        f"{name}: {stored.get(name, 'absent')} there, {here.get(name, 'absent')} here"
        for name in sorted(stored.keys() | here.keys())
        if stored.get(name, "absent") != here.get(name, "absent")
        and not any(name == free or name.startswith(f"{free}.") for free in may_differ)
    ]
    if differ:
        raise ValueError(
            f"{checkpoints.parent} holds a run of another configuration ({'; '.join(differ)}): "
            "use another directory, or remove this one"
        )
    state, found = checkpoint.restore(checkpoints, state)
    if jax.process_index() == 0:
        checkpoint.set_aside(checkpoints, found.step)
    progress.say(f"going on from step {found.step} in {checkpoints.parent}")
    return state


def _flat(config: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(config, dict):
        return {prefix: config}
    return {k: v for key in config for k, v in _flat(config[key], f"{prefix}.{key}" if prefix else key).items()}


def _save(checkpoints: Path, call: _Call, config: dict, description: str, keep: int) -> None:
    """A checkpoint, unless there is a NaN in the state."""
    leaves = jax.tree_util.tree_flatten_with_path(call.state)[0]
    named = {jax.tree_util.keystr(path): leaf for path, leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.inexact)}
    bad = [name for name, found in jax.device_get(_any_nan(named)).items() if found]
    if bad:
        raise FloatingPointError(f"the state of step {call.step} has NaN in {', '.join(bad[:5])}")
    checkpoint.save(checkpoints, call.step, call.state, config, description, keep=keep)


@jax.jit
def _any_nan(named: dict[str, jax.Array]) -> dict[str, jax.Array]:
    return {name: jnp.any(jnp.isnan(leaf)) for name, leaf in named.items()}


@contextlib.contextmanager
def _advice(checkpoints: Path) -> Iterator[None]:
    """Adds to a divergence what is left and what to do."""
    try:
        yield
    except FloatingPointError as error:
        steps = checkpoint.steps(checkpoints)
        left = f"the last good checkpoint is {checkpoints / str(steps[-1])}" if steps else "there is no checkpoint"
        raise FloatingPointError(
            f"training diverged: {error}; {left}. Train in another directory with a lower learning rate"
        ) from error


@contextlib.contextmanager
def _interrupts() -> Iterator[Callable[[], int]]:
    """A function that says which of SIGINT and SIGTERM has come, or 0. A second signal acts at once."""
    received = []
    before = {}

    def note(number: int, frame: Any) -> None:
        received.append(number)
        signal.signal(number, before[number])
        os.write(2, b"\nstopping after this call; once more to stop without saving\n")

    if threading.current_thread() is threading.main_thread():  # elsewhere Python does not allow handlers
        before.update({number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)})
    try:
        yield lambda: received[0] if received else 0
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def _progress(first: int, steps: int, every: float) -> Iterator[Callable[[_Call, float], None]]:
    """A function to report calls to: it moves a bar on a terminal, and writes lines elsewhere."""
    terminal = sys.stdout.isatty()
    seconds, spoken = 0.0, time.monotonic()
    if jax.process_index() != 0:
        yield lambda call, loss: None
        return
    if first < steps:
        progress.say(f"training from step {first} to {steps}; compiling first")

    def report(call: _Call, loss: float) -> None:
        nonlocal seconds, spoken
        seconds += call.seconds
        if call.compile_seconds:
            (bar.write if terminal else progress.say)(f"compiled in {call.compile_seconds:.1f} s")
        bar.set_postfix(loss=f"{loss:.4g}", refresh=False)
        bar.update(call.step - bar.n)
        if not terminal and (call.step == steps or time.monotonic() - spoken >= every):
            spoken = time.monotonic()
            rate = (call.step - first) / max(seconds, 1e-9)
            left = tqdm.format_interval((steps - call.step) / rate)
            progress.say(f"step {call.step}/{steps}  loss {loss:.4g}  {rate:.4g} steps/s  {left} left")

    with tqdm(total=steps, initial=first, unit="step", file=sys.stdout, disable=not terminal) as bar:
        yield report


def _anywhere(flag: int) -> int:
    """The largest of the processes' flags, so that all of them take the same turn."""
    if jax.process_count() == 1:
        return flag
    return int(np.max(multihost_utils.process_allgather(np.int32(flag))))
