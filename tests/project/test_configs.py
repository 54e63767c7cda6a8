import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from toy import shrink

from clothjax.config import Config, Ramp
from clothjax.files import configuration
from clothjax.networks import animators, psi
from clothjax.simulation import assembly
from clothjax.training import laplacian_shapes, stage1
from data_prep.takes import Takes

FOLDER = Path(__file__).parents[2] / "configs"
CONFIGS = sorted([*FOLDER.glob("*.yaml"), *FOLDER.glob("thesis_small/*.yaml")])


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


def test_the_takes_of_the_thesis_are_those_that_its_garments_train_on():
    takes = configuration.load(Takes, FOLDER / "thesis" / "takes.yaml")
    counts = {kind: len(of_kind) for kind, of_kind in takes.train.items()}
    assert counts == {"walk": 13, "run": 12, "jump": 10, "arms": 10, "torso": 6, "dance": 4, "avoidance": 1}
    assert takes.frames == 19145 and len(takes.all) - len(takes.test) == 56
    for name in ("dress", "long_sleeve", "pants", "tank", "tshirt"):
        config = configuration.load(Config, FOLDER / "thesis" / f"{name}.yaml")
        motions = [*config.motions, *config.evaluation.motions]
        assert motions == [f"data/thesis/cmu_{take}.motion.h5" for take in takes.all]
        assert len(config.motions) == 56 and config.body == "data/thesis/body.h5"
        assert (config.garment, config.directory) == (f"data/thesis/{name}.h5", f"runs/thesis_{name}")


def test_the_garments_of_the_thesis_have_its_settings():
    config = configuration.load(Config, FOLDER / "thesis" / "tshirt.yaml")
    model, first, second, loss = config.model, config.stage1, config.stage2, config.loss
    assert (model.latent_update, sum(stack.blocks for stack in model.processor), model.latent) == ("absolute", 15, 2048)
    assert (first.steps, first.rollout, first.rollout_end, first.rollout_every) == (120_000, 1, 5, 5000)
    assert (first.learning_rate, first.decay_start, first.adam_b2) == (5e-5, 1.0, 0.999)
    assert (second.hidden, second.steps, second.batch) == ((1024, 1024), 5_000_000, 512)
    assert (second.learning_rate, second.forces, config.tuning.steps) == (1e-4, False, 0)
    assert (loss.inertia, loss.gravity) == (Ramp(3.0, 5.0, 0, 50_000), Ramp(2.0, 3.0, 0, 50_000))
    # 5e3 to 8e6 J/m^3
    assert (config.physics.collision_stiffness, loss.collision) == (1e5, Ramp(0.05, 80.0, 50_000, 100_000))
