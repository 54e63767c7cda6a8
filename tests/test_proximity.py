"""The nearest point, the nearest triangle and the nearest place on one, against brute force and libigl."""

import igl
import jax
import numpy as np
import pytest
from test_contact import icosphere

from clothjax import proximity


def brute_force(positions, points):
    positions, points = positions.astype(np.float64), points.astype(np.float64)
    return np.linalg.norm(positions[:, None] - points[None], axis=-1)


@pytest.mark.parametrize("origin", [0.0, 10.0, 1000.0])
def test_nearest_is_that_of_brute_force(origin):
    random = np.random.default_rng(0)
    points = (random.uniform(-0.5, 0.5, (400, 3)) + origin).astype(np.float32)
    positions = (random.uniform(-0.6, 0.6, (300, 3)) + origin).astype(np.float32)
    distances = brute_force(positions, points)
    chosen = distances[np.arange(300), proximity.nearest_point(positions, points)]
    # float32 may exchange points that are equally near to its rounding: about 1e-7 m^2 of squared distance
    np.testing.assert_allclose(chosen**2, distances.min(axis=1) ** 2, atol=5e-7)


def test_nearest_takes_the_first_of_equals():
    points = np.array([[1, 0, 0], [-1, 0, 0], [-1, 0, 0], [1, 0, 0]], np.float32)
    positions = np.array([[0, 0, 0], [-2, 0, 0], [2, 0, 0]], np.float32)
    np.testing.assert_array_equal(proximity.nearest_point(positions, points), [0, 1, 0])


def soup(random, faces, scale=1.0):
    """Triangles [F, 3, 3] m of all shapes, slivers among them, and groups that are not neighbours."""
    corners = (
        random.normal(size=(faces, 1, 3))
        + random.normal(size=(faces, 3, 3)) * random.choice([1e-3, 0.3], faces)[:, None, None]
    )
    count = -(-faces // proximity.PATCH)
    groups = np.minimum(np.arange(count * proximity.PATCH), faces - 1).reshape(count, proximity.PATCH)
    return (scale * corners).astype(np.float32), groups.astype(np.int32)


def test_the_nearest_face_is_that_of_brute_force_in_a_thousand_configurations():
    random = np.random.default_rng(0)
    nearest = jax.jit(proximity.nearest_face)
    for _ in range(1000):
        corners, groups = soup(random, 60)
        positions = random.normal(size=(40, 3)).astype(np.float32)
        face = np.asarray(nearest(positions, corners, groups))
        faces = np.arange(180).reshape(60, 3)
        flat, double = corners.reshape(-1, 3).astype(np.float64), positions.astype(np.float64)
        expected = igl.point_mesh_squared_distance(double, flat, faces)[0]
        # the distance to the face found, by the same library
        chosen = [
            igl.point_mesh_squared_distance(double[i : i + 1], flat, faces[face[i] : face[i] + 1])[0][0]
            for i in range(0, 40, 8)
        ]
        np.testing.assert_allclose(np.sqrt(chosen), np.sqrt(expected[::8]), atol=2e-6)


def test_the_closest_point_is_that_of_libigl():
    random = np.random.default_rng(1)
    corners, _ = soup(random, 500)
    positions = random.normal(size=(500, 3)).astype(np.float32)
    weights, squared = proximity.closest_on_triangle(positions, corners)
    point = np.einsum("vk,vkc->vc", weights, corners)
    for i in range(500):
        expected, _, closest = igl.point_mesh_squared_distance(
            positions[i : i + 1].astype(np.float64), corners[i].astype(np.float64), np.array([[0, 1, 2]])
        )
        assert np.sqrt(squared[i]) == pytest.approx(np.sqrt(expected[0]), abs=2e-6)
        np.testing.assert_allclose(point[i], closest[0], atol=1e-3)
    np.testing.assert_allclose(np.sum(weights, axis=1), 1.0, atol=1e-6)
    assert (np.asarray(weights) >= -1e-6).all()


@pytest.mark.parametrize(
    "corners",
    [
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [1, 0, 0], [1, 0, 0]],
        [[0, 0, 0], [1, 0, 0], [0.5, 0, 0]],
        [[1, 0, 0], [0, 0, 0], [0.5, 0, 0]],
    ],
)
def test_a_triangle_without_area_is_the_segment_it_has_shrunk_to(corners):
    corners = np.array(corners, np.float32)
    positions = np.array([[0.25, 1, 0], [2, 0, 0], [-1, -1, 0], [0.5, 0, 0]], np.float32)
    low, high = corners[:, 0].min(), corners[:, 0].max()
    expected = np.hypot(positions[:, 0] - np.clip(positions[:, 0], low, high), positions[:, 1])
    _, squared = proximity.closest_on_triangle(positions, np.broadcast_to(corners, (4, 3, 3)))
    np.testing.assert_allclose(np.sqrt(np.maximum(squared, 0)), expected, atol=1e-4)


def test_patches_hold_every_face_once_and_meet_across_edges():
    vertices, faces = icosphere(2)
    patches = proximity.patches(vertices, faces[:-1])  # open
    assert set(patches.groups.reshape(-1).tolist()) == set(range(len(faces) - 1))
    assert patches.groups.shape == (-(-(len(faces) - 1) // proximity.PATCH), proximity.PATCH)
    boundary = 0
    for face, across in enumerate(patches.across):
        for k, other in enumerate(across):
            edge = set(patches.faces[face].tolist()) - {int(patches.faces[face, k])}
            boundary += other == face
            assert edge <= set(patches.faces[other].tolist())
    assert boundary == 3
