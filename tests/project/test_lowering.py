"""What is compiled can be compiled for GPUs and TPUs too, by the branches that are taken there."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import random_force_psi, random_model, settings
from toy import small

import clothjax as cj
from clothjax.config import LabelsConfig, TuningConfig
from clothjax.files import storage
from clothjax.runtime import inference, specialise
from clothjax.training import imitation, loop, pipeline
from clothjax.types import Pose

PLATFORMS = ("cuda", "tpu")
JIT = jax.jit


@pytest.fixture
def elsewhere(monkeypatch):
    """Take the branches of another device than a CPU, though it computes on one."""
    jax.clear_caches()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    yield
    jax.clear_caches()


def lower(program, *arguments, **options):
    """Lower a jitted function for `PLATFORMS`: jax cannot where something calls back to the host."""
    leaves, tree = jax.tree.flatten((arguments, options))
    arrays = {i: leaf for i, leaf in enumerate(leaves) if isinstance(leaf, jax.Array | np.ndarray)}

    def of_arrays(arrays):
        arguments, options = jax.tree.unflatten(tree, [arrays.get(i, leaf) for i, leaf in enumerate(leaves)])
        return program(*arguments, **options)

    # `JIT` is jax.jit itself: a test may put another one in its place
    traced = JIT(of_arrays).trace(arrays)
    assert "Cloth" not in str(traced.jaxpr)  # a kernel of a CPU
    traced.lower(lowering_platforms=PLATFORMS)


class Lowered:
    """A jitted function that is lowered for `PLATFORMS` before its first call."""

    def __init__(self, program, names):
        self.program, self.names, self.done = program, names, False

    def __call__(self, *arguments, **options):
        inside = any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves((arguments, options)))
        if not inside and not self.done:
            lower(self.program, *arguments, **options)
            self.names.append(self.program.__qualname__)
            self.done = True
        return self.program(*arguments, **options)

    def __getattr__(self, name):
        return getattr(self.program, name)


@pytest.fixture
def compiled(elsewhere, monkeypatch):
    """The names of what training jits and calls from here on, which is lowered for `PLATFORMS`."""
    names = []

    def jit(function=None, **options):
        return (lambda it: jit(it, **options)) if function is None else Lowered(JIT(function, **options), names)

    monkeypatch.setattr(jax, "jit", jit)
    for module, name in ((imitation, "_put"), (loop, "_any_nan")):  # jitted already
        monkeypatch.setattr(module, name, Lowered(getattr(module, name), names))
    return names


@pytest.mark.parametrize("kind", ["pose", "forces"])
def test_inference(elsewhere, kind):
    if kind == "pose":
        model, external = random_model(skip=True), None
    else:
        model, external = random_force_psi(relaxation=2).model(), jnp.zeros(3)
    motion = storage.load_motion("walk_0", model.names)
    motion = motion._replace(rotations=motion.rotations[:4], translation=np.float32(motion.translation[:4]))
    pose = Pose(jnp.asarray(motion.rotations[0]), jnp.asarray(motion.translation[0]))
    lower(inference.initial_state, model, pose)
    state = inference.initial_state(model, pose)
    for vertices in (True, False):
        lower(inference.step, model, state, pose, vertices, external)
    crowd = cj.crowd([model, model])
    states, poses = (jax.tree.map(lambda x: jnp.stack([x, x]), each) for each in (state, pose))
    lower(inference.step_crowd, crowd, states, poses)
    lower(inference._animate, model, motion, None)
    lower(specialise._codes, model, motion)
    lower(inference.resting, state, state)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pose", "forces", "ncs", "snug", "direct"])
def test_training(compiled, kind, tmp_path):
    """All that a training compiles: simulations, labels, updates of each stage. It computes by these branches, too."""
    config = small() if kind in ("pose", "forces") else settings(kind)
    config = dataclasses.replace(config, motions=("walk_0",), tuning=TuningConfig(steps=20, batch=2, pool=2))
    config = dataclasses.replace(
        config,
        stage1=dataclasses.replace(config.stage1, steps=20, pool=2),
        stage2=dataclasses.replace(config.stage2, steps=20, forces=kind == "forces"),
    )
    if kind == "forces":
        config = dataclasses.replace(
            config,
            model=dataclasses.replace(config.model, relaxation=2),
            labels=LabelsConfig(rounds=2, simulations=2, frames=4, steps=20, last_steps=0, batch=8),
            tuning=dataclasses.replace(config.tuning, steps=0),
        )
    pipeline.train(config, tmp_path)
    assert any(name.endswith("update") for name in compiled)
    assert ("_put" in compiled) == (kind == "forces") and "_any_nan" in compiled
