"""Contact planes against libigl, in closed form and where they are singular."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from clothjax import character as characters
from clothjax import clips, contact, experiment, proximity, rollout, skinning, topology
from clothjax.config import Config
from clothjax.types import Pose


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


def test_centroids_of_faces():
    vertices, faces = icosphere()
    points, normals = contact.centroids(vertices.astype(np.float32), faces)
    for face, point, normal in zip(faces[::17], points[::17], normals[::17]):
        a, b, c = vertices[face]
        np.testing.assert_allclose(point, (a + b + c) / 3, atol=1e-6)
        expected = np.cross(b - a, c - a)
        np.testing.assert_allclose(normal, expected / np.linalg.norm(expected), atol=1e-5)


def body(kind, random):
    vertices, faces = icosphere(2)
    if kind == "dented":
        # folds inwards and outwards: edges and vertices of both kinds are nearest
        vertices = vertices * random.uniform(0.6, 1.0, (len(vertices), 1))
    return vertices.astype(np.float32), faces


@pytest.mark.parametrize("kind", ["sphere", "dented"])
def test_the_signed_distance_is_that_of_libigl(kind):
    random = np.random.default_rng(2)
    vertices, faces = body(kind, random)
    positions = random.uniform(-1.2, 1.2, (2000, 3)).astype(np.float32)
    patches = proximity.patches(vertices, faces)
    found = jax.jit(contact.find)(positions, vertices, vertices, patches)
    distance = contact.distance(positions, found.point, found.normal)
    expected = igl.signed_distance(
        positions.astype(np.float64), vertices.astype(np.float64), faces.astype(np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )[0]  # fmt: skip
    # within float32 rounding of the surface the side is not known
    np.testing.assert_allclose(distance, expected, atol=3e-6)
    assert (expected < -0.05).sum() > 100 and (expected > 0.05).sum() > 100


def test_planes_go_with_the_body():
    random = np.random.default_rng(3)
    vertices, faces = body("dented", random)
    positions = random.uniform(-1.2, 1.2, (300, 3)).astype(np.float32)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn = (turn * np.sign(np.linalg.det(turn))).astype(np.float32)
    shift = np.array([0.3, -0.2, 0.5], np.float32)
    patches = proximity.patches(vertices, faces)
    found = contact.find(positions, vertices, vertices @ turn.T + shift, patches)
    np.testing.assert_allclose(found.point_next, np.asarray(found.point) @ turn.T + shift, atol=2e-6)
    np.testing.assert_allclose(found.normal_next, np.asarray(found.normal) @ turn.T, atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-5)


def test_on_a_face_an_edge_or_a_corner_the_plane_faces_outwards():
    vertices, faces = icosphere(1)
    vertices = vertices.astype(np.float32)
    corners = vertices[faces]
    positions = np.concatenate([corners.mean(1), 0.5 * (corners[:, 0] + corners[:, 1]), corners[:, 2]])
    found = contact.find(positions, vertices, vertices, proximity.patches(vertices, faces))
    outwards = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    assert (np.sum(np.asarray(found.normal) * outwards, axis=1) > 0.9).all()
    np.testing.assert_allclose(contact.distance(positions, found.point, found.normal), 0.0, atol=1e-6)


def test_gradients_are_finite_on_the_surface_and_on_triangles_without_area():
    vertices, faces = icosphere(1)
    vertices = vertices.astype(np.float32)
    flattened = vertices.copy()
    flattened[faces[0]] = flattened[faces[0, 0]]
    patches = proximity.patches(vertices, faces)
    positions = np.concatenate([vertices, vertices[faces].mean(1), flattened[faces[:1, 0]] * 1.001])

    def total(positions, body):
        found = contact.find(positions, body, body, patches)
        return jnp.sum(contact.distance(positions, found.point_next, found.normal_next) ** 2)

    for surface in (vertices, flattened):
        gradients = jax.grad(total, argnums=(0, 1))(positions, surface)
        assert all(np.isfinite(g).all() for g in gradients)


def test_the_part_of_the_body_within_reach_stands_for_the_whole():
    config = Config()
    whole = experiment.assemble(config)
    scene = whole.scene
    character = characters.dress(scene, jnp.zeros(10), experiment.material(config), config.physics)
    reel = jax.tree.map(jnp.asarray, experiment.windows(experiment.motion(whole, "run_3")))
    poses = clips.poses(reel, jnp.int32(40))
    window = characters.window(scene, character, poses)
    state = rollout.start(character, window, 0)
    shaken = state.position + 0.01 * jax.random.normal(jax.random.key(0), state.position.shape)
    planes = rollout.time_step(scene, character, state._replace(position=shaken), window, 1 / 30, config).contact
    distance = contact.distance(shaken, planes.point, planes.normal)
    body = skinning.pose_body(
        whole.body, whole.body.vertices, whole.body.joints, Pose(poses.rotations[1], poses.translation[1])
    )
    expected = igl.signed_distance(
        np.asarray(shaken, np.float64), np.asarray(body, np.float64), np.asarray(whole.body.faces, np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )[0]  # fmt: skip
    np.testing.assert_allclose(distance, expected, atol=1e-5)
    assert (expected < -1e-3).sum() > 20
    # the same triangles at the next frame
    advanced = contact.find(planes.point_next, *2 * (window.following.body,), scene.patches)
    np.testing.assert_allclose(contact.distance(planes.point_next, advanced.point, advanced.normal), 0.0, atol=1e-5)
