"""Several devices train as one does; several processes train together, stop together and go on together."""

import dataclasses
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml
from toy import assert_same, small

from clothjax.config import TuningConfig
from clothjax.files import checkpoint, configuration
from clothjax.runtime.trained import STAGES
from clothjax.training import devices
from experiments import train

ROOT = Path(__file__).parents[2]


VARIABLES = (
    "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE", "OMPI_MCA_orte_hnp_uri", "KUBERNETES_SERVICE_HOST",
    "JOB_COMPLETION_INDEX",
)  # fmt: skip


def test_how_processes_are_named(monkeypatch):
    joined = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *where: joined.append(where))
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    devices.connect()
    assert joined == []  # one process alone
    devices.connect("node1:4000,3,2")
    assert joined.pop() == ("node1:4000", 3, 2)
    for wrong in ("node1:4000", "node1,2,0", "node1:4000,two,0"):
        with pytest.raises(ValueError, match="processes are given as ADDRESS:PORT,COUNT,INDEX"):
            devices.connect(wrong)
    with pytest.raises(ValueError, match="process 2 of 2: indices count from 0"):
        devices.connect("node1:4000,2,2")


@pytest.mark.parametrize(
    "cluster, several",
    [
        ({"SLURM_STEP_NUM_TASKS": "2"}, True),
        ({"SLURM_STEP_NUM_TASKS": "1"}, False),
        ({"SLURM_NTASKS": "2"}, False),  # the batch script
        ({"OMPI_COMM_WORLD_SIZE": "4", "OMPI_MCA_orte_hnp_uri": "1;tcp://10.0.0.1:34911"}, True),
        ({"OMPI_COMM_WORLD_SIZE": "1", "OMPI_MCA_orte_hnp_uri": "1;tcp://10.0.0.1:34911"}, False),
        ({"KUBERNETES_SERVICE_HOST": "10.0.0.1", "JOB_COMPLETION_INDEX": "1"}, True),
        ({"KUBERNETES_SERVICE_HOST": "10.0.0.1"}, False),
    ],
)
def test_a_cluster_is_noticed(monkeypatch, cluster, several):
    joined = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda *where: joined.append(where))
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    for name, value in cluster.items():
        monkeypatch.setenv(name, value)
    devices.connect()
    assert joined == ([()] if several else [])
    devices.connect("alone")
    assert joined == ([()] if several else [])


def test_which_devices_are_chosen(monkeypatch):
    one = jax.devices()[0]
    monkeypatch.setattr(devices.jax, "devices", lambda: [one] * 8)
    monkeypatch.setattr(devices, "Mesh", lambda chosen, names: chosen)
    assert devices.choose("auto", 1, 32) is None
    assert len(devices.choose("auto", 4, 32)) == 4
    assert len(devices.choose("auto", 12, 32)) == 4
    assert len(devices.choose("8", 16, 32)) == 8
    for wanted, words in (("3", "cannot be divided among 3 devices"), ("9", "9 devices are wanted, there are 8"),
                          ("all", "a number or `auto`, not 'all'"), ("0", "a number or `auto`")):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            devices.choose(wanted, 4, 32)
    monkeypatch.setattr(devices.jax, "process_count", lambda: 2)
    with pytest.raises(ValueError, match="2 processes have 8 devices and use all of them, not 4"):
        devices.choose("4", 8, 32)
    with pytest.raises(ValueError, match="cannot be divided among 8 devices"):
        devices.choose("auto", 4, 32)


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """A small experiment with four simulations an update, as a file."""
    config = dataclasses.replace(small(), motions=("walk_0",))
    config = dataclasses.replace(
        config,
        stage1=dataclasses.replace(config.stage1, steps=20, pool=8, batch=4, restart_probability=0.5),
        stage2=dataclasses.replace(config.stage2, steps=20, batch=4, sequences=3),
        tuning=TuningConfig(steps=20, batch=4, pool=8),
    )
    path = tmp_path_factory.mktemp("several") / "small.yaml"
    path.write_text(yaml.safe_dump(json.loads(json.dumps(configuration.to_dict(config)))))
    return path


def start(config, directory, *arguments, count=1):
    """A training with `count` devices of its own, as a user starts it."""
    environment = os.environ | {"XLA_FLAGS": f"--xla_force_host_platform_device_count={count}"}
    command = [sys.executable, "-m", "experiments.train", str(config), "--directory", str(directory), *arguments]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT, env=environment
    )


def finish(*processes, seconds=1200):
    outputs = [process.communicate(timeout=seconds)[0] for process in processes]
    for process, output in zip(processes, outputs):
        assert process.returncode == 0, output
    return outputs


