import dataclasses

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax import material
from clothjax.config import LossConfig, Ramp
from clothjax.evaluation import metrics, rollouts
from clothjax.evaluation.metrics import StepMeasure
from clothjax.networks import animators
from clothjax.physics import solver
from clothjax.physics.energies import GRAVITY
from clothjax.simulation import assembly, characters, reference, rollout
from clothjax.training import loss, stage1


@pytest.fixture(scope="module")
def walking():
    config = dataclasses.replace(small(), motions=("walk_0",))
    experiment = assembly.assemble(config)
    character = characters.dress(experiment.scene, jnp.zeros(10), material.configured_material(config), config.physics)
    poses = rollouts.windows(assembly.motion(experiment, "walk_3"))
    return experiment, character, poses


def test_gaps_are_ratios_of_summed_energies():
    steps = [
        StepMeasure(
            energy=2.0, minimum=1.0, skinned=11.0, hold=3.0, span=1.2, error=np.array([1e-3, 3e-3]), converged=True
        ),
        StepMeasure(
            energy=1.5, minimum=1.0, skinned=31.0, hold=1.5, span=1.3, error=np.array([0.0, 0.0]), converged=False
        ),
    ]
    gaps = metrics.gaps(steps)
    assert gaps["energy_gap"] == pytest.approx(1.5 / 40)
    assert gaps["hold_gap"] == pytest.approx(1.5 / 2.5)
    assert gaps["span_gap"] == pytest.approx(0.5 / 2.5)
    assert "span_gap" not in metrics.gaps([step._replace(span=np.nan) for step in steps])
    assert gaps["hold_gap_median"] == pytest.approx(0.75) and gaps["hold_gap_max"] == pytest.approx(1.0)
    assert gaps["step_error_mm"] == pytest.approx(1.0) and gaps["step_error_mm_max"] == pytest.approx(3.0)
    assert gaps["solver_converged"] == 0.5


def test_skinning_has_an_energy_gap_of_one_and_the_solver_none(walking, monkeypatch):
    """Skinning is solved from once, as both starts are the same."""
    experiment, character, poses = walking
    starts, solve = [], solver.solve_step
    monkeypatch.setattr(solver, "solve_step", lambda *given, **more: starts.append(given[0]) or solve(*given, **more))
    short = jax.tree.map(lambda x: x[:8], poses)
    skinned = rollouts.skinned_trajectory(experiment, character, short)
    gaps = metrics.gaps(metrics.step_measures(experiment.scene, character, skinned, short, [5], experiment.config))
    assert gaps["energy_gap"] == pytest.approx(1.0, abs=1e-6) and gaps["solver_converged"] == 1.0
    assert len(starts) == 1
    solved, infos = reference.simulate(experiment.scene, character, short, experiment.config)
    assert len(solved) == 9 and all(info.converged for info in infos)
    starts.clear()
    gaps = metrics.gaps(metrics.step_measures(experiment.scene, character, solved, short, [5], experiment.config))
    assert abs(gaps["energy_gap"]) < 1e-3 and gaps["hold_gap"] < 0.05 and gaps["step_error_mm"] < 1.0
    assert len(starts) == 2


@pytest.mark.slow
def test_an_acceleration_against_gravity_is_no_gravity(walking):
    """For the solver, and for the measure of its own steps; in frames where it pushes, and only there."""
    experiment, character, poses = walking
    scene, config, short = experiment.scene, experiment.config, jax.tree.map(lambda x: x[:4], poses)
    physics = dataclasses.replace(config.physics, without=("gravity",))
    start = rollouts.skinned_trajectory(experiment, character, jax.tree.map(lambda x: x[:2], poses))
    up = np.tile(np.float32([0, GRAVITY, 0]), (5, 1))
    tracks = {
        "none": reference.simulate(scene, character, short, config, start=start)[0],
        "pushed": reference.simulate(scene, character, short, config, start=start, external=up)[0],
        "light": reference.simulate(scene, character, short, dataclasses.replace(config, physics=physics), start=start)[
            0
        ],
        "late": reference.simulate(
            scene, character, short, config, start=start, external=up * [[0], [0], [0], [0], [1]]
        )[0],
    }
    # in the first step: from equal states rounding may fold a few vertices otherwise, and later steps amplify that
    apart, moved = (np.linalg.norm(tracks["pushed"][1] - tracks[other][1], axis=1) for other in ("light", "none"))
    assert np.quantile(apart, 0.9) < 2e-4 and np.median(moved) > 5e-3
    assert np.abs(tracks["pushed"] - tracks["none"]).max() > 2e-3
    np.testing.assert_array_equal(tracks["late"][:4], tracks["none"][:4])
    assert np.abs(tracks["late"][4] - tracks["none"][4]).max() > 1e-3
    right, wrong = (
        metrics.gaps(metrics.step_measures(scene, character, tracks["late"], short, [3], config, external=pushed))
        for pushed in (up * [[0], [0], [0], [0], [1]], None)
    )
    assert right["hold_gap"] < 0.05 < wrong["hold_gap"]


