"""A training that diverged is replayed up to the step that did it."""

import dataclasses
import shutil

import jax.numpy as jnp
import numpy as np
import pytest
from samples import settings
from toy import small

from clothjax.commands import train
from clothjax.config import Config, TuningConfig
from clothjax.files import checkpoint, configuration
from clothjax.simulation import assembly
from clothjax.training import pipeline, stage1
from experiments import replay


@pytest.mark.slow
def test_the_first_bad_step_is_named_and_kept(tmp_path, monkeypatch, capsys):
    config = dataclasses.replace(small(), motions=("walk_0", "run_0"))
    config = dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, restart_probability=0.0))
    experiment = assembly.assemble(config)
    state = stage1.init(experiment.scene, assembly.training_clips(experiment)[0], config)
    pool = state.pool
    # the third simulation, whose turn is the third step, stretches without bounds
    spoiled = pool.cloth._replace(velocity=pool.cloth.velocity.at[2].set(1e30))
    frames = jnp.array([5, 60, len(assembly.motion(experiment, "walk_0").translation) + 7], jnp.int32)
    state = state._replace(pool=pool._replace(cloth=spoiled, frame=frames, fresh=jnp.zeros(3, bool)))
    checkpoint.save(tmp_path / "stage1" / "checkpoints", 0, state, configuration.to_dict(config))
    for start in ("checkpoints", "diverged"):  # again, from what the first has kept
        replay.main([str(tmp_path), "--allowed", "0"])
        said = capsys.readouterr().out
        assert f"of {tmp_path / 'stage1' / start}\n" in said
        assert "step 3: not finite: " in said and "simulation 2: frame 7 of run_0" in said and "kept: " in said
        assert "inertia" in said and str(np.round(np.asarray(pool.betas[2], float), 2).tolist()) in said
    assert checkpoint.steps(tmp_path / "stage1" / "diverged") == [2]
    # training skips that step, and goes on: so does its replay
    replay.main([str(tmp_path), "--steps", "8"])
    assert "steps 3 to 10 of 40 do not diverge" in capsys.readouterr().out
    with pytest.raises(ValueError, match="no checkpoint of tuning"):
        replay.main([str(tmp_path), "--stage", "tuning"])

    def diverge(*_):
        raise FloatingPointError("training diverged")

    monkeypatch.setattr(train, "train", diverge)
    path = tmp_path / "mine.yaml"
    path.write_text("garment: tshirt_1000")
    run = tmp_path / "run"
    (run / "stage1").mkdir(parents=True)
    with pytest.raises(FloatingPointError, match=r"diverged$"):  # there is nothing yet to replay
        train.main([str(path), "--directory", str(run)])
    shutil.copytree(tmp_path / "stage1", run / "stage1", dirs_exist_ok=True)
    with pytest.raises(FloatingPointError, match=r"experiments\.replay .*run --stage stage1"):
        train.main([str(path), "--directory", str(run)])
    (run / "stage2").mkdir()
    with pytest.raises(FloatingPointError, match=r"diverged$"):  # no physics
        train.main([str(path), "--directory", str(run)])


@pytest.mark.slow
def test_a_finished_stage_is_not_replayed_and_a_peers_and_a_tuning_are(tmp_path, capsys):
    quick = TuningConfig(steps=20, pool=2, restart_probability=0.1)
    config = dataclasses.replace(small(), motions=("walk_0",), tuning=quick)
    pipeline.train(config, tmp_path / "ours")
    with pytest.raises(ValueError, match="tuning has taken all of its 20 steps"):
        replay.main([str(tmp_path / "ours")])
    peer = settings("ncs", steps=20)
    pipeline.train(peer, tmp_path / "ncs")
    for run, stage in (("ours", "tuning"), ("ncs", "stage1")):
        # as if it had been stopped: the same state, with more steps to come
        folder = tmp_path / run / stage / "checkpoints"
        kept = checkpoint.latest(folder)
        longer = kept.config | {stage: kept.config[stage] | {"steps": 30}}
        update, _, like = replay._again(tmp_path / run, stage, *experiment_of(kept.config))
        state, _ = checkpoint.restore(folder, like)
        checkpoint.save(folder, 21, update(state)[0], longer)
        replay.main([str(tmp_path / run), "--stage", stage])
        assert "steps 22 to 30 of 30 do not diverge" in capsys.readouterr().out


def experiment_of(config: dict):
    experiment = assembly.assemble(configuration.from_dict(Config, config, "a checkpoint"))
    return experiment, assembly.training_clips(experiment)[0]
