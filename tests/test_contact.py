"""Contact planes against brute force and closed forms."""

import jax
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from clothjax import contact, skinning, topology


def icosphere(rounds=2, radius=1.0):
    """A sphere of triangles facing outwards: (vertices, faces)."""
    t = (1 + 5**0.5) / 2
    # twelve vertices: the cyclic turns of (0, +-1, +-t)
    corner = np.array([[0, a, b * t] for a in (-1, 1) for b in (-1, 1)])
    vertices = np.concatenate([np.roll(corner, turn, axis=1) for turn in range(3)])
    faces = ConvexHull(vertices).simplices
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inwards = np.sum(np.cross(b - a, c - a) * a, axis=1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    for _ in range(rounds):
        edges = topology.edges(faces)
        middle = {tuple(edge): len(vertices) + i for i, edge in enumerate(edges.tolist())}
        vertices = np.concatenate([vertices, vertices[edges].mean(axis=1)])
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
        finer = []
        for a, b, c in faces.tolist():
            d, e, f = (middle[tuple(sorted(pair))] for pair in ((a, b), (b, c), (c, a)))
            finer += [[a, d, f], [b, e, d], [c, f, e], [d, e, f]]
        faces = np.array(finer)
    return radius * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def brute_force(positions, points):
    positions, points = positions.astype(np.float64), points.astype(np.float64)
    return np.linalg.norm(positions[:, None] - points[None], axis=-1)


@pytest.mark.parametrize("origin", [0.0, 10.0, 1000.0])
def test_nearest_is_that_of_brute_force(origin):
    random = np.random.default_rng(0)
    points = (random.uniform(-0.5, 0.5, (400, 3)) + origin).astype(np.float32)
    positions = (random.uniform(-0.6, 0.6, (300, 3)) + origin).astype(np.float32)
    distances = brute_force(positions, points)
    chosen = distances[np.arange(300), contact.nearest(positions, points)]
    # float32 may exchange points that are equally near to its rounding: about 1e-7 m^2 of squared distance
    np.testing.assert_allclose(chosen**2, distances.min(axis=1) ** 2, atol=5e-7)


def test_nearest_takes_the_first_of_equals():
    points = np.array([[1, 0, 0], [-1, 0, 0], [-1, 0, 0], [1, 0, 0]], np.float32)
    positions = np.array([[0, 0, 0], [-2, 0, 0], [2, 0, 0]], np.float32)
    np.testing.assert_array_equal(contact.nearest(positions, points), [0, 1, 0])


def surface(vertices, faces, kind):
    """Points and normals as the scene makes them."""
    if kind == "centroids":
        return contact.centroids(vertices, faces)
    return vertices, skinning.vertex_normals(vertices, faces)


def test_centroids_of_faces():
    vertices, faces = icosphere()
    points, normals = contact.centroids(vertices.astype(np.float32), faces)
    for face, point, normal in zip(faces[::17], points[::17], normals[::17]):
        a, b, c = vertices[face]
        np.testing.assert_allclose(point, (a + b + c) / 3, atol=1e-6)
        expected = np.cross(b - a, c - a)
        np.testing.assert_allclose(normal, expected / np.linalg.norm(expected), atol=1e-5)


def test_surface_of_a_face_without_area_is_finite():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], np.float32)
    for kind in ("vertices", "centroids"):
        points, normals = surface(vertices, np.array([[0, 1, 2]]), kind)
        assert np.isfinite(points).all() and (np.asarray(normals) == 0).all()


@pytest.mark.parametrize("kind", ["vertices", "centroids"])
def test_distance_to_a_sphere(kind):
    vertices, faces = icosphere(rounds=3, radius=0.5)
    body = surface(vertices.astype(np.float32), faces, kind)
    random = np.random.default_rng(1)
    direction = random.standard_normal((500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    expected = random.uniform(-0.02, 0.02, 500)
    positions = (direction * (0.5 + expected)[:, None]).astype(np.float32)
    found = contact.find(positions, body, body)
    distance = contact.distance(positions, found.point, found.normal)
    # no point is farther than s = 4.8 cm from the nearest vertex or centroid: s^2 / (2 r) = 2.3 mm
    np.testing.assert_allclose(distance, expected, atol=2.5e-3)
    np.testing.assert_allclose(np.sum(np.asarray(found.normal) * direction, axis=1), 1.0, atol=5e-3)


def test_the_plane_is_chosen_now_and_kept_for_the_step():
    vertices, faces = icosphere()
    now = surface(vertices.astype(np.float32), faces, "vertices")
    turned = vertices[:, [1, 2, 0]]  # a rotation: every vertex goes far from where it was
    following = surface(turned.astype(np.float32), faces, "vertices")
    positions = np.float32(1.1) * vertices.astype(np.float32)
    found = jax.jit(contact.find)(positions, now, following)
    np.testing.assert_array_equal(found.index, np.arange(len(vertices)))
    np.testing.assert_allclose(found.point, vertices, atol=1e-6)
    np.testing.assert_allclose(found.point_next, turned, atol=1e-6)
    np.testing.assert_allclose(np.asarray(found.normal_next), np.asarray(found.normal)[:, [1, 2, 0]], atol=1e-6)


def test_contact_moves_with_the_scene():
    vertices, faces = icosphere(rounds=1)
    shift = np.array([[2.0, -1.0, 0.5]], np.float32)
    positions = np.random.default_rng(2).uniform(-1, 1, (50, 3)).astype(np.float32)
    here = surface(vertices.astype(np.float32), faces, "vertices")
    there = surface(vertices.astype(np.float32) + shift, faces, "vertices")
    before, after = contact.find(positions, here, here), contact.find(positions + shift, there, there)
    np.testing.assert_array_equal(after.index, before.index)
    np.testing.assert_allclose(
        contact.distance(positions + shift, after.point, after.normal),
        contact.distance(positions, before.point, before.normal),
        atol=2e-6,
    )
