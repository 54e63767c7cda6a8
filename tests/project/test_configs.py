import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from toy import shrink

from clothjax.config import Config
from clothjax.files import configuration
from clothjax.networks import animators, psi
from clothjax.simulation import assembly
from clothjax.training import laplacian_shapes, stage1

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))


@pytest.mark.slow  # test_experiments.py trains the quickstart, test_baselines.py the baselines
@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_configuration_takes_two_steps(path):
    config = shrink(configuration.load(Config, path))
    config = dataclasses.replace(config, motions=("walk_0",))
    experiment = assembly.assemble(config)
    reel, _ = assembly.training_clips(experiment)
    if config.peer.network:
        kept = psi.input_joints(experiment.names, config.stage2)
        state = stage1.init_baseline(
            experiment.scene, reel, kept, laplacian_shapes.laplacian(experiment.scene, config), config
        )
        update = stage1.make_curriculum(experiment.scene, reel, config, 2, animator=animators.baseline_animator(kept))
    else:
        state = stage1.init(experiment.scene, reel, config)
        update = stage1.make_curriculum(experiment.scene, reel, config, 2)
    before = jax.device_get(state.params)
    state, metrics = update(state)
    assert int(state.step) == 2
    assert np.isfinite(metrics["loss"]).all() and not metrics["nonfinite"].any()
    assert any((a != b).any() for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(state.params)))
