"""The nearest point, the nearest triangle and the nearest place on one, against brute force and libigl."""

import igl
import jax
import numpy as np
import pytest
from samples import icosphere, soup

from clothjax.geometry import proximity


@pytest.fixture(params=["on a CPU", "elsewhere"])
def search(request, monkeypatch):
    """The form of a search that a device gets."""
    monkeypatch.setattr(proximity, "_tries_all", lambda: request.param == "elsewhere")
    jax.clear_caches()  # the choice is made when a function is traced
    yield
    jax.clear_caches()


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


@pytest.mark.usefixtures("search")
@pytest.mark.parametrize("rounds, near", [(4, 0.1), (3, 0.2), (2, 0.5)])
def test_winding_numbers_are_those_of_libigl(rounds, near):
    """Of a dented ball of few or many triangles, in places farther from it than a part of a patch is large."""
    random = np.random.default_rng(0)
    vertices, faces = icosphere(rounds)
    vertices *= 1.0 - 0.2 * np.abs(vertices[:, :1]) ** 3
    positions = random.uniform(-1.6, 1.6, (4000, 3))
    apart = np.sqrt(igl.point_mesh_squared_distance(positions, vertices, faces.astype(np.int64))[0])
    positions = positions[apart > near]
    patches = proximity.patches(vertices, faces)
    shift = np.float32([3.0, -2.0, 1.0])
    moved = (positions + shift).astype(np.float32), (vertices + shift).astype(np.float32)[faces]
    everywhere = np.ones(len(positions), bool)
    found = jax.jit(proximity.winding_number)(*moved, patches.groups, everywhere)
    some = random.uniform(size=len(positions)) < 0.1
    np.testing.assert_array_equal(proximity.winding_number(*moved, patches.groups, some)[~some], 0.0)
    np.testing.assert_allclose(proximity.winding_number(*moved, patches.groups, some)[some], found[some], atol=1e-5)
    np.testing.assert_array_equal(proximity.winding_number(*moved, patches.groups, ~everywhere), 0.0)
    expected = igl.fast_winding_number(vertices, faces.astype(np.int64), positions)
    np.testing.assert_allclose(found, expected, atol=0.15)
    inside = expected > 0.5
    assert np.array_equal(np.asarray(found) > 0.25, inside)
    assert inside.sum() > 30 and (~inside).sum() > 100
    open_ball = faces[:-37]  # of which no patch has a round number
    found = proximity.winding_number(
        positions.astype(np.float32),
        vertices.astype(np.float32)[open_ball],
        proximity.patches(vertices, open_ball).groups,
        everywhere,
    )
    expected = igl.fast_winding_number(vertices, open_ball.astype(np.int64), positions)
    np.testing.assert_allclose(found, expected, atol=0.15)


@pytest.mark.usefixtures("search")
def test_what_fills_a_patch_up_does_not_wind():
    """Twenty triangles in a patch of 32: far from a closed mesh its dipoles cancel."""
    vertices, faces = icosphere(0)
    away = np.random.default_rng(0).normal(size=(50, 3))
    away *= 8.0 / np.linalg.norm(away, axis=1, keepdims=True)
    groups = proximity.patches(vertices, faces).groups
    corners = vertices.astype(np.float32)[faces]
    found = proximity.winding_number(away.astype(np.float32), corners, groups, np.ones(50, bool))
    np.testing.assert_allclose(found, 0.0, atol=1e-3)


def test_nearest_takes_the_first_of_equals():
    points = np.array([[1, 0, 0], [-1, 0, 0], [-1, 0, 0], [1, 0, 0]], np.float32)
    positions = np.array([[0, 0, 0], [-2, 0, 0], [2, 0, 0]], np.float32)
    np.testing.assert_array_equal(proximity.nearest_point(positions, points), [0, 1, 0])


