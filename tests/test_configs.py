import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from toy import shrink

from clothjax import configuration, experiment, stage1
from clothjax.config import Config

CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.yaml"))
# like the quickstart, the same program on another mesh; and one that takes a minute and a half
LONG = ("pants", "skirt", "dress", "protocol", "paper_tshirt")


@pytest.mark.parametrize(
    "path", [pytest.param(p, marks=[pytest.mark.slow] * (p.stem in LONG), id=p.stem) for p in CONFIGS]
)
def test_every_configuration_takes_two_steps(path):
    config = shrink(configuration.load(Config, path))
    config = dataclasses.replace(config, motions=("walk_0",))
    whole = experiment.assemble(config)
    reel, _ = experiment.training_clips(whole)
    state = stage1.init(whole.scene, reel, config)
    before = jax.device_get(state.params)
    state, metrics = stage1.make_curriculum(whole.scene, reel, config, 2)(state)
    assert int(state.step) == 2
    assert np.isfinite(metrics["loss"]).all() and not metrics["nonfinite"].any()
    assert any((a != b).any() for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(state.params)))