ONE_AND_FOUR = """
import sys
import jax
import numpy as np
import optax
from clothjax.config import Config
from clothjax.files import configuration
from clothjax.simulation import assembly
from clothjax.training import devices, stage1, stage2

config = configuration.cli(Config, [sys.argv[1]])
experiment = assembly.assemble(config)
reel, _ = assembly.training_clips(experiment)
after, teachers = [], []
for mesh in (None, devices.choose("auto", config.stage1.batch)):
    state = devices.replicate(stage1.init(experiment.scene, reel, config), mesh)
    state, metrics = stage1.make_update(experiment.scene, reel, config, 1, 1, mesh)(state)
    gradient = optax.tree.get(state.optimizer, "mu")  # times a constant, after the first update
    after.append(jax.device_get(((state.params, state.pool.cloth, metrics["loss"]), gradient)))
    first = jax.device_get({"params": state.params, "statistics": state.statistics}) if mesh is None else first
    model = devices.replicate(first, mesh)
    teacher = stage2.teach(model, experiment.scene, reel, np.arange(5), config, device_mesh=mesh)[0]
    teachers.append(teacher._replace(latents=teacher.latents[:, :3]))  # later frames have amplified the rounding
print(len(jax.devices()), "devices")
for one, four in zip(jax.tree.leaves(after[0][0]), jax.tree.leaves(after[1][0]), strict=True):
    np.testing.assert_allclose(one, four, rtol=1e-5, atol=5e-5)
for one, four in zip(jax.tree.leaves(after[0][1]), jax.tree.leaves(after[1][1]), strict=True):
    np.testing.assert_allclose(one, four, rtol=0, atol=1e-3 * np.abs(one).max())
for one, four in zip(teachers[0], teachers[1], strict=True):
    np.testing.assert_allclose(one, four, rtol=0, atol=3e-3 * max(1.0, np.abs(one).max()))
"""


def test_a_batch_of_any_stage_that_cannot_be_divided_is_refused_before_training(config, monkeypatch, tmp_path):
    one = jax.devices()[0]
    monkeypatch.setattr(devices.jax, "devices", lambda: [one] * 4)
    for stage in STAGES:
        with pytest.raises(ValueError, match=r"cannot be divided among 4 devices: .* tuning\.batch"):
            train.main([str(config), "--directory", str(tmp_path), "--devices", "4", f"--{stage}.batch", "6"])
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_four_devices_take_the_step_of_one(config):
    """Gradients, as Adam turns the rounding of one near zero into a part of its step. Rounding may switch a ReLU."""
    environment = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    done = subprocess.run(
        [sys.executable, "-c", ONE_AND_FOUR, str(config)], capture_output=True, text=True, cwd=ROOT, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert "4 devices" in done.stdout


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def pair(config, directory, *arguments):
    address = f"127.0.0.1:{free_port()}"
    return [start(config, directory, "--processes", f"{address},2,{index}", *arguments) for index in range(2)]


def trained(directory):
    """What a training left: the parameters of Phi, of Psi, and of Psi after its tuning."""
    return [checkpoint.read(directory / stage / "checkpoints", "params")[0] for stage in STAGES]


@pytest.mark.slow
def test_two_processes_train_and_save_as_one_with_two_devices(config):
    first, second = finish(*pair(config, config.parent / "two"))
    assert "2 devices, 2 processes" in first and "step 20/20" in first
    assert not any(word in second for word in ("step 20/20", "stage 1", "rolling out"))  # one of them reports
    (one,) = finish(start(config, config.parent / "one", "--devices", "auto", count=2))
    assert "2 devices, 1 processes" in one
    assert_same(trained(config.parent / "one"), trained(config.parent / "two"))


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_one_killed_stops_the_other_which_says_how_to_go_on(config, killed):
    """In the second stage: the checkpoint of the first is there, and with it both can go on."""
    directory = config.parent / f"killed_{killed}"
    processes = pair(config, directory, "--stage2.steps", "1000000")
    try:
        rows = directory / "stage2" / "metrics.jsonl"
        for _ in range(3000):
            if (rows.exists() and rows.stat().st_size) or any(process.poll() is not None for process in processes):
                break
            time.sleep(0.1)
        processes[killed].send_signal(signal.SIGKILL)
        processes[killed].communicate()
        output, _ = processes[1 - killed].communicate(timeout=150)
    finally:
        for process in processes:
            process.kill()
    assert processes[1 - killed].returncode not in (0, None), output
    # where the first is gone, jax itself may be faster to say so
    said = f"process {1 - killed} of 2 stops" in output and "start all of them again" in output
    assert said or (killed == 0 and "another task died" in output), output
    assert checkpoint.latest(directory / "stage1" / "checkpoints").step == 20
    parts, _ = checkpoint.read(directory / "stage1" / "checkpoints", "average", "pool")
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(parts["average"]))
