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


class Clusters(NamedTuple):
    """Positions and points in clusters of neighbours; a cluster repeats its last."""

    positions: Array  # [G, S] int32, every position; S is at most `ASKED`
    points: Array  # [P, GIVEN] int32, every point


def divided(positions: Array, points: Array) -> Clusters:
    """Divide positions [V, 3] m and points [N, 3] m, as they lie in the canonical pose, into clusters of neighbours."""
    size = max(1, min(ASKED, BESIDE * len(positions) // len(points)))
    both = ((np.asarray(positions), size), (np.asarray(points), GIVEN))
    return Clusters(*(even(halved(x, np.arange(len(x)), size), size) for x, size in both))


def nearest_in_clusters(positions: Array, points: Array, clusters: Clusters) -> Array:
    """Find the index [V] of the point [N, 3] m nearest to each position [V, 3] m, in the clusters that seem near.

    For each cluster of positions, the `TRIED` clusters of points are searched that come nearest to its mean: by their
    own mean, less the radius about it. No gradient.
    """
    positions, points, clusters = jax.lax.stop_gradient(jax.tree.map(jnp.asarray, (positions, points, clusters)))
    asked = [positions[:, i][clusters.positions].T for i in range(3)]  # [S, G]
    given = [points[:, i][clusters.points] for i in range(3)]  # [P, GIVEN]
    means = [jnp.mean(x, axis=1) for x in given]
    radius = jnp.sqrt(jnp.max(sum((given[i] - means[i][:, None]) ** 2 for i in range(3)), axis=1))
    apart = sum((jnp.mean(asked[i], axis=0)[None] - means[i][:, None]) ** 2 for i in range(3))
    bound = jnp.sqrt(apart) + (jnp.max(radius) - radius)[:, None]  # [P, G], not below zero
    # as in `proximity.nearest_face`: the last bits of a bound hold its cluster
    last_cluster, size = len(clusters.points) - 1, clusters.points.shape[1]
    bits = (1 << last_cluster.bit_length()) - 1
    keys = jax.lax.bitcast_convert_type(bound.astype(jnp.float32), jnp.int32) & ~bits
    keys |= jnp.arange(last_cluster + 1, dtype=jnp.int32)[:, None]
    table = jnp.stack(given, axis=1).reshape(last_cluster + 1, -1)

    def search(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        last, least, place = carry
        last = jnp.min(jnp.where(keys > last[None], keys, LAST), axis=0)
        cluster = last & bits
        near = table[cluster].T.reshape(3, size, -1)
        for number in range(size):  # an argmin would take several times as long
            apart = sum((asked[i] - near[i, number][None]) ** 2 for i in range(3))
            place = jnp.where(apart < least, (cluster * size + number)[None], place)
            least = jnp.minimum(least, apart)
        return (last, least, place), None

    first = jnp.full(asked[0].shape[1], -1, jnp.int32)
    start = (first, jnp.full_like(asked[0], jnp.inf), jnp.zeros(asked[0].shape, jnp.int32))
    (_, _, place), _ = jax.lax.scan(search, start, length=min(TRIED, last_cluster + 1))
    index = clusters.points.reshape(-1)[place.T]
    return jnp.zeros(len(positions), jnp.int32).at[clusters.positions].set(index)
