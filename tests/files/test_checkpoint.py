"""Checkpoints: exact, partial with every leaf checked, damage noticed, kill -9 survived."""

import os
import signal
import subprocess
import sys
import time
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from clothjax.files import checkpoint


class State(NamedTuple):
    step: jax.Array
    key: jax.Array
    params: dict
    optimizer: tuple
    flags: jax.Array
    empty: jax.Array


def make(seed=0, width=4):
    key = jax.random.key(seed)
    params = {
        "decoder": {"w": jax.random.normal(key, (3, width)), "b": jnp.zeros(width, jnp.bfloat16)},
        "layers": [jnp.arange(5.0), jnp.float32(seed)],
    }
    transform = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-3))
    return State(
        jnp.int32(7),
        jax.random.split(key, 3),
        params,
        transform.init(params),
        jnp.array([True, False]),
        jnp.zeros((0, 3)),
    )


def plain(leaf):
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def assert_same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(plain(x), plain(y))


def test_the_whole_state_comes_back_exactly(tmp_path):
    state = make(3)
    checkpoint.save(tmp_path / "c", 7, state, {"a": {"b": [1, 2.5, None]}}, "a shirt")
    like = jax.eval_shape(lambda: make(0))  # abstract: nothing of the wanted values can leak in
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        restored, about = checkpoint.restore(tmp_path / "c", like)
    assert_same(restored, state)
    assert isinstance(restored, State)
    np.testing.assert_array_equal(jax.vmap(jax.random.normal)(restored.key), jax.vmap(jax.random.normal)(state.key))
    assert (about.step, about.config, about.description) == (7, {"a": {"b": [1, 2.5, None]}}, "a shirt")
    assert checkpoint.latest(tmp_path / "c") == about


