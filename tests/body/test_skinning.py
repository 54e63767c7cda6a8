"""Skinning against a plain NumPy loop over 4 x 4 matrices, and its invariances."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clothjax.body import skinning
from clothjax.types import Body, Garment, Pose

PARENTS = np.array([-1, 0, 1, 2, 1, 4, 0], np.int32)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def random_body(dtype=np.float64, count=40, posed=False):
    random = np.random.default_rng(0)
    joints = random.uniform((-0.5, 0.5, -0.5), (0.5, 1.5, 0.5), (len(PARENTS), 3))
    weights = random.uniform(0, 1, (count, len(PARENTS))) ** 4
    body = Body(
        vertices=random.uniform((-0.5, 0.5, -0.5), (0.5, 1.5, 0.5), (count, 3)),
        faces=random.permuted(np.tile(np.arange(count), (60, 1)), axis=1)[:, :3].astype(np.int32),
        joints=joints,
        parents=PARENTS,
        weights=weights / weights.sum(axis=1, keepdims=True),
        shapedirs=0.02 * random.standard_normal((count, 3, 4)),
        joint_shapedirs=0.02 * random.standard_normal((len(PARENTS), 3, 4)),
        posedirs=0.01 * random.standard_normal((count, 3, 9 * (len(PARENTS) - 1))) if posed else None,
    )
    cast = [leaf.astype(dtype) if leaf is not None and leaf.dtype == np.float64 else leaf for leaf in body]
    return Body(*cast)


def random_pose(seed=0, dtype=np.float64):
    random = np.random.default_rng(seed)
    rotations = Rotation.random(len(PARENTS), rng=random).as_matrix()
    return Pose(rotations.astype(dtype), random.standard_normal(3).astype(dtype))


def four_by_four(rotation, translation):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def plain_skinning(body, vertices, joints, pose):
    """Forward kinematics of 4 x 4 matrices, the inverse bind matrices inverted as matrices."""
    world, bind = [], []
    for j, parent in enumerate(PARENTS):
        offset = joints[j] if parent < 0 else joints[j] - joints[parent]
        local, rest = four_by_four(pose.rotations[j], offset), four_by_four(np.eye(3), offset)
        world.append(local if parent < 0 else world[parent] @ local)
        bind.append(rest if parent < 0 else bind[parent] @ rest)
    if body.posedirs is not None:
        change = np.concatenate([(r - np.eye(3)).ravel() for r in pose.rotations[1:]])
        vertices = vertices + body.posedirs @ change
    posed = np.zeros_like(vertices)
    for i, vertex in enumerate(vertices):
        for j in range(len(PARENTS)):
            moved = world[j] @ np.linalg.inv(bind[j]) @ np.append(vertex, 1.0)
            posed[i] += body.weights[i, j] * moved[:3]
    return posed + pose.translation


def skin(body, pose, betas):
    vertices = skinning.shaped_vertices(body, betas)
    joints = skinning.shaped_joints(body, betas)
    return skinning.pose_body(body, vertices, joints, pose)


@pytest.mark.parametrize("posed", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_skinning_is_that_of_a_plain_loop(dtype, posed, x64):
    body, pose = random_body(posed=posed), random_pose()
    betas = np.array([1.0, -2.0, 0.5, 0.0])
    vertices = body.vertices + body.shapedirs @ betas
    joints = body.joints + body.joint_shapedirs @ betas
    expected = plain_skinning(body, vertices, joints, pose)
    found = skin(random_body(dtype, posed=posed), random_pose(dtype=dtype), betas.astype(dtype))
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=1e-13 if dtype == np.float64 else 2e-6)


@pytest.mark.parametrize("posed", [False, True])
def test_identity_pose_is_the_shaped_template(posed):
    body = random_body(np.float32, posed=posed)
    betas = np.array([0.3, 1.0, -1.0, 2.0], np.float32)
    identity = Pose(np.tile(np.eye(3, dtype=np.float32), (len(PARENTS), 1, 1)), np.zeros(3, np.float32))
    expected = body.vertices + body.shapedirs @ betas
    np.testing.assert_allclose(skin(body, identity, betas), expected, atol=1e-6)
    lifted = identity._replace(translation=np.array([1, 2, 3], np.float32))
    np.testing.assert_allclose(skin(body, lifted, betas), expected + lifted.translation[None], atol=1e-6)


def test_garments_are_shaped_like_bodies():
    body, betas = random_body(np.float32), np.array([1, 0, -2, 0.5], np.float32)
    pinned = np.zeros(len(body.vertices), bool)
    garment = Garment(body.vertices, body.faces, body.weights, body.shapedirs, pinned)
    np.testing.assert_array_equal(skinning.shaped_vertices(garment, betas), skinning.shaped_vertices(body, betas))


def test_turning_the_root_turns_the_body_about_it(x64):
    body, pose = random_body(), random_pose()
    turn = Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix()
    rotations = pose.rotations.copy()
    rotations[0] = turn @ rotations[0]
    pivot = body.joints[0] + pose.translation
    before = np.asarray(skin(body, pose, np.zeros(4)))
    after = skin(body, pose._replace(rotations=rotations), np.zeros(4))
    np.testing.assert_allclose(after, (before - pivot) @ turn.T + pivot, atol=1e-12)


def test_unapply_inverts_apply(x64):
    body, pose = random_body(), random_pose()
    transforms = skinning.blend(body.weights, skinning.joint_transforms(pose.rotations, body.joints, body.parents))
    determinant = np.linalg.det(np.asarray(transforms)[:, :, :3])
    sound = np.abs(determinant) > 1e-3
    assert sound.sum() > 20
    posed = skinning.apply(transforms, body.vertices)
    np.testing.assert_allclose(np.asarray(skinning.unapply(transforms, posed))[sound], body.vertices[sound], atol=1e-11)
    inverse = np.linalg.inv(np.asarray(transforms)[sound, :, :3])
    np.testing.assert_allclose(
        np.asarray(skinning.unapply_direction(transforms, body.vertices))[sound],
        np.einsum("nab,nb->na", inverse, body.vertices[sound]),
        rtol=1e-9,
    )


def test_unapply_is_finite_where_a_blend_collapses():
    half_turn = np.diag([-1, 1, -1]).astype(np.float32)
    flat = 0.5 * (np.eye(3, dtype=np.float32) + half_turn)
    transforms = np.concatenate([flat, np.ones((3, 1), np.float32)], axis=1)[None]
    point = np.array([[0.1, 0.2, 0.3]], np.float32)
    gradient = jax.jit(jax.jacobian(lambda t: skinning.unapply(t, point)))(transforms)
    assert np.isfinite(skinning.unapply(transforms, point)).all() and np.isfinite(gradient).all()


def test_vertex_normals_of_a_cube_corner_weigh_by_area():
    # three faces at the origin; the one in the plane z = 0 is twice as large
    vertices = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 1], [5, 5, 5]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    expected = np.array([1, 0, 2]) / 5**0.5
    normals = skinning.vertex_normals(vertices, faces)
    np.testing.assert_allclose(normals[0], expected, atol=1e-6)
    np.testing.assert_array_equal(normals[4], 0.0)
    gradient = jax.jit(jax.jacobian(lambda v: skinning.vertex_normals(v, faces)))(vertices)
    assert np.isfinite(gradient).all()
