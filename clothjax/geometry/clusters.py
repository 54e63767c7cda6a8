"""The nearest point of a cloud, searched for among clusters of its points: fast, and rarely not the nearest."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.geometry.proximity import LAST, even, halved
from clothjax.types import Array

ASKED, GIVEN = 8, 16  # most positions, and points, of a cluster
BESIDE = 40  # points that lie beside a cluster of positions, if they are as densely everywhere; fewer positions else
TRIED = 24  # clusters of points that are searched for a cluster of positions
NO_EDGES = np.zeros((0, 2), np.int32)


class Clusters(NamedTuple):
    """Positions and points in clusters of neighbours; a cluster repeats its last."""

    positions: Array  # [G, S] int32, every position; S is at most `ASKED`
    points: Array  # [P, GIVEN] int32, every point
    edges: Array  # [G, M] int32, every edge of positions beside one of its ends; -1 in a cluster without any


def divided(positions: Array, points: Array, edges: Array = NO_EDGES) -> Clusters:
    """Divide positions [V, 3] m and points [N, 3] m, as they lie in the canonical pose, into clusters of neighbours.

    Args:
        edges: [E, 2] of the positions, for `nearest_and_of_edges`.
    """
    size = max(1, min(ASKED, BESIDE * len(positions) // len(points)))
    both = ((np.asarray(positions), size), (np.asarray(points), GIVEN))
    asked, given = (even(halved(x, np.arange(len(x)), size), size) for x, size in both)
    return Clusters(asked, given, _beside(asked, np.asarray(edges)))


def _beside(asked: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the edges [G, M] of clusters [G, S]: each beside the end that has fewer yet."""
    own = np.zeros(asked.max() + 1, np.int32)
    own[asked] = np.arange(len(asked))[:, None]
    members: list[list[int]] = [[] for _ in asked]
    for edge, ends in enumerate(own[edges]):
        min((members[end] for end in ends), key=len).append(edge)
    most = max(map(len, members))
    return even([np.array(each or [-1] * most, np.int32) for each in members], most)


def nearest_in_clusters(positions: Array, points: Array, clusters: Clusters) -> Array:
    """Find the index [V] of the point [N, 3] m nearest to each position [V, 3] m, in the clusters that seem near.

    For each cluster of positions, the `TRIED` clusters of points are searched that come nearest to its mean: by their
    own mean, less the radius about it. No gradient.
    """
    positions, points, clusters = jax.lax.stop_gradient(jax.tree.map(jnp.asarray, (positions, points, clusters)))
    return _nearest(positions, points, clusters.positions, clusters, _near(positions, points, clusters))


def nearest_and_of_edges(positions: Array, points: Array, clusters: Clusters, edges: Array) -> tuple[Array, Array]:
    """Return `nearest_in_clusters`, and the index [E] of the point nearest to the middle of each edge [E, 2].

    That is searched for in the same clusters of points as the nearest to one of the edge's ends. No gradient.

    Args:
        edges: those that `divided` got.

    Raises:
        ValueError: for edges that are not in the clusters.
    """
    if (len(edges) > 0) != (clusters.edges.shape[1] > 0):
        raise ValueError(f"the clusters were divided without these {len(edges)} edges, or for others")
    positions, points, clusters = jax.lax.stop_gradient(jax.tree.map(jnp.asarray, (positions, points, clusters)))
    near = _near(positions, points, clusters)
    return (
        _nearest(positions, points, clusters.positions, clusters, near),
        _nearest(middles(positions, edges), points, clusters.edges, clusters, near),
    )


def middles(positions: Array, edges: Array) -> Array:
    """Return the middles [E, 3] m of edges [E, 2] of positions [V, 3] m."""
    return 0.5 * (positions[edges[:, 0]] + positions[edges[:, 1]])


def _near(positions: Array, points: Array, clusters: Clusters) -> Array:
    """Return the clusters of points [`TRIED`, G] that come nearest to clusters of positions, nearest first."""
    means = [jnp.mean(points[:, i][clusters.points], axis=1) for i in range(3)]
    radius = jnp.sqrt(jnp.max(sum((points[:, i][clusters.points] - means[i][:, None]) ** 2 for i in range(3)), axis=1))
    asked = (jnp.mean(positions[:, i][clusters.positions], axis=1) for i in range(3))
    apart = sum((mean[None] - means[i][:, None]) ** 2 for i, mean in enumerate(asked))
    bound = jnp.sqrt(apart) + (jnp.max(radius) - radius)[:, None]  # [P, G], not below zero
    # as in `proximity.nearest_face`: the last bits of a bound hold its cluster
    last_cluster = len(clusters.points) - 1
    bits = (1 << last_cluster.bit_length()) - 1
    keys = jax.lax.bitcast_convert_type(bound.astype(jnp.float32), jnp.int32) & ~bits
    keys |= jnp.arange(last_cluster + 1, dtype=jnp.int32)[:, None]

    def following(last: Array, _: None) -> tuple[Array, Array]:
        last = jnp.min(jnp.where(keys > last[None], keys, LAST), axis=0)
        return last, last & bits

    start = jnp.full(keys.shape[1], -1, jnp.int32)
    return jax.lax.scan(following, start, length=min(TRIED, last_cluster + 1))[1]


def _nearest(positions: Array, points: Array, members: Array, clusters: Clusters, near: Array) -> Array:
    """Return the index [V] of the nearest of the points [N, 3] m in the clusters [T, G] for positions [V, 3] m.

    Args:
        members: [G, S] int32, the positions that the clusters are near to; -1 is none.
    """
    asked = [positions[:, i][members].T for i in range(3)]  # [S, G]
    size = clusters.points.shape[1]
    table = jnp.stack([points[:, i][clusters.points] for i in range(3)], axis=1).reshape(len(clusters.points), -1)

    def search(carry: tuple[Array, Array], cluster: Array) -> tuple[tuple[Array, Array], None]:
        least, place = carry
        given = table[cluster].T.reshape(3, size, -1)
        for number in range(size):  # an argmin would take several times as long
            apart = sum((asked[i] - given[i, number][None]) ** 2 for i in range(3))
            place = jnp.where(apart < least, (cluster * size + number)[None], place)
            least = jnp.minimum(least, apart)
        return (least, place), None

    start = (jnp.full_like(asked[0], jnp.inf), jnp.zeros(asked[0].shape, jnp.int32))
    (_, place), _ = jax.lax.scan(search, start, near)
    index = clusters.points.reshape(-1)[place.T]
    to = jnp.where(members < 0, len(positions), members)
    return jnp.zeros(len(positions), jnp.int32).at[to].set(index)