def exact(positions, corners):
    """Distances [V] m to the nearest of triangles [F, 3, 3] m, by libigl in float64."""
    flat, faces = corners.reshape(-1, 3).astype(np.float64), np.arange(corners.size // 3).reshape(-1, 3)
    squared, _, _ = igl.point_mesh_squared_distance(positions.astype(np.float64), flat, faces)
    return np.sqrt(squared)


@pytest.mark.usefixtures("search")
@pytest.mark.parametrize("faces", [20, 700])
def test_the_nearest_face_is_that_of_brute_force_in_a_thousand_configurations(faces):
    """Two sizes: one where all groups are gone through at once, one where most must be skipped."""
    random = np.random.default_rng(0)
    nearest = jax.jit(proximity.nearest_face)
    for _ in range(500):
        corners, groups = soup(random, faces)
        positions = random.normal(size=(60, 3))
        on = random.choice(faces, 20)
        positions[:20] = np.einsum("vk,vkc->vc", random.dirichlet(np.ones(3), 20), corners[on])
        positions = positions.astype(np.float32)
        face = np.asarray(nearest(positions, corners, groups))
        chosen = [exact(position[None], corners[index : index + 1])[0] for position, index in zip(positions, face)]
        np.testing.assert_allclose(chosen, exact(positions, corners), atol=2e-6)


@pytest.mark.usefixtures("search")
def test_a_triangle_is_never_the_answer_for_its_own_corners():
    random = np.random.default_rng(1)
    positions = random.normal(size=(120, 3)).astype(np.float32)
    faces = np.stack([random.choice(120, 3, replace=False) for _ in range(300)])
    corners = positions[faces]
    groups = np.minimum(np.arange(10 * proximity.PATCH), 299).reshape(10, proximity.PATCH)
    found = np.asarray(jax.jit(proximity.nearest_face)(positions, corners, groups, faces))
    for vertex in range(120):
        others = (faces != vertex).all(axis=1)
        assert others[found[vertex]]
        chosen = exact(positions[vertex : vertex + 1], corners[found[vertex]][None])
        np.testing.assert_allclose(chosen, exact(positions[vertex : vertex + 1], corners[others]), atol=2e-6)


@pytest.mark.usefixtures("search")
def test_no_position_finds_its_face_through_nan():
    """A position that is not finite gets some face, and its neighbours in the chunk their own."""
    random = np.random.default_rng(2)
    corners, groups = soup(random, 700)
    positions = random.normal(size=(60, 3)).astype(np.float32)
    whole = np.asarray(proximity.nearest_face(positions, corners, groups))
    positions[7] = np.nan
    broken = np.asarray(proximity.nearest_face(positions, corners, groups))
    np.testing.assert_array_equal(np.delete(broken, 7), np.delete(whole, 7))


def test_the_closest_point_is_that_of_libigl():
    random = np.random.default_rng(1)
    corners, _ = soup(random, 500)
    positions = random.normal(size=(500, 3)).astype(np.float32)
    weights, squared = proximity.closest_on_triangle(positions, corners)
    point = np.einsum("vk,vkc->vc", weights, corners)
    for i in range(500):
        expected, _, _ = igl.point_mesh_squared_distance(
            positions[i : i + 1].astype(np.float64), corners[i].astype(np.float64), np.array([[0, 1, 2]])
        )
        assert np.sqrt(squared[i]) == pytest.approx(np.sqrt(expected[0]), abs=2e-6)
        # the points of a sliver are as near as each other
        assert np.linalg.norm(positions[i] - point[i]) == pytest.approx(np.sqrt(expected[0]), abs=2e-6)
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


def test_the_faces_around_a_vertex():
    vertices, faces = icosphere(1)
    vertices = np.concatenate([vertices, [[2.0, 0.0, 0.0]]])  # one that no face has
    around = proximity.patches(vertices, faces).around
    for vertex in range(len(vertices) - 1):
        assert set(around[vertex]) == set(np.flatnonzero((faces == vertex).any(axis=1)))
    assert ((around >= 0) & (around < len(faces))).all()


def test_a_walk_along_a_sphere_ends_at_the_nearest_face():
    """From vertices two rings of faces away from what is nearest."""
    vertices, faces = icosphere(3)
    vertices = vertices.astype(np.float32)
    patches = proximity.patches(vertices, faces)
    random = np.random.default_rng(0)
    positions = random.normal(size=(500, 3))
    positions *= random.uniform(0.9, 1.2, (500, 1)) / np.linalg.norm(positions, axis=1, keepdims=True)
    positions = positions.astype(np.float32)
    nearest = np.asarray(proximity.nearest_point(positions, vertices))

    def neighbour(vertex):
        return faces[patches.around[vertex, 0], random.integers(0, 3, len(vertex))]

    starts = [neighbour(neighbour(nearest)) for _ in range(2)]
    found = np.asarray(jax.jit(proximity.nearest_face_around)(positions, vertices, patches, starts))
    distance = np.sqrt(proximity.closest_on_triangle(positions, vertices[faces[found]])[1])
    np.testing.assert_allclose(distance, exact(positions, vertices[faces]), atol=1e-6)
