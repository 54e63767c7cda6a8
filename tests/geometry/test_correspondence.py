import igl
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from clothjax.body import skinning
from clothjax.files import storage
from clothjax.geometry import correspondence


@pytest.fixture(scope="module")
def meshes():
    """The skirt with fewer vertices, and with more."""
    body = storage.load_body("body")
    return tuple(storage.load_garment(f"skirt_{count}", body) for count in (1000, 4000))


def test_points_lie_where_another_library_finds_the_nearest(meshes):
    felt, garment = meshes
    on, _ = correspondence.on_each_other(felt, garment)
    points, vertices = np.float64(felt.vertices), np.float64(garment.vertices)
    nearest = igl.point_mesh_squared_distance(points, vertices, np.asarray(garment.faces, np.int64))[2]
    free = ~np.asarray(felt.pinned)
    np.testing.assert_allclose(on.interpolated(np.asarray(garment.vertices))[free], nearest[free], atol=1e-5)
    np.testing.assert_array_equal(on.shares[~free], 0.0)


def test_what_feels_is_skinned_and_shaped_as_what_is_shown(meshes):
    felt, garment = meshes
    found = correspondence.rigged_like(felt, garment)
    points, vertices, faces = np.float64(felt.vertices), np.float64(garment.vertices), np.int64(garment.faces)
    _, face, nearest = igl.point_mesh_squared_distance(points, vertices, faces)
    corners = faces[face]
    shares = igl.barycentric_coordinates(nearest, *(np.ascontiguousarray(vertices[corners[:, k]]) for k in range(3)))
    for name in ("weights", "shapedirs"):
        own, given, new = (np.asarray(getattr(it, name)) for it in (felt, garment, found))
        expected = np.einsum("nk,nk...->n...", shares, given[corners])
        np.testing.assert_allclose(new, expected, atol=1e-4)
        assert np.abs(new - own).max() > 1e-3
    np.testing.assert_allclose(np.sum(found.weights, axis=1), 1.0, atol=1e-5)
    for name in ("vertices", "faces", "pinned"):
        np.testing.assert_array_equal(getattr(found, name), getattr(felt, name))


def test_a_pinned_waist_is_stretched_by_a_pose_no_more_than_that_of_what_is_shown(meshes):
    """Of edges with one pinned end; with the skinning that each has of its own, the waist of what feels is torn."""
    body, clip = storage.load_body("body"), storage.load_motion("dance_0")
    joints = skinning.shaped_joints(body, jnp.zeros(body.shapedirs.shape[-1]))
    rotations, positions = skinning.forward_kinematics(jnp.asarray(clip.rotations[40]), joints, body.parents)

    def stretch(garment):
        rest, edges = np.asarray(garment.vertices), trimesh.Trimesh(garment.vertices, garment.faces).edges_unique
        edges = edges[np.asarray(garment.pinned)[edges].sum(axis=1) == 1]
        posed = np.einsum("jab,vjb->vja", rotations, rest[:, None] - np.asarray(joints)) + np.asarray(positions)
        posed = np.einsum("vj,vja->va", garment.weights, posed)
        length, before = (np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (posed, rest))
        return np.abs(length / before - 1).max()

    felt, garment = meshes
    rigged = correspondence.rigged_like(felt, garment)
    own = rigged._replace(weights=np.where(np.asarray(felt.pinned)[:, None], felt.weights, rigged.weights))
    assert stretch(rigged) < 2 * stretch(garment) < 0.7 * stretch(own)
