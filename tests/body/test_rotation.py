"""Rotations against scipy and closed forms."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clothjax.body import rotation


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def random_rotations(count, seed=0):
    return Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix()


def test_6d_is_the_first_two_columns(x64):
    matrices = random_rotations(100)
    code = rotation.to_6d(matrices)
    np.testing.assert_array_equal(code[:, :3], matrices[:, :, 0])
    np.testing.assert_array_equal(code[:, 3:], matrices[:, :, 1])


def test_heading_of_a_turn_about_the_vertical_is_that_turn(x64):
    for angle in np.linspace(-np.pi, np.pi, 9):
        turn = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
        np.testing.assert_allclose(rotation.heading(turn), turn, atol=1e-12)


def test_heading_commutes_with_turning(x64):
    heading = jax.jit(rotation.heading)
    turn = Rotation.from_rotvec([0.0, 2.1, 0.0]).as_matrix()
    for matrix in random_rotations(20):
        np.testing.assert_allclose(heading(turn @ matrix), turn @ heading(matrix), atol=1e-10)


def test_heading_is_the_nearest_turn_about_the_vertical(x64):
    angles = np.linspace(-np.pi, np.pi, 2001)
    turns = Rotation.from_rotvec(angles[:, None] * [[0, 1, 0]]).as_matrix()
    for matrix in random_rotations(20, seed=1):
        found = np.linalg.norm(np.asarray(rotation.heading(matrix)) - matrix)
        assert found <= np.linalg.norm(turns - matrix[None], axis=(1, 2)).min() + 1e-12


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 0, 1], [0.6, 0, 0.8]])
def test_heading_of_a_half_turn_about_a_horizontal_axis(axis):
    matrix = Rotation.from_rotvec(np.pi * np.array(axis, np.float64)).as_matrix()
    gradient = jax.jacobian(rotation.heading)(matrix.round(12).astype(np.float32))
    np.testing.assert_array_equal(rotation.heading(matrix.round(12).astype(np.float32)), np.eye(3))
    assert np.isfinite(gradient).all()
