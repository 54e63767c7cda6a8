"""The sweep starts a job for every garment and seed, gathers their figures, and says which failed."""

import argparse
import dataclasses
import json

import pytest
import yaml
from toy import small

from clothjax.files import configuration
from experiments import sweep


@pytest.fixture
def config(tmp_path):
    """A small experiment as a file."""
    config = dataclasses.replace(small(), motions=("walk_0",))
    path = tmp_path / "small.yaml"
    path.write_text(yaml.safe_dump(json.loads(json.dumps(configuration.to_dict(config)))))
    return path


def test_a_job_for_every_garment_and_seed(config, tmp_path, monkeypatch, capsys):
    class Told:
        """In the place of a training: what it was told."""

        def __call__(self, arguments, directory):
            seed = int(arguments[arguments.index("--stage1.seed") + 1])
            if seed == 2:
                raise ValueError("the wind was too strong")
            return {"told": [*arguments, directory], "psi": {"energy_gap": 0.5 + seed}}

    monkeypatch.setattr(sweep, "Job", Told)
    folder = tmp_path / "sweep"
    with pytest.raises(ValueError, match=r"1 of 4 jobs failed \(skirt_1000_2: .*the wind was too strong.*logs"):
        sweep.main([
            str(config), "--garments", "skirt_1000", "--seeds", "0", "1", "2", "3", "--directory", str(folder),
            "--at-once", "2", "--stage1.steps", "20",
        ])  # fmt: skip
    summary = json.loads((folder / "sweep.json").read_text())
    assert list(summary) == ["skirt_1000_0", "skirt_1000_1", "skirt_1000_3"]
    told = summary["skirt_1000_3"]["told"]
    assert told[-1] == str(folder / "skirt_1000_3")
    assert told[:5] == [str(config), "--stage1.steps", "20", "--garment", "skirt_1000"]
    parts = ("shapes", "stage1", "stage2", "labels", "tuning")
    assert told[5:-1] == [word for part in parts for word in (f"--{part}.seed", "3")]
    output = capsys.readouterr().out
    assert "| skirt_1000_1 | 1.5 |" in output and "jobs: 4/4" in output


def test_a_mistake_shows_before_anything_is_submitted(config, tmp_path, capsys):
    with pytest.raises(SystemExit):
        sweep.main([str(config), "--stage1.stepz", "20", "--directory", str(tmp_path / "sweep")])
    assert "stepz" in capsys.readouterr().err
    assert not (tmp_path / "sweep").exists()


def test_slurm_is_told_the_options(tmp_path, monkeypatch):
    for command in ("srun", "sbatch"):
        (tmp_path / command).write_text("#!/bin/sh\n")
        (tmp_path / command).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    chosen = argparse.Namespace(slurm=["partition=gpu", "gpus_per_node=1", "time=2000"], directory=tmp_path)
    text = sweep._executor(chosen, None)._make_submission_file_text("true", "job")
    for line in ("#SBATCH --partition=gpu", "#SBATCH --gpus-per-node=1", "#SBATCH --time=2000"):
        assert line in text
    with pytest.raises(ValueError, match="takes NAME=VALUE, such as partition=gpu; got 'gpu'"):
        sweep._executor(argparse.Namespace(slurm=["gpu"], directory=tmp_path), None)
    with pytest.raises(ValueError, match="a job of a sweep is one process"):
        sweep._executor(argparse.Namespace(slurm=["ntasks_per_node=4"], directory=tmp_path), None)


def test_a_job_on_this_machine_has_the_gpu_it_is_given(tmp_path):
    chosen = argparse.Namespace(slurm=None, directory=tmp_path)
    parameters = sweep._executor(chosen, 3).parameters
    assert parameters["gpus_per_node"] == 1 and parameters["visible_gpus"] == (3,)
    assert "gpus_per_node" not in sweep._executor(chosen, None).parameters


def test_two_jobs_of_one_name_are_refused(config, tmp_path):
    with pytest.raises(ValueError, match="two jobs would be called skirt_1000_1"):
        sweep.main([str(config), "--garments", "skirt_1000", "--seeds", "1", "1", "--directory", str(tmp_path / "s")])


def test_the_table_is_of_the_last_stage_or_the_peers_network():
    figures = {"lbs": {"energy_gap": 1.0}, "ncs": {"energy_gap": 0.25, "jitter": 0.5}}
    assert sweep.table({"a": figures}).splitlines()[-1] == "| a | 0.25 |  |  | 0.5 |  |"


@pytest.mark.slow
def test_a_sweep_trains_measures_and_is_not_done_twice(config, tmp_path):
    folder = tmp_path / "sweep"
    arguments = [
        str(config),
        "--seeds",
        "5",
        "--directory",
        str(folder),
        "--stage1.steps",
        "20",
        "--stage2.steps",
        "20",
    ]
    sweep.main(arguments)
    figures = json.loads((folder / "sweep.json").read_text())["tshirt_1000_5"]
    assert figures["psi"]["finite"] is True
    report = folder / "tshirt_1000_5" / "evaluation.json"
    stamp = report.stat().st_mtime_ns
    sweep.main(arguments)
    assert report.stat().st_mtime_ns == stamp
    assert json.loads((folder / "sweep.json").read_text())["tshirt_1000_5"] == figures
    with pytest.raises(ValueError, match="was trained with other settings"):
        sweep.main([*arguments, "--stage2.steps", "40"])
