"""Rotations against scipy and closed forms, with finite gradients at every angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clothjax.body import rotation

ANGLES = [0.0, 1e-8, 1e-4, 0.999e-3, 1.001e-3, 0.5, np.pi - 1e-6, np.pi, np.pi + 1e-3, 6.0]
AXIS = np.array([0.48, -0.6, 0.64])


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def random_rotations(count, seed=0):
    return Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix()


@pytest.mark.parametrize("angle", ANGLES)
def test_axis_angle_is_that_of_scipy(angle, x64):
    matrix = rotation.from_axis_angle(angle * AXIS)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(angle * AXIS).as_matrix(), atol=1e-13)


def test_axis_angle_takes_any_leading_axes_and_float32():
    vectors = np.random.default_rng(0).standard_normal((2, 5, 3)).astype(np.float32)
    matrices = rotation.from_axis_angle(vectors)
    assert matrices.dtype == np.float32
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(2, 5, 3, 3)
    np.testing.assert_allclose(matrices, expected, atol=1e-6)


def test_gradient_of_axis_angle_is_that_of_finite_differences(x64):
    jacobian = jax.jit(jax.jacobian(rotation.from_axis_angle))
    for angle in ANGLES:
        vector = angle * AXIS
        found = jacobian(vector)
        assert np.isfinite(found).all()
        for axis in range(3):
            # through scipy: our own series and its switch are what is tested
            step = 1e-6 * np.eye(3)[axis]
            ahead, behind = (Rotation.from_rotvec(vector + s * step).as_matrix() for s in (1, -1))
            np.testing.assert_allclose(found[:, :, axis], (ahead - behind) / 2e-6, atol=1e-8)


def test_second_derivative_of_axis_angle_at_zero_is_finite(x64):
    hessian = jax.jit(jax.hessian(lambda v: rotation.from_axis_angle(v)[0, 0]))(np.zeros(3))
    # R_00 = 1 - (y^2 + z^2) / 2 + ...
    np.testing.assert_allclose(hessian, np.diag([0.0, -1.0, -1.0]), atol=1e-12)


def test_6d_there_and_back(x64):
    matrices = random_rotations(100)
    code = rotation.to_6d(matrices)
    np.testing.assert_array_equal(code[:, :3], matrices[:, :, 0])
    np.testing.assert_allclose(rotation.from_6d(code), matrices, atol=1e-10)


def test_6d_of_anything_is_a_rotation(x64):
    matrices = rotation.from_6d(np.random.default_rng(0).standard_normal((100, 6)))
    identity = np.einsum("nab,nac->nbc", matrices, matrices)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), (100, 3, 3)), atol=1e-8)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-8)


def test_6d_is_finite_for_degenerate_codes():
    codes = np.array([[0] * 6, [1, 0, 0, 2, 0, 0], [0, 0, 0, 1, 0, 0], [1e-20] * 6], np.float32)
    jacobian = jax.jit(jax.vmap(jax.jacobian(rotation.from_6d)))(codes)
    assert np.isfinite(rotation.from_6d(codes)).all() and np.isfinite(jacobian).all()


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi])
def test_gradient_through_6d_is_finite_for_rotations(angle):
    def there_and_back(vector):
        return jnp.sum(rotation.from_6d(rotation.to_6d(rotation.from_axis_angle(vector))) * weight)

    weight = np.random.default_rng(0).standard_normal((3, 3)).astype(np.float32)
    gradient = jax.jit(jax.grad(there_and_back))
    for axis in np.eye(3, dtype=np.float32):
        assert np.isfinite(gradient(np.float32(angle) * axis)).all()


def test_heading_of_a_turn_about_the_vertical_is_that_turn(x64):
    for angle in np.linspace(-np.pi, np.pi, 9):
        turn = rotation.from_axis_angle(np.array([0.0, angle, 0.0]))
        np.testing.assert_allclose(rotation.heading(turn), turn, atol=1e-12)


def test_heading_commutes_with_turning(x64):
    heading = jax.jit(rotation.heading)
    turn = np.asarray(rotation.from_axis_angle(np.array([0.0, 2.1, 0.0])))
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
