"""The training loop on a toy: linear regression with noise drawn from the state's key."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import faults
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from clothjax.files import checkpoint
from clothjax.training import loop

SGD = optax.adam(1e-2)
CONFIG = {"train": {"rate": 1e-2, "steps": 40}, "hidden": (3, 4)}


class State(NamedTuple):
    step: jax.Array
    key: jax.Array
    params: dict
    optimizer: optax.OptState


def initial() -> State:
    params = {"w": jnp.zeros(3)}
    return State(jnp.int32(0), jax.random.key(0), params, SGD.init(params))


def one(bad_steps, state, _):
    """A training step; its gradient is not finite, and skipped, at the steps after `bad_steps`."""
    key = jax.random.fold_in(state.key, state.step)
    x = jax.random.normal(key, (8, 3))

    def loss(params):
        return jnp.mean((x @ params["w"] - x @ jnp.array([1.0, -2.0, 0.5])) ** 2)

    value, gradient = jax.value_and_grad(loss)(state.params)
    gradient = jax.tree.map(lambda g: jnp.where(jnp.any(state.step == bad_steps), jnp.nan, g), gradient)
    good = jnp.all(jnp.isfinite(gradient["w"]))
    with jax.numpy_dtype_promotion("standard"):
        updates, optimizer = SGD.update(gradient, state.optimizer, state.params)
    new = (optax.apply_updates(state.params, updates), optimizer)
    params, optimizer = jax.tree.map(partial(jnp.where, good), new, (state.params, state.optimizer))
    term = jnp.where(good, value, jnp.inf)
    return State(state.step + 1, state.key, params, optimizer), {"loss": value, "stretching": term, "nonfinite": ~good}


@lru_cache  # compiled once
def make_update(steps=4, bad_steps=(-1,), slow=0.0):
    @partial(jax.jit, donate_argnums=0)
    def update(state):
        return jax.lax.scan(partial(one, jnp.array(bad_steps)), state, None, length=steps)

    def slowly(state):
        time.sleep(slow)
        return update(state)

    return slowly if slow else update


def train(directory, update=None, config=CONFIG, **options):
    options = {"steps": 40, "steps_per_call": 4, "directory": directory, "config": config} | options
    return loop.fit(update or make_update(), options.pop("state", None) or initial(), **options)


def rows(directory):
    return [json.loads(line) for line in (directory / "metrics.jsonl").read_text().splitlines()]


def assert_same(a, b):
    np.testing.assert_array_equal(jax.random.key_data(a.key), jax.random.key_data(b.key))
    for x, y in zip(jax.tree.leaves(a._replace(key=None)), jax.tree.leaves(b._replace(key=None))):
        np.testing.assert_array_equal(x, y)


@pytest.fixture(scope="module")
def straight(tmp_path_factory):
    """Forty steps without a stop."""
    directory = tmp_path_factory.mktemp("straight")
    return train(directory).state, rows(directory)


def test_training_records_what_it_did(tmp_path, capsys):
    fitted = train(tmp_path)
    written = rows(tmp_path)
    assert [row["step"] for row in written] == list(range(4, 41, 4))
    _, metrics = make_update(40)(initial())
    for row in written:
        losses = np.asarray(metrics["loss"])[row["step"] - 4 : row["step"]]
        assert row["loss"] == pytest.approx(np.median(losses), rel=1e-5)
        assert row["loss_max"] == pytest.approx(np.max(losses), rel=1e-5)
    seconds = [row["seconds"] for row in written]
    assert seconds == sorted(seconds)
    spent = json.loads((tmp_path / "training.json").read_text())
    assert (spent["seconds"], spent["compile_seconds"]) == (fitted.seconds, fitted.compile_seconds)
    assert spent["step"] == spent["steps"] == 40 and fitted.compile_seconds > fitted.seconds > 0
    assert "compiled in" in capsys.readouterr().out

    again = train(tmp_path)  # nothing is left to do
    assert_same(again.state, fitted.state)
    assert again.seconds == fitted.seconds and rows(tmp_path) == written


SESSION = """
import sys
sys.path.insert(0, sys.argv[1])
import test_loop as toy
toy.train(sys.argv[2], toy.make_update(slow=0.15), checkpoint_seconds=0.0, report_seconds=0.3)
"""


def start(directory):
    command = [sys.executable, "-c", SESSION, str(Path(__file__).parent), str(directory)]
    root = Path(__file__).parents[2]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=root, env=environment
    )


def wait_for_step(directory, step):
    for _ in range(600):
        if (done := checkpoint.steps(directory / "checkpoints")) and done[-1] >= step:
            return
        time.sleep(0.05)
    raise TimeoutError(f"step {step} was not reached")


def test_killed_and_resumed_is_bitwise_the_same(tmp_path, straight):
    process = start(tmp_path)
    wait_for_step(tmp_path, 16)
    with pytest.raises(ValueError, match=rf"process {process.pid} is training here"):
        train(tmp_path)
    process.kill()
    process.communicate()
    killed_at = checkpoint.steps(tmp_path / "checkpoints")[-1]
    assert 16 <= killed_at < 40
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write('{"step": 3')  # a torn line
    lost = json.loads((tmp_path / "training.json").read_text())["seconds"]

    calls = []
    update = make_update()
    fitted = train(tmp_path, lambda state: calls.append(int(state.step)) or update(state))
    assert calls[0] == killed_at  # the lock of the dead process did not hold it up
    assert_same(fitted.state, straight[0])
    for row, expected in zip(rows(tmp_path), straight[1], strict=True):
        assert row | {"seconds": 0} == expected | {"seconds": 0}
    assert fitted.seconds > lost > 0


def test_sigterm_saves_and_says_how_to_go_on(tmp_path, straight):
    process = start(tmp_path)
    wait_for_step(tmp_path, 8)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 128 + signal.SIGTERM
    assert "run the same command again to go on" in output and "Traceback" not in output
    done = checkpoint.steps(tmp_path / "checkpoints")[-1]
    assert rows(tmp_path)[-1]["step"] == done < 40
    assert f"saved step {done} of 40" in output
    assert_same(train(tmp_path).state, straight[0])


@pytest.mark.parametrize("during", ["_save", "_resume"])
def test_a_signal_during_the_last_save_or_as_a_finished_stage_is_read_ends_the_program(
    tmp_path, capsys, monkeypatch, during
):
    """Else the program would begin the next stage."""
    if during == "_resume":
        train(tmp_path)
    unpatched = getattr(loop, during)

    def signalled(*given):
        result = unpatched(*given)
        signal.raise_signal(signal.SIGTERM)
        return result

    monkeypatch.setattr(loop, during, signalled)
    with pytest.raises(SystemExit) as ended:
        train(tmp_path)
    assert ended.value.code == 128 + signal.SIGTERM and "saved step 40 of 40" in capsys.readouterr().out
    assert checkpoint.steps(tmp_path / "checkpoints")[-1] == 40


def test_lines_of_progress(tmp_path, capsys):
    train(tmp_path, make_update(slow=0.1), report_seconds=0.25)
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("step ")]
    assert 2 <= len(lines) <= 5
    assert lines[-1].startswith("step 40/40  loss ") and "00:00 left" in lines[-1]


def test_a_bar_on_a_terminal(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    train(tmp_path)
    output = capsys.readouterr().out
    assert "100%" in output and "40/40" in output and "loss=" in output and "step 40/40" not in output


def test_a_damaged_checkpoint_is_passed_over(tmp_path, straight):
    train(tmp_path, steps=20, checkpoint_seconds=0.0)
    newest = tmp_path / "checkpoints" / "20"
    for path in (newest / "state").rglob("*"):
        if path.is_file():
            os.truncate(path, 3)
    with pytest.warns(UserWarning, match="20 is damaged"):
        fitted = train(tmp_path)
    assert_same(fitted.state, straight[0])
    assert [row["step"] for row in rows(tmp_path)] == list(range(4, 41, 4))


@pytest.mark.slow
def test_a_checkpoint_cut_anywhere_is_noticed_and_the_one_before_it_used(tmp_path, straight):
    train(tmp_path / "whole", steps=20, checkpoint_seconds=0.0)
    checkpoints = tmp_path / "whole" / "checkpoints"
    newest = checkpoints / str(checkpoint.steps(checkpoints)[-1])
    files = [path.relative_to(newest) for path in sorted(newest.rglob("*")) if path.is_file()]
    cases = lost = silent = 0
    for path in files:
        size = (newest / path).stat().st_size
        for at in sorted({round(share * size) for share in np.linspace(0, 0.99, 10)}):
            directory = tmp_path / "cut"
            shutil.copytree(tmp_path / "whole", directory)
            os.truncate(directory / "checkpoints" / newest.name / path, at)
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                state = train(directory, steps=40).state
            try:
                assert_same(state, straight[0])
            except AssertionError:
                lost += 1
            aside = (directory / "checkpoints" / f"{newest.name}.damaged").exists()
            silent += aside and not any(str(newest.name) in str(warning.message) for warning in said)
            cases += 1
            shutil.rmtree(directory)
    faults.record("damaged", cases=cases, lost=lost, silent=silent)
    assert cases > 50 and lost == silent == 0


def test_another_configuration_is_refused(tmp_path):
    train(tmp_path, steps=4)
    changed = {"train": {"rate": 0.5, "steps": 40}, "hidden": (3, 5), "more": 1}
    with pytest.raises(ValueError) as error:
        train(tmp_path, config=changed)
    for part in (
        "train.rate: 0.01 there, 0.5 here",
        "hidden: [3, 4] there, [3, 5] here",
        "more: absent there",
    ):
        assert part in str(error.value)
    assert "train.steps" not in str(error.value) and "another directory" in str(error.value)
    with pytest.raises(ValueError) as error:
        train(tmp_path, config=changed, may_differ=("train", "hidden"))
    assert "more" in str(error.value) and "train.rate" not in str(error.value)
    assert int(train(tmp_path, config=changed, may_differ=("train", "hidden", "more")).state.step) == 40


def test_a_few_skipped_updates_are_counted(tmp_path):
    train(tmp_path, make_update(bad_steps=(2, 3, 4, 5, 20)), max_nonfinite=4)
    assert [row["nonfinite"] for row in rows(tmp_path)] == [2, 2, 0, 0, 0, 1, 0, 0, 0, 0]


def test_too_many_skipped_updates_in_a_row_stop_the_run(tmp_path):
    update = make_update(bad_steps=tuple(range(14, 40)))
    said = r"steps 15 to 19 had non-finite gradients, more than 4 in a row \(not finite: stretching\)"
    with pytest.raises(FloatingPointError, match=said):
        train(tmp_path, update, max_nonfinite=4, checkpoint_seconds=0.0)
    assert checkpoint.steps(tmp_path / "checkpoints")[-1] == 16


def spoiled(spoil):
    update = make_update()

    def spoiling(state):
        state, metrics = update(state)
        return spoil(state, metrics) if state.step == 12 else (state, metrics)

    return spoiling


def test_a_non_finite_loss_that_was_not_skipped_stops_the_run(tmp_path):
    update = spoiled(lambda state, metrics: (state, metrics | {"loss": metrics["loss"].at[1].set(jnp.inf)}))
    with pytest.raises(FloatingPointError, match=r"the loss of step 10 is inf; the last good checkpoint is .*8\. "):
        train(tmp_path, update, checkpoint_seconds=0.0)


def test_a_bad_state_is_never_saved(tmp_path):
    update = spoiled(lambda state, metrics: (state._replace(params={"w": jnp.full(3, jnp.nan)}), metrics))
    with pytest.raises(FloatingPointError, match=r"state of step 12 has NaN in .*'w'.*last good checkpoint is .*8\. "):
        train(tmp_path, update, checkpoint_seconds=0.0)
    assert checkpoint.steps(tmp_path / "checkpoints") == [4, 8]


@pytest.mark.parametrize(
    "options, said",
    [
        ({"steps": 41}, "steps_per_call 4 does not divide the steps from 0 to 41"),
        ({"steps_per_call": 5}, r"must return metrics \[5\] with a `loss`"),
        ({"update": lambda state: (state, {"other": jnp.zeros(4)})}, "with a `loss`"),
        ({"update": lambda state: (state, {"loss": jnp.zeros(4)})}, "went from step 0 to 0"),
    ],
)
def test_an_update_that_does_not_keep_to_its_contract(tmp_path, options, said):
    with pytest.raises(ValueError, match=said):
        train(tmp_path, **options)
