"""A training that diverged is replayed up to the step that did it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax import checkpoint, configuration, experiment, stage1
from experiments import replay, train


@pytest.mark.slow
def test_the_first_bad_step_is_named_and_kept(tmp_path, monkeypatch, capsys):
    config = dataclasses.replace(small(), motions=("walk_0", "run_0"))
    config = dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, restart_probability=0.0))
    whole = experiment.assemble(config)
    state = stage1.init(whole.scene, experiment.training_clips(whole)[0], config)
    pool = state.pool
    # the third simulation, whose turn is the third step, stretches without bounds
    spoiled = pool.cloth._replace(velocity=pool.cloth.velocity.at[2].set(1e30))
    frames = jnp.array([5, 60, len(experiment.motion(whole, "walk_0").translation) + 7], jnp.int32)
    state = state._replace(pool=pool._replace(cloth=spoiled, frame=frames, fresh=jnp.zeros(3, bool)))
    checkpoint.save(tmp_path / "stage1" / "checkpoints", 0, state, configuration.to_dict(config))
    for _ in range(2):  # again, from what the first has kept
        replay.main([str(tmp_path)])
        said = capsys.readouterr().out
        assert "step 3: not finite: " in said and "simulation 2: frame 7 of run_0" in said and "kept: " in said
        assert "inertia" in said and str(np.round(np.asarray(pool.betas[2], float), 2).tolist()) in said
    assert checkpoint.steps(tmp_path / "stage1" / "diverged") == [2]
    with pytest.raises(ValueError, match="no checkpoint of tuning"):
        replay.main([str(tmp_path), "--stage", "tuning"])

    def diverge(*_):
        raise FloatingPointError("training diverged")

    monkeypatch.setattr(train, "train", diverge)
    path = tmp_path / "mine.yaml"
    path.write_text("garment: tshirt_1000")
    with pytest.raises(FloatingPointError, match=r"experiments\.replay .*run"):
        train.main([str(path), "--directory", str(tmp_path / "run")])
