"""The stress test's own instruments: each must see what it is there to see."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax.files import storage
from clothjax.physics import energies
from clothjax.runtime import loading, trained
from clothjax.simulation import assembly
from clothjax.types import Motion
from experiments.stability import physics, rollouts, solver
from experiments.stability.report import readable


def test_no_term_has_a_value_a_gradient_or_a_hessian_product_that_is_not_finite():
    counts = physics.count_nonfinite(2000, seed=1)
    assert set(counts) == {*("stretching", "bending", "gravity", "inertia", "friction", "collision"), "edge_collision",
                           "self_collision", "contact"}  # fmt: skip
    for name, term in counts.items():
        assert [term.get(kind, 0) for kind in ("energy", "gradient", "hessian")] == [0, 0, 0], name


def test_a_careless_energy_is_found(monkeypatch):
    def careless(deviation, mass, timestep):
        return mass * jnp.linalg.norm(deviation, axis=-1) ** 2 / (2 * timestep * timestep)

    monkeypatch.setattr(physics, "inertia", careless)
    term = physics.count_nonfinite(2000)["inertia"]
    assert term["energy"] == 0 and term["gradient"] > 0


def test_degenerate_elements_are_among_the_configurations():
    elements = physics.points(np.random.default_rng(0), 2000, 3)
    a, b, c = np.moveaxis(elements, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert ((a == b) & (b == c)).all(axis=1).sum() > 100  # a point
    assert (area == 0).sum() > 300 and (area > 0).sum() > 300
    assert (np.abs(elements).max(axis=(1, 2)) > 500).sum() > 100  # far away


@pytest.mark.parametrize("away", [0.0, 100.0])
def test_float32_is_as_good_as_it_can_be_near_the_origin_and_far(away):
    errors = physics.precision(small(), away)
    assert len(errors) == 8
    for name, error in errors.items():
        assert error["value"] != 0, name
        assert error["energy"] <= 1e-5 and error["gradient"] <= 1e-4, (name, error)


def test_a_sum_that_cancels_is_found_far_from_the_origin(monkeypatch):
    from clothjax.physics import incremental_potential as losses

    def absolute(ends, contact, config, _laws):
        place = ends[..., 0, :] + contact.place[..., None] * (ends[..., 1, :] - ends[..., 0, :])
        distance = jnp.sum(place * contact.normal_next, axis=-1) - jnp.sum(
            contact.point_next * contact.normal_next, axis=-1
        )
        return config.collision_stiffness * energies.collision(distance, config.collision_offset)

    monkeypatch.setattr(losses, "edge_collision", absolute)
    assert physics.precision(small(), 100.0)["edge_collision"]["gradient"] > 1e-4


def test_the_sixteen_materials_are_the_corners_of_the_ranges():
    config = small()
    found = {tuple(float(x) for x in material) for material in solver.corners(config)}
    assert len(found) == 16
    low = np.float32([config.material.density_range.low, config.material.mu_range.low])
    assert {value[0] for value in found} == {float(low[0]), float(np.float32(config.material.density_range.high))}
    assert min(value[1] for value in found) == float(low[1])


@pytest.mark.slow
def test_the_solver_recovers_or_says_that_it_did_not():
    outcomes = solver.stress(small(), 2, True, lambda done: None)
    assert len(outcomes) == 7
    assert [name for name, outcome in outcomes.items() if outcome.result == "silent"] == []
    assert outcomes["usual"].result == "recovered"


def test_recovery_counts_to_the_last_frame_away():
    first = rollouts.BEFORE - 3
    relative = np.ones(first + 50)
    relative[first : first + 4] = 30.0
    assert rollouts.recovery_frames(relative) == 4
    relative[first + 20] = 1.11
    assert rollouts.recovery_frames(relative) == 21
    assert rollouts.recovery_frames(np.ones(first + 50)) == 0
    for lost in (np.nan, 1.2):
        relative[-1] = lost
        assert rollouts.recovery_frames(relative) is None


def test_drift_is_that_of_the_farthest_vertex():
    track = np.zeros((3, 5, 3))
    track[2, 4, 1] = 2e-3
    np.testing.assert_allclose(rollouts.drift_mm(track), [0.0, 0.0, 2.0])


def test_shocks_are_at_their_frame_and_nowhere_else():
    count = rollouts.BEFORE + 10
    clip = Motion(np.tile(np.eye(3, dtype=np.float32), (count, 2, 1, 1)), np.zeros((count, 3), np.float32), 30.0)
    shocked = rollouts.disturbed(clip)
    at = rollouts.BEFORE
    assert np.isnan(shocked["NaN frame"].rotations[at]).all()
    assert np.isfinite(np.delete(shocked["NaN frame"].rotations, at, axis=0)).all()
    np.testing.assert_allclose(shocked["half-turn"].rotations[at, 0], np.diag([1.0, -1, -1]))
    np.testing.assert_array_equal(np.delete(shocked["half-turn"].rotations, at, 0), np.delete(clip.rotations, at, 0))
    jump = np.diff(shocked["teleport"].translation, axis=0)[:, 0]
    assert np.flatnonzero(jump).tolist() == [at - 1] and jump.max() == rollouts.TELEPORT


@pytest.mark.parametrize("fps", [15.0, 60.0, 90.0])
def test_a_motion_at_another_rate_is_where_it_was_at_that_time(fps):
    experiment = assembly.assemble(dataclasses.replace(small(), motions=("walk_0",)))
    clip = assembly.motion(experiment, "walk_3")
    other = rollouts.at_rate(clip, fps)
    assert other.fps == fps
    step = round(fps / 15)
    for index in range(0, 20):
        same = index * 2  # both rates have a frame every fifteenth of a second
        np.testing.assert_allclose(other.rotations[index * step], clip.rotations[same], atol=1e-5)
        np.testing.assert_allclose(other.translation[index * step], clip.translation[same], atol=1e-5)
    turns = np.asarray(other.rotations, np.float64)
    np.testing.assert_allclose(turns @ np.swapaxes(turns, -1, -2), np.broadcast_to(np.eye(3), turns.shape), atol=1e-5)


def test_on_a_larger_body_the_cloth_is_larger_too():
    """What it weighs, its rest shape and how it relaxes are those of a garment cut so; its body grows."""
    betas, name = np.linspace(-1, 1, 10).astype(np.float32), "skirt"
    config, decoder, predictor, scales = trained.psi(trained.find(name))
    body, names = storage.load_rig(config.body)
    garment = storage.load_garment(config.garment, body)
    cut = garment._replace(vertices=2 * garment.vertices, shapedirs=2 * garment.shapedirs)
    whole = body._replace(vertices=2 * body.vertices, joints=2 * body.joints, shapedirs=2 * body.shapedirs)
    whole = whole._replace(joint_shapedirs=2 * body.joint_shapedirs)
    expected = loading.build(config, cut, whole, names, decoder, predictor, scales, betas=betas).wearer
    usual = loading.load(name, betas=betas)
    found = rollouts.scaled(usual, 2.0).wearer
    np.testing.assert_allclose(found.cloth.body, 2 * usual.wearer.cloth.body)
    expected = expected._replace(cloth=expected.cloth._replace(body=found.cloth.body))  # the part within reach differs
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-6)


def test_a_frozen_motion_stands_still():
    clip = Motion(np.zeros((30, 1, 3, 3)), np.arange(90.0).reshape(30, 3), 30.0)
    frozen = rollouts.freeze(clip, 10, 5)
    assert len(frozen.translation) == 15
    np.testing.assert_array_equal(frozen.translation[:10], clip.translation[:10])
    np.testing.assert_array_equal(frozen.translation[9:], np.tile(clip.translation[9], (6, 1)))


def test_a_report_without_a_run_is_readable():
    report = {
        "physics": {"terms": {"bending": {"configurations": 5, "energy": 1, "gradient": 2, "hessian": 0}}},
        "float32": {"terms": {"0 m": {"bending": {"energy": 1e-8, "gradient": 2e-7}}}},
        "solver": {"outcomes": {"usual": {"seconds": 0.5, "iterations": 3, "strain": 0.1, "inside": 0.0,
                                          "result": "recovered"}}},
    }  # fmt: skip
    text = readable(report)
    assert "| bending | 5 | 3 | 1e-08, gradient 2e-07 |" in text and "| usual | 0.50 | 3 |" in text
