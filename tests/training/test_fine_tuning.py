"""Psi in training is Psi in use, and training it on the physics helps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small, untrained_psi

from clothjax import material
from clothjax.body import motion_clips
from clothjax.config import Config, LossConfig, Ramp, TuningConfig
from clothjax.networks import animators, normalisation
from clothjax.networks.normalisation import Normalizers, Scale
from clothjax.runtime import inference, loading
from clothjax.simulation import assembly, characters
from clothjax.simulation.rollout import StepInput
from clothjax.training import fine_tuning, stage1
from clothjax.types import ClothState, Pose


@pytest.fixture(scope="module")
def toy():
    """An untrained Psi, and all it is made of."""
    config = dataclasses.replace(
        small(), tuning=TuningConfig(steps=40, pool=2, learning_rate=3e-3, restart_probability=0.0)
    )
    return untrained_psi(config)


def test_psi_in_training_is_psi_in_use(toy):
    experiment, _, kept, garment, predictor, normalizers = toy
    config, betas = experiment.config, jnp.linspace(-1, 1, 10)
    model = loading.build(
        config, experiment.garment, experiment.body, experiment.names, garment, predictor, normalizers, betas=betas
    )
    clip = assembly.motion(experiment, "walk_0")
    pose = [Pose(jnp.asarray(clip.rotations[t]), jnp.asarray(clip.translation[t], jnp.float32)) for t in range(5)]
    state = inference.initial_state(model, pose[0])
    for t in range(3):
        state, _ = inference.step(model, state, pose[t])
    following, vertices = inference.step(model, state, pose[3])
    at_bounds = np.isclose(np.abs(following.latent), 0.1)
    assert at_bounds.any() and not at_bounds.all() and not following.ok

    character = characters.dress(experiment.scene, betas, material.configured_material(config), config.physics)
    animate = animators.psi_animator(garment, normalizers, kept)(
        {"params": predictor}, experiment.scene, character, config
    )
    around = motion_clips.poses(jax.tree.map(jnp.asarray, assembly.as_clips(clip)), 2)
    window = characters.window(experiment.scene, character, around)
    code = normalisation.denormalise(normalizers.latent, state.latent)
    cloth = ClothState(jnp.zeros_like(vertices), jnp.zeros_like(vertices), jnp.zeros_like(vertices), code, 0 * code)
    new, latent, seen = jax.jit(lambda c: animate.step(StepInput(c, around, window, None, None)))(cloth)
    assert seen is None
    np.testing.assert_allclose(normalisation.normalise(normalizers.latent, latent), following.latent, atol=1e-5)
    np.testing.assert_allclose(new + pose[2].translation[None], vertices, atol=2e-5)


def test_tuning_lowers_the_energy_and_changes_nothing_but_the_predictor(toy):
    experiment, reel, kept, garment, predictor, normalizers = toy
    normalizers = Normalizers(*(
        Scale(jnp.zeros(n), jnp.ones(n), jnp.full(n, -1e6), jnp.full(n, 1e6))
        for n in (len(normalizers.latent.mean), len(normalizers.pose.mean))
    ))  # fmt: skip
    config = fine_tuning.settings(experiment.config)
    state = fine_tuning.init(predictor, experiment.scene, reel, experiment.config)
    assert jax.tree.structure(state.params) == jax.tree.structure(predictor) and not state.statistics
    update = stage1.make_update(
        experiment.scene, reel, config, 1, 40, animator=animators.psi_animator(garment, normalizers, kept)
    )
    state, metrics = update(state)
    assert np.isfinite(metrics["loss"]).all() and int(state.step) == 40
    # the same simulations once more, by the predictor that they have trained
    _, again = update(fine_tuning.init(state.params, experiment.scene, reel, experiment.config))
    assert np.mean(again["loss"]) < 0.95 * np.mean(metrics["loss"])


def test_the_gradient_of_a_code_is_preconditioned_and_nothing_else_changes(toy):
    experiment, reel, kept, garment, predictor, normalizers = toy
    config, betas = experiment.config, jnp.linspace(-1, 1, 10)
    character = characters.dress(experiment.scene, betas, material.configured_material(config), config.physics)
    poses = motion_clips.poses(reel, 5)
    window = characters.window(experiment.scene, character, poses)
    size = len(normalizers.latent.mean)
    root = np.random.default_rng(0).normal(size=(size, size))
    inverse = root @ root.T + np.eye(size)
    last = max(name for name in predictor if name.startswith("dense"))
    cloth = ClothState(*(jnp.zeros_like(character.template) for _ in range(3)), *(jnp.zeros(size) for _ in range(2)))

    def found(inverse):
        code = None if inverse is None else fine_tuning.code_preconditioner(inverse, normalizers, 0.5)
        make = animators.psi_animator(
            garment, normalizers, kept, animators.Preconditioners(jnp.eye(len(normalizers.pose.mean)), code)
        )

        def energy(bias):
            params = predictor | {last: predictor[last] | {"bias": bias}}
            new, code, _ = make({"params": params}, experiment.scene, character, config).step(
                StepInput(cloth, poses, window, None, None)
            )
            return jnp.sum((new - 1.0) ** 2), code

        return jax.jit(jax.value_and_grad(energy, has_aux=True))(predictor[last]["bias"])

    (plain, code), gradient = found(None)
    (same, same_code), preconditioned = found(inverse)
    assert plain == same and (code == same_code).all()
    expected = fine_tuning.code_preconditioner(inverse, normalizers, 0.5) @ gradient
    np.testing.assert_allclose(preconditioned, expected, rtol=1e-3, atol=1e-3 * float(jnp.abs(expected).max()))
    assert float(jnp.abs(expected - gradient).max()) > 0.1 * float(jnp.abs(gradient).max())


def test_preconditioned_gradients_point_to_the_minimum():
    rng = np.random.default_rng(0)
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    stiffness = (basis * np.geomspace(1e-2, 1e2, 6)) @ basis.T  # J
    deviation = rng.uniform(0.5, 2.0, 6)
    scale = Scale(jnp.zeros(6), jnp.asarray(deviation, jnp.float32), -jnp.ones(6), jnp.ones(6))
    code, best = jnp.asarray(rng.normal(size=6), jnp.float32), jnp.asarray(rng.normal(size=6), jnp.float32)

    def energy(code, matrix=None):
        code = code if matrix is None else animators.precondition(matrix, code)
        apart = (code - best) * scale.deviation
        return 0.5 * apart @ jnp.asarray(stiffness, jnp.float32) @ apart

    def alignment(power):
        matrix = fine_tuning.code_preconditioner(np.linalg.inv(stiffness), Normalizers(scale, scale), power)
        assert energy(code, matrix) == energy(code)
        gradient, way = jax.grad(energy)(code, matrix), code - best
        return float(gradient @ way / jnp.linalg.norm(gradient) / jnp.linalg.norm(way))

    assert alignment(1.0) > 0.999
    assert alignment(0.0) < alignment(0.5) < alignment(1.0)
    plain = fine_tuning.code_preconditioner(np.linalg.inv(stiffness), Normalizers(scale, scale), 0.0)
    np.testing.assert_allclose(plain, np.eye(6), atol=1e-5)


def test_the_first_layer_learns_from_preconditioned_poses_and_predicts_from_poses(toy):
    experiment, reel, kept, garment, predictor, normalizers = toy
    config, betas = experiment.config, jnp.linspace(-1, 1, 10)
    character = characters.dress(experiment.scene, betas, material.configured_material(config), config.physics)
    poses = motion_clips.poses(reel, 5)
    window = characters.window(experiment.scene, character, poses)
    size, count = len(normalizers.latent.mean), len(normalizers.pose.mean)
    matrix = jnp.asarray(np.random.default_rng(0).normal(size=(count, count)), jnp.float32)
    cloth = ClothState(*(jnp.zeros_like(character.template) for _ in range(3)), *(jnp.zeros(size) for _ in range(2)))

    def found(matrix):
        gradients = None if matrix is None else animators.Preconditioners(matrix, None)
        make = animators.psi_animator(garment, normalizers, kept, gradients)

        def energy(params):
            new, code, _ = make({"params": params}, experiment.scene, character, config).step(
                StepInput(cloth, poses, window, None, None)
            )
            return jnp.sum((new - 1.0) ** 2), code

        return jax.jit(jax.value_and_grad(energy, has_aux=True))(predictor)

    (plain, code), gradient = found(None)
    (same, same_code), preconditioned = found(matrix)
    assert plain == same and (code == same_code).all()
    kernel, other = gradient.pop("dense_0")["kernel"], preconditioned.pop("dense_0")["kernel"]
    jax.tree.map(np.testing.assert_array_equal, gradient, preconditioned)
    rows = slice(size, size + count)
    expected = kernel.at[rows].set(jnp.matmul(matrix, kernel[rows], precision="highest"))
    np.testing.assert_allclose(other, expected, rtol=1e-3, atol=1e-4 * float(jnp.abs(expected).max()))


def test_preconditioned_poses_tell_velocities_as_loudly_as_places():
    rng = np.random.default_rng(0)
    place, velocity = rng.normal(size=(2, 20_000))
    poses = np.stack([place, place + 0.2 * velocity, rng.normal(size=20_000)], axis=1)
    matrix = np.asarray(fine_tuning.pose_preconditioner(poses, 0.5))
    seen = poses @ matrix
    covariance = np.cov(seen.T)
    np.testing.assert_allclose(covariance, np.eye(3) * np.trace(np.cov(poses.T)) / 3, atol=0.1)
    np.testing.assert_allclose(fine_tuning.pose_preconditioner(poses, 0.0), np.eye(3), atol=1e-5)


def test_tuning_has_the_last_loss_weights_and_the_bodies_of_stage_1():
    config = dataclasses.replace(
        Config(),
        loss=LossConfig(collision=Ramp(0.05, 80.0, 0, 1000), inertia=Ramp(3.0)),
        stage1=dataclasses.replace(Config().stage1, betas=1.25),
        tuning=TuningConfig(steps=10, rollout=3),
    )
    used = fine_tuning.settings(config)
    assert used.loss.collision == Ramp(80.0) and used.loss.inertia == Ramp(3.0) and used.loss.scale == config.loss.scale
    assert used.stage1.betas == 1.25 and used.stage1.rollout == 3 and used.stage1.learning_rate == 1.5e-4
