import dataclasses

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax import character as characters
from clothjax import compact_latent, experiment, losses, metrics, rollout, simulation, stage1
from clothjax.config import Config, LossConfig, Ramp
from clothjax.metrics import StepMeasure
from experiments import evaluate


@pytest.fixture(scope="module")
def walking():
    config = dataclasses.replace(small(), motions=("walk_0",))
    whole = experiment.assemble(config)
    character = characters.dress(whole.scene, jnp.zeros(10), experiment.material(config), config.physics)
    poses = evaluate.windows(experiment.motion(whole, "walk_3"))
    return whole, character, poses


def test_gaps_are_ratios_of_summed_energies():
    steps = [
        StepMeasure(energy=2.0, minimum=1.0, skinned=11.0, hold=3.0, error=np.array([1e-3, 3e-3]), converged=True),
        StepMeasure(energy=1.5, minimum=1.0, skinned=31.0, hold=1.5, error=np.array([0.0, 0.0]), converged=False),
    ]
    gaps = metrics.gaps(steps)
    assert gaps["energy_gap"] == pytest.approx(1.5 / 40)
    assert gaps["hold_gap"] == pytest.approx(1.5 / 2.5)
    assert gaps["hold_gap_median"] == pytest.approx(0.75) and gaps["hold_gap_max"] == pytest.approx(1.0)
    assert gaps["step_error_mm"] == pytest.approx(1.0) and gaps["step_error_mm_max"] == pytest.approx(3.0)
    assert gaps["solver_converged"] == 0.5


def test_skinning_has_an_energy_gap_of_one_and_the_solver_none(walking):
    whole, character, poses = walking
    short = jax.tree.map(lambda x: x[:8], poses)
    skinned = evaluate.skinned_trajectory(whole, character, short)
    gaps = metrics.gaps(metrics.step_measures(whole.scene, character, skinned, short, [5], whole.config))
    assert gaps["energy_gap"] == pytest.approx(1.0, abs=1e-6) and gaps["solver_converged"] == 1.0
    solved, infos = simulation.simulate(whole.scene, character, short, whole.config)
    assert len(solved) == 9 and all(info.converged for info in infos)
    gaps = metrics.gaps(metrics.step_measures(whole.scene, character, solved, short, [5], whole.config))
    assert abs(gaps["energy_gap"]) < 1e-3 and gaps["hold_gap"] < 0.05 and gaps["step_error_mm"] < 1.0


def test_penetration_counts_what_is_inside():
    ball, faces = igl.icosahedron()
    points = np.array([[0.0, 0, 0], [0.5, 0, 0], [2.0, 0, 0], [0, 3.0, 0]])
    percent, deepest = metrics.penetration(points, ball, faces)
    assert percent == 50.0
    # the inscribed sphere of an icosahedron of circumradius R
    radius = np.linalg.norm(ball[0])
    assert deepest == pytest.approx(1e3 * radius * 0.794654, rel=1e-4)


def test_roughness_is_zero_for_smooth_motion_and_sees_no_root():
    time = np.arange(12.0)[:, None, None]
    smooth = np.tile(0.1 * time**3, (1, 4, 3))
    assert metrics.roughness(smooth, np.zeros((11, 3))) < 1e-9
    shaking = np.tile(np.where(np.arange(12) % 2, 1.0, -1.0)[:, None, None], (1, 4, 3))
    assert metrics.roughness(shaking, np.zeros((11, 3))) == pytest.approx(16.0)
    # the same movement, once of the garment about the root and once of the root
    advance = np.random.default_rng(0).normal(size=(11, 3))
    moved = np.concatenate([np.zeros((1, 3)), np.cumsum(advance, axis=0)])[:, None]
    assert metrics.roughness(0 * smooth, advance) == pytest.approx(metrics.roughness(moved + 0 * smooth, 0 * advance))


def test_a_term_of_no_weight_is_not_computed():
    names = [field.name for field in dataclasses.fields(LossConfig) if field.name != "scale"]
    terms = dict.fromkeys(names, jnp.float32(1.0)) | {"friction": jnp.float32(jnp.nan)}
    config = LossConfig(friction=Ramp(0.0), inertia=Ramp(3.0, 5.0, 0, 100), scale=1.0)
    there = losses.present(terms, config)
    assert set(there) == set(names) - {"friction"}
    assert losses.weighted(there, config, jnp.int32(50)) == pytest.approx(6 + 4.0)
    assert losses.weighted(there, config, jnp.int32(1000)) == pytest.approx(6 + 5.0)


@pytest.fixture
def coded():
    """A garment of 5 vertices and 3 codes, and the inverse Hessian of its squared distance to a goal."""
    model = dataclasses.replace(
        Config().model, decoder=(4,), blendshapes=3, descent_damping=1e-9, descent_bound=1e6, latent_decay=0.0
    )
    basis = np.random.default_rng(0).normal(size=(3, 5, 3)).astype(np.float32)
    garment = {"decoder": None, "blendshapes": basis, "skip": jnp.eye(3)}
    garment["decoder"] = jax.tree.map(jnp.zeros_like, compact_latent.init_mlp(jax.random.key(0), (3, 4, 3), norm=False))

    def decode(latent):
        return jnp.einsum("k,kvc->vc", latent, basis, precision="highest")

    goal = decode(jnp.array([1.0, 0.0, -2.0]))

    def potential(displacement):
        return jnp.sum((displacement - goal) ** 2)

    descent = {"inverse_hessian": compact_latent.inverse_hessian(potential, garment, 3, model)}
    return descent, decode, potential, model