@pytest.mark.parametrize(
    "like, said",
    [
        ({"params": {"decodr": {"w": jnp.zeros((3, 4))}}}, r"has no params/decodr/w.*another garment"),
        (
            {"params": {"decoder": {"w": jnp.zeros((3, 5))}}},
            r"params/decoder/w is float32\[3, 4\].*float32\[3, 5\]",
        ),
        ({"params": {"decoder": {"w": jnp.zeros((3, 4), jnp.int32)}}}, r"float32\[3, 4\].*int32\[3, 4\]"),
        ({"empty": jnp.zeros((0, 4))}, r"empty is float32\[0, 3\]"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, like, said):
    checkpoint.save(tmp_path, 7, make(), {})
    with pytest.raises(ValueError, match=said):
        checkpoint.restore(tmp_path, like)


def test_parts_of_unknown_shape(tmp_path):
    for seed in (3, 4):
        checkpoint.save(tmp_path, seed, make(seed), {"seed": seed})
    parts, about = checkpoint.read(tmp_path, "params", "optimizer")
    assert_same(checkpoint.named(parts["params"]), checkpoint.named(make(4).params))
    assert parts["optimizer"].keys() == {"1"} and about.config == {"seed": 4}  # (clip, (adam, scale))
    with pytest.raises(ValueError, match="4: has no average; it is of another kind of training"):
        checkpoint.read(tmp_path, "params", "average")
    remove_state(tmp_path / "4")
    with pytest.warns(UserWarning, match="4 is damaged"):
        parts, about = checkpoint.read(tmp_path, "params")
    assert_same(checkpoint.named(parts["params"]), checkpoint.named(make(3).params))
    assert about.step == 3


def test_a_whole_state_that_does_not_fit_is_refused(tmp_path):
    checkpoint.save(tmp_path, 7, make(), {})
    with pytest.raises(ValueError, match=r"7: .*is .*\[4\], this model needs .*\[5\]"):
        checkpoint.restore(tmp_path, make(width=5))
    with pytest.raises(ValueError, match="holds key, which this model has not"):
        checkpoint.restore(tmp_path, {k: v for k, v in make()._asdict().items() if k != "key"})


def test_only_the_newest_are_kept_and_time_goes_forward(tmp_path):
    for step in (2, 4, 10, 20):
        checkpoint.save(tmp_path, step, make(step), {}, keep=2)
    assert checkpoint.steps(tmp_path) == [10, 20]
    assert float(checkpoint.restore(tmp_path, make())[0].params["layers"][1]) == 20
    with pytest.raises(ValueError, match="already a checkpoint of step 20"):
        checkpoint.save(tmp_path, 15, make(), {})


def test_what_is_no_checkpoint(tmp_path):
    with pytest.raises(ValueError, match="nowhere: does not exist; train first"):
        checkpoint.restore(tmp_path / "nowhere", make())
    (tmp_path / "notes").mkdir()
    with pytest.raises(ValueError, match="holds no checkpoints"):
        checkpoint.latest(tmp_path)
    assert not (tmp_path / "nowhere").exists()  # reading creates nothing


def test_a_newer_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "FORMAT", 99)
    checkpoint.save(tmp_path, 7, make(), {})
    monkeypatch.undo()
    with pytest.raises(ValueError, match="has format 99"):
        checkpoint.restore(tmp_path, make())


def largest_file(folder):
    return max((p for p in folder.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)


def truncate(folder):
    path = largest_file(folder)
    os.truncate(path, path.stat().st_size // 2)


def flip_a_bit(folder):
    path = largest_file(folder)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def remove_state(folder):
    for path in (folder / "state").rglob("*"):
        if path.is_file():
            path.unlink()


def garble_description(folder):
    for path in (folder / "about").iterdir():
        path.write_text("{")


@pytest.mark.parametrize("damage", [truncate, flip_a_bit, remove_state, garble_description])
def test_damage_is_noticed_and_the_previous_checkpoint_used(tmp_path, damage):
    state = make(5)
    noise = jax.random.normal(jax.random.key(0), (1 << 16,))  # most bytes on disk are this leaf's
    checkpoint.save(tmp_path, 5, (state, noise), {})
    checkpoint.save(tmp_path, 6, (make(6), noise), {})
    damage(tmp_path / "6")
    with pytest.warns(UserWarning, match=r"6 is damaged \(.+\); looking for an older checkpoint"):
        restored, about = checkpoint.restore(tmp_path, (make(), noise))
    assert about.step == 5
    assert_same(restored[0], state)

    checkpoint.set_aside(tmp_path, about.step)
    assert checkpoint.steps(tmp_path) == [5] and (tmp_path / "6.damaged").is_dir()
    checkpoint.save(tmp_path, 6, (make(6), noise), {})  # the resumed run gets there again
    assert checkpoint.restore(tmp_path, (make(), noise))[1].step == 6

    damage(tmp_path / "5")
    damage(tmp_path / "6")
    with pytest.warns(UserWarning), pytest.raises(ValueError, match="no undamaged checkpoint"):
        checkpoint.restore(tmp_path, (make(), noise))


SAVE_FOREVER = """
import itertools, sys
import jax.numpy as jnp
from clothjax.files import checkpoint
for step in itertools.count(1):
    checkpoint.save(sys.argv[1], step, {"x": jnp.full(1 << 20, float(step))}, {})
    print(step, flush=True)
"""


def test_kill_minus_nine_leaves_the_last_complete_checkpoint(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", SAVE_FOREVER, tmp_path], stdout=subprocess.PIPE, text=True)
    for _ in range(3):
        done = int(process.stdout.readline())
    time.sleep(0.02)  # into the next save
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    like = {"x": jnp.zeros(1 << 20)}
    restored, about = checkpoint.restore(tmp_path, like)
    assert about.step >= done
    np.testing.assert_array_equal(restored["x"], float(about.step))
    checkpoint.save(tmp_path, about.step + 1, like, {})
    assert all(entry.name.isdecimal() for entry in tmp_path.iterdir())  # the torn save was cleared away
