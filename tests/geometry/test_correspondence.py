import igl
import numpy as np
import pytest

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
    on, _ = correspondence.on_each_other(felt, garment)
    found, pinned = correspondence.rigged_like(felt, garment, on), np.asarray(felt.pinned)
    for name in ("weights", "shapedirs"):
        own, given, new = (np.asarray(getattr(it, name)) for it in (felt, garment, found))
        expected = sum(
            given[corner] * share.reshape(-1, *[1] * (given.ndim - 1))
            for corner, share in zip(on.corners.T, on.shares.T)
        )
        np.testing.assert_allclose(new[~pinned], expected[~pinned], atol=1e-6)
        np.testing.assert_array_equal(new[pinned], own[pinned])
        assert np.abs(new - own).max() > 1e-3
    np.testing.assert_allclose(np.sum(found.weights, axis=1), 1.0, atol=1e-5)
    for name in ("vertices", "faces", "pinned"):
        np.testing.assert_array_equal(getattr(found, name), getattr(felt, name))
