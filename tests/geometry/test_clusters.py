"""The nearest point among clusters, against brute force."""

import jax
import numpy as np
import pytest
from samples import icosphere
from scipy.spatial.distance import cdist

from clothjax.geometry import clusters


def test_few_clusters_are_all_searched():
    """Whatever has become of the places by which they were divided."""
    random = np.random.default_rng(0)
    points, positions = (random.uniform(-1, 1, (count, 3)).astype(np.float32) for count in (250, 77))
    divided = clusters.divided(random.uniform(size=(77, 3)), random.uniform(size=(250, 3)))
    assert len(divided.points) <= clusters.TRIED
    found = jax.jit(clusters.nearest_in_clusters)(positions, points, divided)
    np.testing.assert_array_equal(found, cdist(positions, points).argmin(axis=1))


@pytest.mark.parametrize("origin", [0.0, 30.0])
def test_near_a_bent_body_the_clusters_searched_hold_what_is_nearest(origin):
    """A tube around an arm of a ball's many faces, both bent together after they were divided."""
    random = np.random.default_rng(0)
    vertices, faces = icosphere(4)
    limb = vertices[faces].mean(axis=1) * [0.5, 0.1, 0.1]
    around = random.uniform(0, 2 * np.pi, 1003)
    along, out = random.uniform(-0.4, 0.4, 1003), random.uniform(0.08, 0.13, 1003)
    tube = np.stack([along, out * np.cos(around), out * np.sin(around)], axis=1)
    divided = clusters.divided(tube, limb)
    for axis, size in ((0, 1003), (1, len(limb))):
        assert set(np.unique(divided[axis])) == set(range(size))

    def bent(points):
        angle = 2.0 * np.maximum(points[:, 0], 0.0)
        return (points + np.stack([0 * angle, points[:, 0] * angle, 0 * angle], axis=1) + origin).astype(np.float32)

    distances = cdist(bent(tube), bent(limb))
    found = distances[np.arange(1003), clusters.nearest_in_clusters(bent(tube), bent(limb), divided)]
    assert np.mean(found > distances.min(axis=1) + 1e-5) < 0.005


def test_a_wide_cluster_is_as_near_as_its_border_may_be():
    """One whose mean is the farthest, but which holds the nearest point."""
    random = np.random.default_rng(0)
    means = random.normal(size=(clusters.TRIED + 5, 1, 3))
    means *= 0.5 / np.linalg.norm(means, axis=-1, keepdims=True)
    tight = (means + 0.01 * random.normal(size=(len(means), clusters.GIVEN, 3))).reshape(-1, 3)
    wide = np.stack([np.linspace(0.1, 1.2, clusters.GIVEN), *np.zeros((2, clusters.GIVEN))], axis=1)
    points = np.concatenate([tight, wide]).astype(np.float32)
    given = np.arange(len(points)).reshape(-1, clusters.GIVEN)
    divided = clusters.Clusters(np.zeros((1, 1), np.int32), given, np.zeros((1, 0), np.int32))
    assert clusters.nearest_in_clusters(np.zeros((1, 3), np.float32), points, divided) == len(tight)


def test_middles_of_edges_find_what_is_nearest_to_them():
    """Beside one of their ends; some positions have no edges, as those of a pinned waist."""
    random = np.random.default_rng(0)
    sphere, faces = icosphere(4)
    points = sphere[faces].mean(axis=1).astype(np.float32)
    positions, triangles = icosphere(3)
    positions = (1.05 * positions).astype(np.float32)
    sides = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    edges = np.unique(sides, axis=0)
    edges = edges[(positions[edges][:, :, 1] < 0.5).all(axis=1)].astype(np.int32)
    divided = clusters.divided(positions, points, edges)
    own = np.zeros(len(positions), int)
    own[divided.positions] = np.arange(len(divided.positions))[:, None]
    assert (divided.edges.max(axis=1) < 0).any() and set(divided.edges[divided.edges >= 0]) == set(range(len(edges)))
    for cluster, beside in enumerate(divided.edges):
        assert all((own[edges[edge]] == cluster).any() for edge in beside if edge >= 0)
    assert divided.edges.shape[1] <= 32
    moved = (positions + 0.02 * random.normal(size=positions.shape)).astype(np.float32)
    nearest, of_edges = jax.jit(clusters.nearest_and_of_edges)(moved, points, divided, edges)
    middles = moved[edges].mean(axis=1)
    for places, found in ((moved, nearest), (middles, of_edges)):
        distances = cdist(places, points)
        assert np.mean(distances[np.arange(len(places)), found] > distances.min(axis=1) + 1e-6) < 0.01
    np.testing.assert_array_equal(nearest, clusters.nearest_in_clusters(moved, points, divided))
    assert of_edges[-1] == cdist(middles[-1:], points).argmin()  # -1 in a cluster without edges is not the last one
    with pytest.raises(ValueError, match="divided without these 1 edges"):
        clusters.nearest_and_of_edges(moved, points, clusters.divided(positions, points), edges[:1])
