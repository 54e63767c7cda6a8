"""What a run that goes on must have in common with the one that was stopped."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from toy import small

from clothjax.files import checkpoint, configuration
from clothjax.simulation import assembly
from clothjax.training import pipeline, run_folder


def run(config, directory):
    return pipeline.Run(SimpleNamespace(config=config), directory, None, None)


def held_out(config, *motions):
    return dataclasses.replace(config, evaluation=dataclasses.replace(config.evaluation, motions=motions))


def test_a_stage_goes_on_only_with_the_motions_that_it_was_trained_on(tmp_path, monkeypatch):
    """Where `motions` is empty, they are those that are not held out."""
    fitted = []
    monkeypatch.setattr(pipeline.loop, "fit", lambda *_, **options: fitted.append(options["config"]))
    begun = held_out(small(), "walk_3")
    checkpoint.save(tmp_path / "stage1" / "checkpoints", 20, {"w": np.ones(1)}, configuration.to_dict(begun))

    def go_on(config, stage="stage1"):
        pipeline._fit(run(config, tmp_path), stage, None, {}, 40, "")
        return fitted.pop()

    for same in (begun, dataclasses.replace(begun, directory="moved"), held_out(begun, "walk_3", "mine.h5")):
        assert go_on(same) == configuration.to_dict(same)
    other = held_out(begun, "dance_3")
    said = r"stage1 was trained on other motions, as walk_3 were held out there, dance_3 here: use another directory"
    with pytest.raises(ValueError, match=said):
        go_on(other)
    go_on(other, "stage2")  # has not begun
    go_on(dataclasses.replace(other, motions=("walk_0",)))  # the other settings tell such runs apart


@pytest.mark.parametrize(("part", "forces"), [("stage1", False), ("stage2", False), ("labels", True)])
def test_a_stage_that_others_need_takes_a_step(tmp_path, part, forces):
    config = small()
    config = dataclasses.replace(config, stage2=dataclasses.replace(config.stage2, forces=forces))
    config = dataclasses.replace(config, **{part: dataclasses.replace(getattr(config, part), steps=0)})
    with pytest.raises(ValueError, match=rf"{part}\.steps must be more than 0"):
        pipeline.prepare(config, tmp_path)


def test_what_is_simulated_before_stage_1_is_of_the_motions(tmp_path):
    config = held_out(small(), "walk_3")
    kept = pipeline._simulated(run(config, tmp_path))
    assert kept == pipeline._simulated(run(held_out(config, "walk_3", "mine.h5"), tmp_path))
    assert kept != pipeline._simulated(run(held_out(config, "dance_3"), tmp_path))
    named = dataclasses.replace(config, motions=("walk_0",))
    assert pipeline._simulated(run(named, tmp_path)) == pipeline._simulated(run(held_out(named, "dance_3"), tmp_path))
    older = tmp_path / f"simulated_{run_folder.fingerprint(pipeline._read_by('stage1', config))}"
    older.mkdir()
    assert pipeline._simulated(run(config, tmp_path)) == older


def test_clips_are_those_of_the_rollouts_of_a_stage(tmp_path):
    """A run may get other fine-tuning after its stage 1: that must not change where the others begin."""
    config = dataclasses.replace(small(), motions=("walk_0",))
    tuned = dataclasses.replace(config, tuning=dataclasses.replace(config.tuning, steps=20, rollout_end=30))
    experiment = assembly.assemble(config)
    clips, others = (assembly.training_clips(experiment._replace(config=each))[0] for each in (config, tuned))
    np.testing.assert_array_equal(clips.chance, others.chance)
    longer, _ = assembly.training_clips(experiment, tuned.tuning)
    assert len(np.unique(longer.chance)) < len(np.unique(clips.chance))
    too_long = dataclasses.replace(tuned, tuning=dataclasses.replace(tuned.tuning, rollout_end=10000))
    with pytest.raises(ValueError, match="no motion has 10003 usable frames in a row"):
        pipeline.prepare(too_long, tmp_path)
