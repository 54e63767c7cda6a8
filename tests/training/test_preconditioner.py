import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax.body import motion_clips
from clothjax.config import Range
from clothjax.networks import animators
from clothjax.physics import descent, incremental_potential
from clothjax.simulation import assembly, rollout
from clothjax.training import pool, preconditioner, stage1


@pytest.mark.slow
def test_the_descent_goes_further_with_the_hessian_of_cloth_that_is_worn():
    config = small()
    config = dataclasses.replace(
        config,
        motions=("walk_0",),
        model=dataclasses.replace(config.model, descent_samples=8, descent_steps=6, latent=128, blendshapes=100),
    )
    experiment = assembly.assemble(config)
    scene = experiment.scene
    reel, _ = assembly.training_clips(experiment)
    state = stage1.init(scene, reel, config)
    model = {"params": state.params, "statistics": state.statistics}
    inverse = preconditioner.measure(model, scene, reel, config)
    assert inverse.shape == state.params["inverse_hessian"].shape
    np.testing.assert_allclose(inverse, inverse.T, atol=1e-4 * np.abs(inverse).max())
    values = np.linalg.eigvalsh(inverse.astype(np.float64))
    assert 0 < values.min() and values.max() <= 1.001 / config.model.descent_damping

    reel = jax.tree.map(jnp.asarray, reel)

    @jax.jit
    def energies(key, params):
        """After a step from the end of a loop of the first parameters, taken with the others."""
        simulation = pool.begin(key, scene, reel, config)
        character = pool.dressed(scene, simulation.betas, simulation.material, config)
        poses = motion_clips.there_and_back(reel, simulation.frame, 10)
        phi = animators.phi_animator(model, scene, character, config)
        _, states, _ = rollout.play(phi, scene, character, poses, config)
        cloth, window = jax.tree.map(lambda x: x[-1], (states, poses))
        animate = animators.phi_animator({"params": params, "statistics": state.statistics}, scene, character, config)
        _, (new, step, _) = rollout.take(animate, scene, character, cloth, window, 1 / config.fps, config)
        return incremental_potential.potential(new, step, scene.mesh, config.physics)

    keys = jax.random.split(jax.random.key(9), 6)
    at_rest, worn = (
        np.array([energies(key, params) for key in keys])
        for params in (state.params, stage1.preconditioned(state, inverse).params)
    )
    print(worn, at_rest)
    assert np.mean(np.log(worn / at_rest)) < 0


@pytest.mark.slow
def test_loops_that_all_blow_up_are_reported():
    config = small()
    config = dataclasses.replace(
        config,
        motions=("walk_0",),
        model=dataclasses.replace(config.model, descent_samples=1),
        material=dataclasses.replace(config.material, mu_range=Range(1e30, 1e30)),
    )
    experiment = assembly.assemble(config)
    reel, _ = assembly.training_clips(experiment)
    state = stage1.init(experiment.scene, reel, config)
    with pytest.raises(ValueError, match="no rollout of an untrained Phi stayed finite"):
        preconditioner.measure({"params": state.params, "statistics": state.statistics}, experiment.scene, reel, config)


def test_a_hessian_is_the_same_in_columns_one_by_one_and_together(monkeypatch):
    matrix = np.random.default_rng(0).normal(size=(40, 40)).astype(np.float32)
    matrix = matrix + matrix.T

    def energy(x):
        return 0.5 * jnp.dot(x, jnp.matmul(matrix, x, precision="highest"), precision="highest")

    alone = descent.hessian(energy, jnp.ones(40))
    np.testing.assert_allclose(alone, matrix, atol=1e-5)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")  # 32 columns, then 8
    np.testing.assert_allclose(descent.hessian(energy, jnp.ones(40)), matrix, atol=1e-5)
