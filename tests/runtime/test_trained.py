"""Whether the training of a run has ended, and who is told if it has not."""

import dataclasses

import numpy as np
import pytest
from samples import settings
from toy import small

from clothjax.commands import render
from clothjax.evaluation import rollouts
from clothjax.files import checkpoint, configuration
from clothjax.runtime import loading, trained


def save(run, stage, step, config):
    checkpoint.save(run / stage / "checkpoints", step, {"w": np.ones(1)}, configuration.to_dict(config))


def test_a_run_is_finished_when_its_last_stage_is(tmp_path):
    config = small()
    config = dataclasses.replace(config, tuning=dataclasses.replace(config.tuning, steps=20))
    stages = [("stage1", 40), ("stage2", 40), ("tuning", 20)]
    save(tmp_path, "stage1", 20, config)
    for stage, wanted in stages:
        done = max(checkpoint.steps(tmp_path / stage / "checkpoints"), default=0)
        assert trained.unfinished(tmp_path) == f"{stage} is at step {done} of {wanted}"
        save(tmp_path, stage, wanted, config)
    assert not trained.unfinished(tmp_path) and not trained.unfinished(trained.find("skirt"))


def test_a_stage_2_with_forces_has_the_steps_of_its_labels(tmp_path):
    config = small()
    config = dataclasses.replace(config, stage2=dataclasses.replace(config.stage2, forces=True))
    config = dataclasses.replace(config, labels=dataclasses.replace(config.labels, rounds=2, steps=60, last_steps=20))
    save(tmp_path, "stage1", 40, config)
    save(tmp_path, "stage2", config.stage2.steps, config)
    assert trained.unfinished(tmp_path) == "stage2 is at step 40 of 140"
    save(tmp_path, "stage2", 140, config)
    assert not trained.unfinished(tmp_path)


def test_a_baseline_has_one_stage_and_is_not_drawn(tmp_path):
    save(tmp_path, "stage1", 40, settings("ncs"))
    assert not trained.unfinished(tmp_path)
    with pytest.raises(ValueError, match=r"is of a baseline \(ncs\), which has no Phi"):
        render.main([str(tmp_path), "--out", str(tmp_path / "picture.webp")])


def test_who_uses_a_run_that_is_not_finished_is_told(tmp_path, monkeypatch):
    save(tmp_path, "stage1", 20, small())
    model = loading.load("tshirt_pose")
    monkeypatch.setattr(trained, "psi", lambda run: trained.TrainedPsi(small(), {}, {}, None))
    monkeypatch.setattr(loading, "build", lambda *_, **__: model)
    with pytest.warns(UserWarning, match="the training is not finished, stage1 is at step 20 of 40"):
        assert loading.load(tmp_path) is model
    with pytest.warns(UserWarning, match="the training is not finished, stage1 is at step 20 of 40"):
        rollouts.load_run(tmp_path, read=lambda _: (small(), {}))