def test_the_newton_step_reaches_the_minimum_of_a_quadratic(coded):
    descent, decode, potential, model = coded
    start = jnp.array([0.3, -1.0, 0.7])
    held, force, push = compact_latent.newton_step(descent, start, decode, potential, model)
    np.testing.assert_allclose(held, decode(start), atol=1e-6)
    np.testing.assert_allclose(force, -jax.grad(potential)(held), atol=1e-5)
    np.testing.assert_allclose(start + push, [1.0, 0.0, -2.0], atol=1e-4)
    bounded = dataclasses.replace(model, descent_bound=0.1)
    _, _, push = compact_latent.newton_step(descent, start, decode, lambda x: 1e6 * potential(x), bounded)
    assert float(jnp.linalg.norm(push)) == pytest.approx(0.1, rel=1e-2)
    _, _, push = compact_latent.newton_step(descent, jnp.array([1.0, 0.0, -2.0]), decode, potential, model)
    np.testing.assert_allclose(push, 0.0, atol=1e-5)


def test_the_newton_step_does_not_overshoot_what_its_hessian_does_not_know(coded):
    """A floor that is a thousand times stiffer than the cloth: along the direction, the step ends at the minimum."""
    descent, decode, potential, model = coded
    start = jnp.array([0.3, -1.0, 0.7])

    def stiff(positions):
        return potential(positions) + 1e3 * jnp.sum(jnp.maximum(0.5 - positions[:, 1], 0.0) ** 2)

    _, _, push = compact_latent.newton_step(descent, start, decode, stiff, model)
    along = jax.grad(lambda t: stiff(decode(start + t * push)))
    assert stiff(decode(start + push)) < stiff(decode(start))
    assert abs(along(1.0)) < 0.5 * abs(along(0.0))  # the floor's sides change on the way
    # what the rest Hessian alone would do is worse than to stay
    full = -jax.grad(lambda z: stiff(decode(z)))(start) @ descent["inverse_hessian"]
    assert stiff(decode(start + full)) > stiff(decode(start))


def test_the_newton_step_where_the_potential_has_no_minimum_or_is_at_one(coded):
    descent, decode, potential, model = coded
    start = jnp.array([0.3, -1.0, 0.7])
    _, _, push = compact_latent.newton_step(descent, start, decode, lambda x: -potential(x), model)
    # as long as the cloth at rest would have it, and downhill
    np.testing.assert_allclose(push, start - jnp.array([1.0, 0.0, -2.0]), atol=1e-4)
    _, _, push = compact_latent.newton_step(descent, start, decode, lambda x: 0.0 * jnp.sum(x), model)
    np.testing.assert_array_equal(push, 0.0)
    wrong = {"inverse_hessian": -descent["inverse_hessian"]}
    _, _, push = compact_latent.newton_step(wrong, start, decode, potential, model)
    np.testing.assert_array_equal(push, 0.0)


def test_the_newton_step_of_a_softer_cloth_is_longer(coded):
    descent, decode, potential, model = coded
    start = jnp.array([0.3, -1.0, 0.7])
    _, _, push = compact_latent.newton_step(descent, start, decode, lambda x: potential(x) / 3, model)
    np.testing.assert_allclose(start + push, [1.0, 0.0, -2.0], atol=1e-4)
    _, _, push = compact_latent.newton_step(descent, start, decode, lambda x: potential(x) / 400, model)
    expected = compact_latent.MAX_LENGTH / 400
    np.testing.assert_allclose(push, expected * (jnp.array([1.0, 0.0, -2.0]) - start), rtol=1e-3)


def test_pinned_vertices_follow_skinning():
    config = dataclasses.replace(small(), garment="skirt_1000", motions=("walk_0",))
    whole = experiment.assemble(config)
    reel, _ = experiment.training_clips(whole)
    state = stage1.init(whole.scene, reel, config)
    character = characters.dress(whole.scene, jnp.zeros(10), experiment.material(config), config.physics)
    poses = jax.tree.map(lambda x: x[:6], evaluate.windows(experiment.motion(whole, "walk_3")))
    model = {"params": state.params, "statistics": state.statistics}
    _, states, _ = jax.jit(lambda m, p: rollout.play(m, whole.scene, character, p, config))(model, poses)
    skinned = evaluate.skinned_trajectory(whole, character, poses)
    pinned = np.asarray(whole.garment.pinned)
    assert pinned.sum() > 10
    np.testing.assert_allclose(np.asarray(states.position)[:, pinned], skinned[:, pinned], atol=1e-5)
    assert np.abs(np.asarray(states.position)[:, ~pinned] - skinned[:, ~pinned]).max() > 1e-5
