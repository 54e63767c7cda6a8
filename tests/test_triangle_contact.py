"""Contact with triangles against libigl, in closed form and where it is singular."""

import dataclasses

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_contact import icosphere

from clothjax import character as characters
from clothjax import clips, contact, experiment, rollout, skinning
from clothjax.config import Config
from clothjax.types import Pose


def soup(random, faces, scale=1.0):
    """Triangles [F, 3, 3] m of all shapes, slivers among them, and groups that are not neighbours."""
    corners = (
        random.normal(size=(faces, 1, 3))
        + random.normal(size=(faces, 3, 3)) * random.choice([1e-3, 0.3], faces)[:, None, None]
    )
    count = -(-faces // contact.PATCH)
    groups = np.minimum(np.arange(count * contact.PATCH), faces - 1).reshape(count, contact.PATCH)
    return (scale * corners).astype(np.float32), groups.astype(np.int32)


def test_the_nearest_face_is_that_of_brute_force_in_a_thousand_configurations():
    random = np.random.default_rng(0)
    nearest = jax.jit(contact.nearest_face)
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
    weights, squared = contact.closest_on_triangle(positions, corners)
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
    _, squared = contact.closest_on_triangle(positions, np.broadcast_to(corners, (4, 3, 3)))
    np.testing.assert_allclose(np.sqrt(np.maximum(squared, 0)), expected, atol=1e-4)


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
    patches = contact.patches(vertices, faces)
    found = jax.jit(contact.find_on_triangles)(positions, vertices, vertices, patches)
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
    patches = contact.patches(vertices, faces)
    found = contact.find_on_triangles(positions, vertices, vertices @ turn.T + shift, patches)
    np.testing.assert_allclose(found.point_next, np.asarray(found.point) @ turn.T + shift, atol=2e-6)
    np.testing.assert_allclose(found.normal_next, np.asarray(found.normal) @ turn.T, atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-5)


def test_on_a_face_an_edge_or_a_corner_the_plane_faces_outwards():
    vertices, faces = icosphere(1)
    vertices = vertices.astype(np.float32)
    corners = vertices[faces]
    positions = np.concatenate([corners.mean(1), 0.5 * (corners[:, 0] + corners[:, 1]), corners[:, 2]])
    found = contact.find_on_triangles(positions, vertices, vertices, contact.patches(vertices, faces))
    outwards = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    assert (np.sum(np.asarray(found.normal) * outwards, axis=1) > 0.9).all()
    np.testing.assert_allclose(contact.distance(positions, found.point, found.normal), 0.0, atol=1e-6)


def test_gradients_are_finite_on_the_surface_and_on_triangles_without_area():
    vertices, faces = icosphere(1)
    vertices = vertices.astype(np.float32)
    flattened = vertices.copy()
    flattened[faces[0]] = flattened[faces[0, 0]]
    patches = contact.patches(vertices, faces)
    positions = np.concatenate([vertices, vertices[faces].mean(1), flattened[faces[:1, 0]] * 1.001])

    def total(positions, body):
        found = contact.find_on_triangles(positions, body, body, patches)
        return jnp.sum(contact.distance(positions, found.point_next, found.normal_next) ** 2)

    for surface in (vertices, flattened):
        gradients = jax.grad(total, argnums=(0, 1))(positions, surface)
        assert all(np.isfinite(g).all() for g in gradients)


def test_patches_hold_every_face_once_and_meet_across_edges():
    vertices, faces = icosphere(2)
    patches = contact.patches(vertices, faces[:-1])  # open
    assert set(patches.groups.reshape(-1).tolist()) == set(range(len(faces) - 1))
    assert patches.groups.shape == (-(-(len(faces) - 1) // contact.PATCH), contact.PATCH)
    boundary = 0
    for face, across in enumerate(patches.across):
        for k, other in enumerate(across):
            edge = set(patches.faces[face].tolist()) - {int(patches.faces[face, k])}
            boundary += other == face
            assert edge <= set(patches.faces[other].tolist())
    assert boundary == 3


def test_the_part_of_the_body_within_reach_stands_for_the_whole():
    config = Config(physics=dataclasses.replace(Config().physics, contact_surface="triangles"))
    whole = experiment.assemble(config)
    scene = whole.scene
    character = characters.dress(scene, jnp.zeros(10), experiment.material(config), config.physics)
    reel = jax.tree.map(jnp.asarray, experiment.windows(experiment.motion(whole, "run_3")))
    poses = clips.poses(reel, jnp.int32(40))
    window = characters.window(scene, character, poses, config.physics)
    state = rollout.start(character, window, 0)
    shaken = state.position + 0.01 * jax.random.normal(jax.random.key(0), state.position.shape)
    _, planes = rollout.time_step(scene, character, state._replace(position=shaken), window, 1 / 30, config)
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
    advanced = contact.find_on_triangles(planes.point_next, *2 * (window.following.body,), scene.patches)
    np.testing.assert_allclose(contact.distance(planes.point_next, advanced.point, advanced.normal), 0.0, atol=1e-5)
