"""A training that is killed at any moment ends, when it is run again, bit for bit as one that was not."""

import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import faults
import killed
import numpy as np
import pytest
import yaml
from toy import assert_same, small

from clothjax.config import TuningConfig
from clothjax.files import checkpoint, configuration

TIMES = 50
STAGES = ("stage1", "stage2", "tuning")


def start(config: Path, directory: Path, cache: Path) -> subprocess.Popen:
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "PYTHONPATH": os.pathsep.join(sys.path),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    command = [sys.executable, killed.__file__, str(config), "--directory", str(directory)]
    with (directory.parent / "stderr").open("w") as log:
        return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=log)


def a_moment(run: subprocess.Popen, directory: Path, rng: np.random.Generator, seconds: float) -> float:
    """Seconds after which to kill: any time of a run, or up to one second after it has taken steps, for most of a run
    is its start."""
    if rng.uniform() < 0.3:
        return rng.uniform(0, seconds)
    before = taken(directory)
    while run.poll() is None and taken(directory) == before:
        time.sleep(0.02)
    return rng.uniform(0, 1)


def taken(directory: Path) -> int:
    """Rows that all stages of a run have written."""
    return sum(path.read_bytes().count(b"\n") for path in directory.rglob("metrics.jsonl"))


def params(directory: Path) -> list:
    return [checkpoint.read(directory / stage / "checkpoints", "params")[0] for stage in STAGES]


@pytest.mark.slow
def test_killed_at_random_moments(tmp_path):
    config = dataclasses.replace(
        small(), motions=("walk_0",), tuning=TuningConfig(steps=40, pool=2, restart_probability=0.1)
    )
    path, cache = tmp_path / "small.yaml", tmp_path / "cache"
    path.write_text(yaml.safe_dump(json.loads(json.dumps(configuration.to_dict(config)))))
    assert start(path, tmp_path / "first", cache).wait() == 0  # fills the cache
    began = time.monotonic()
    assert start(path, tmp_path / "whole", cache).wait() == 0
    seconds = time.monotonic() - began
    expected = params(tmp_path / "whole")
    assert_same(expected, params(tmp_path / "first"))
    rng, kills, finished, unequal = np.random.default_rng(0), 0, 0, 0
    while kills < TIMES:
        directory = tmp_path / f"run{finished}"
        while kills < TIMES:
            run = start(path, directory, cache)
            try:
                run.wait(timeout=a_moment(run, directory, rng, seconds))
            except subprocess.TimeoutExpired:
                run.kill()
                run.wait()
                kills += 1
                continue
            assert run.returncode == 0, (tmp_path / "stderr").read_text()
            break
        assert start(path, directory, cache).wait() == 0, (tmp_path / "stderr").read_text()
        finished += 1
        try:
            assert_same(expected, params(directory))
        except AssertionError:
            unequal += 1
    faults.record("kill", times=kills, finished=finished, unequal=unequal)
    assert unequal == 0 and finished > 2