def test_penetration_is_how_deep_inside():
    ball, faces = igl.icosahedron()
    points = np.array([[0.0, 0, 0], [0.5, 0, 0], [2.0, 0, 0], [0, 3.0, 0]])
    depth, nearest = metrics.penetration(points, ball, faces)
    assert (depth > 0).tolist() == [True, True, False, False]
    # the inscribed sphere of an icosahedron of circumradius R
    assert depth[0] == pytest.approx(np.linalg.norm(ball[0]) * 0.794654, rel=1e-4)
    assert ball[faces[nearest[2]], 0].mean() > 0.5


def test_beside_the_solver_itself_nothing_differs(walking):
    experiment, character, poses = walking
    skinned = rollouts.skinned_trajectory(experiment, character, jax.tree.map(lambda x: x[:6], poses))
    time = np.arange(6)[:, None, None]
    swing = 0.01 * np.sin(time + skinned[:1])
    same = metrics.beside_solver(experiment.scene, skinned + swing, skinned + swing, skinned)
    expected = {"swing_ratio": 1.0, "swing_correlation": 1.0, "rollout_error_mm": 0.0, "wrinkle_ratio": 1.0}
    assert same == pytest.approx(expected)
    twice = metrics.beside_solver(experiment.scene, skinned - 2 * swing, skinned + swing, skinned)
    assert twice["swing_ratio"] == pytest.approx(2.0) and twice["swing_correlation"] == pytest.approx(-1.0)
    assert twice["rollout_error_mm"] == pytest.approx(3e3 * np.linalg.norm(swing, axis=-1).mean())
    still = metrics.beside_solver(experiment.scene, skinned, skinned + swing, skinned)
    assert still["swing_ratio"] == 0.0 and still["swing_correlation"] == 0.0


@pytest.mark.slow
def test_all_of_space_contains_the_minimum(walking):
    """With a blend shape for every coordinate the span's minimum is the solver's, with none but one it is not."""
    experiment, character, poses = walking
    short = jax.tree.map(lambda x: x[:8], poses)
    skinned = rollouts.skinned_trajectory(experiment, character, short)
    size = skinned[0].size
    gap = {}
    for count in (1, 300, size):
        shapes = np.random.default_rng(0).normal(size=(count, size)) if count < size else np.eye(size)
        measures = metrics.step_measures(
            experiment.scene, character, skinned, short, [5], experiment.config, shapes.reshape(count, -1, 3)
        )
        gap[count] = metrics.gaps(measures)["span_gap"]
    assert gap[1] > gap[300] > gap[size] and gap[size] < 0.02


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
    there = loss.present_terms(terms, config)
    assert set(there) == set(names) - {"friction"}
    assert loss.weighted_loss(there, config, jnp.int32(50)) == pytest.approx(6 + 4.0)
    assert loss.weighted_loss(there, config, jnp.int32(1000)) == pytest.approx(6 + 5.0)


@pytest.mark.slow
def test_pinned_vertices_follow_skinning():
    config = dataclasses.replace(small(), garment="skirt_1000", motions=("walk_0",))
    experiment = assembly.assemble(config)
    reel, _ = assembly.training_clips(experiment)
    state = stage1.init(experiment.scene, reel, config)
    character = characters.dress(experiment.scene, jnp.zeros(10), material.configured_material(config), config.physics)
    poses = jax.tree.map(lambda x: x[:6], rollouts.windows(assembly.motion(experiment, "walk_3")))
    model = {"params": state.params, "statistics": state.statistics}

    @jax.jit
    def play(model, poses):
        animator = animators.phi_animator(model, experiment.scene, character, config)
        return rollout.play(animator, experiment.scene, character, poses, config)

    _, states, _ = play(model, poses)
    skinned = rollouts.skinned_trajectory(experiment, character, poses)
    pinned = np.asarray(experiment.garment.pinned)
    assert pinned.sum() > 10
    np.testing.assert_allclose(np.asarray(states.position)[:, pinned], skinned[:, pinned], atol=1e-5)
    assert np.abs(np.asarray(states.position)[:, ~pinned] - skinned[:, ~pinned]).max() > 1e-5
