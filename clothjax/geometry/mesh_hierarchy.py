"""Coarser graphs of a mesh: HOOD's edge levels and the mesh-convolution tables of Zhou et al. NumPy only."""

from collections import deque
from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import dijkstra

from clothjax.geometry import topology

EXACT_CENTRE = 10_000  # vertices; the exact centre takes V^2 bits and time V^2 times the graph's radius

Neighbours = list[list[int]]


class Level(NamedTuple):
    """The table of one mesh-convolution block: P of N vertices are kept, and each reads K places around it."""

    sampled: np.ndarray  # [P] int32, ascending indices into the N vertices
    ids: np.ndarray  # [P, K] int32 of the N vertices, the sampled one first, then ring by ring; padded with N
    mask: np.ndarray  # [P, K] bool, true where `ids` is not padding


def coarse_levels(faces: np.ndarray, levels: int, centre: int | None = None) -> list[np.ndarray]:
    """Return the coarse edges of HOOD's multi-level message passing (Grigorev et al. 2023, section 4.3).

    Each level removes the vertices at an odd hop distance from the centre and joins their neighbours.

    Args:
        faces: [F, 3] vertex indices.
        levels: number of coarse levels.
        centre: vertex from which distances are counted; by default `graph_centres` of each component.

    Returns:
        Undirected edges [E_l, 2] int32 of each level, lower index first, sorted; empty where a mesh is small.

    Raises:
        ValueError: a broken mesh, a negative number of levels, or a centre that is not one of its vertices.
    """
    if levels < 0:
        raise ValueError(f"levels is {levels}; it must be 0 or more")
    edges = topology.edges(faces)
    count = int(edges.max(initial=-1)) + 1
    labels = topology.components(count, edges)
    centres = graph_centres(count, edges)
    if centre is not None:
        if not 0 <= centre < count:
            raise ValueError(f"centre is {centre}; it must be a vertex of the mesh, 0 to {count - 1}")
        centres[labels[centre]] = centre
    result = []
    for _ in range(levels):
        edges = _coarsen(_neighbours(count, edges), _hops(count, edges, centres))
        result.append(edges)
    return result


def vertex_levels(vertex_count: int, levels: Sequence[np.ndarray]) -> np.ndarray:
    """Return the deepest coarse level [V] int32 in which each vertex has an edge, plus one; 0 for none."""
    deepest = np.zeros(vertex_count, np.int32)
    for index, level in enumerate(levels):
        deepest[level.reshape(-1)] = index + 1
    return deepest


def graph_centres(vertex_count: int, edges: np.ndarray) -> np.ndarray:
    """Find a vertex of least eccentricity in each component, ordered as `topology.components`.

    Args:
        vertex_count: V.
        edges: [E, 2] undirected.

    Returns:
        One vertex int32 per component: up to `EXACT_CENTRE` vertices the lowest exact centre. Larger graphs get
        the middle of a long shortest path, found by two breadth-first searches.
    """
    labels = topology.components(vertex_count, edges)
    if vertex_count == 0:
        return np.zeros(0, np.int32)
    search = _exact_centres if vertex_count <= EXACT_CENTRE else _approximate_centres
    return search(labels, np.asarray(edges))


def hierarchy(
    faces: np.ndarray,
    vertex_count: int,
    strides: Sequence[int],
    radii: Sequence[int],
    full_search: bool = True,
    restart: bool = True,
    seeds: Sequence[int] = (),
) -> tuple[Level, ...]:
    """Sample vertices level by level and list the vertices that each reads: graph sampling of Zhou et al. 2020.

    The result is deterministic but depends on the order of vertices and faces. The parameters of a convolution
    belong to the tables they were trained with.

    Args:
        faces: [F, 3] vertex indices.
        vertex_count: V.
        strides: least hop distance between the vertices that each level samples; 1 samples all.
        radii: hop distance within which a sampled vertex reads its neighbours, one per stride.
        full_search: link sampled vertices up to 2 stride - 1 hops apart; otherwise up to stride.
        restart: sample every component. The published tool samples only what vertex 0 or the seeds reach.
        seeds: vertices that every level samples.

    Returns:
        One Level per stride.

    Raises:
        ValueError: a broken mesh, strides and radii that do not match, or seeds that are not vertices.
    """
    if len(strides) != len(radii):
        raise ValueError(f"{len(strides)} strides but {len(radii)} radii; give one radius per stride")
    for stride, radius in zip(strides, radii, strict=True):
        if stride < 1 or radius < stride - 1:
            raise ValueError(
                f"stride {stride} with radius {radius}: a stride must be at least 1 and its radius at least "
                "stride - 1, or some vertices are never read"
            )
    if any(not 0 <= seed < vertex_count for seed in seeds):
        raise ValueError(f"seeds {list(seeds)} must be vertices, 0 to {vertex_count - 1}")
    neighbours = _ordered_neighbours(np.asarray(topology.mesh(faces, vertex_count).faces), vertex_count)
    levels = []
    for stride, radius in zip(strides, radii, strict=True):
        sampled = _spaced(neighbours, stride, seeds, restart)
        ids = _padded([_ball(neighbours, vertex, radius) for vertex in sampled], len(neighbours))
        levels.append(Level(np.array(sampled, np.int32), ids, ids < len(neighbours)))
        new = {vertex: index for index, vertex in enumerate(sampled)}
        reach = 2 * stride - 1 if full_search else stride
        neighbours = [[new[w] for w in _ball(neighbours, v, reach) if w in new] for v in sampled]
        seeds = [new[seed] for seed in seeds]
    return tuple(levels)


def _coarsen(neighbours: Neighbours, hops: np.ndarray) -> np.ndarray:
    """Return the edges of HOOD's next level, from each vertex's neighbours and hop distance [V] from the centre."""
    coarse: list[set[int]] = [set() for _ in neighbours]

    def join(a, b):
        coarse[a].add(b)
        coarse[b].add(a)

    def far(a, b):
        return a != b and b not in coarse[a] and coarse[a].isdisjoint(coarse[b])

    odd = [vertex for vertex in range(len(neighbours)) if hops[vertex] % 2]
    inner = {v: [w for w in neighbours[v] if hops[w] == hops[v] - 1] for v in odd}
    outer = {v: [w for w in neighbours[v] if hops[w] == hops[v] + 1] for v in odd}
    for v in odd:
        for a in inner[v]:
            for b in outer[v]:
                join(a, b)
    # An odd vertex that leads no further out may be all that links its neighbours. These pairs are judged by
    # the graph so far, the even neighbours after them by the growing graph.
    for a, b in [pair for v in odd if not outer[v] for pair in combinations(inner[v], 2) if far(*pair)]:
        join(a, b)
    for v in range(len(neighbours)):
        for w in neighbours[v] if hops[v] % 2 == 0 else ():
            if hops[w] % 2 == 0 and far(v, w):
                join(v, w)
    pairs = [(a, b) for a in range(len(coarse)) for b in sorted(coarse[a]) if a < b]
    return np.array(pairs, np.int32).reshape(-1, 2)


def _hops(vertex_count: int, edges: np.ndarray, sources: np.ndarray) -> np.ndarray:
    """Return the hop distance [V] from the nearest source; 0 without one, as HOOD counts loose vertices as even."""
    graph = scipy.sparse.coo_array((np.ones(len(edges), bool), edges.T), shape=(vertex_count, vertex_count)).tocsr()
    hops = dijkstra(graph, directed=False, indices=sources, unweighted=True, min_only=True)
    return np.where(np.isfinite(hops), hops, 0).astype(np.int32)


def _exact_centres(labels: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Grow the ball around every vertex at once, as rows of bits, until one fills its component."""
    neighbours = _neighbours(len(labels), edges)
    width = max(len(row) for row in neighbours)
    slots = np.array([row + [v] * (width - len(row)) for v, row in enumerate(neighbours)], np.int64).T
    component_bits = np.packbits(labels == np.arange(labels.max() + 1)[:, None], axis=1)
    balls = np.packbits(np.eye(len(labels), dtype=bool), axis=1)
    centres = np.full(len(component_bits), -1, np.int32)
    while True:
        full = (balls == component_bits[labels]).all(axis=1)
        filled, first = np.unique(labels[full], return_index=True)
        new = centres[filled] < 0
        centres[filled[new]] = np.flatnonzero(full)[first[new]]
        if (centres >= 0).all():
            return centres
        grown = balls.copy()
        for slot in slots:
            grown |= balls[slot]
        balls = grown


def _approximate_centres(labels: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Take the middle of a long shortest path of each component."""
    centres = np.unique(labels, return_index=True)[1]
    for component, start in enumerate(centres):
        member = np.flatnonzero(labels == component)
        one = member[_hops(len(labels), edges, np.array([start]))[member].argmax()]
        from_one = _hops(len(labels), edges, np.array([one]))[member]
        other = member[from_one.argmax()]
        from_other = _hops(len(labels), edges, np.array([other]))[member]
        centres[component] = member[np.maximum(from_one, from_other).argmin()]
    return centres.astype(np.int32)


def _neighbours(vertex_count: int, edges: np.ndarray) -> Neighbours:
    """List the neighbours of every vertex, ascending."""
    senders, receivers = topology.directed(edges)
    ends = np.searchsorted(receivers, np.arange(vertex_count + 1))
    senders = senders.tolist()
    return [senders[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]


def _ordered_neighbours(faces: np.ndarray, vertex_count: int) -> Neighbours:
    """List neighbours in the order in which the faces first name them; Zhou's sampling depends on it."""
    neighbours: list[dict[int, None]] = [{} for _ in range(vertex_count)]
    for a, b, c in faces.tolist():
        for p, q in ((a, b), (b, c), (c, a)):
            neighbours[p].setdefault(q)
            neighbours[q].setdefault(p)
    return [list(row) for row in neighbours]


def _ball(neighbours: Neighbours, centre: int, radius: int) -> list[int]:
    """List the vertices within `radius` hops, breadth first from the centre."""
    ball, seen, start = [centre], {centre}, 0
    for _ in range(radius):
        ring, start = ball[start:], len(ball)
        for vertex in ring:
            for w in neighbours[vertex]:
                if w not in seen:
                    seen.add(w)
                    ball.append(w)
    return ball


def _spaced(neighbours: Neighbours, stride: int, seeds: Sequence[int], restart: bool) -> list[int]:
    """Choose a maximal set of vertices at least `stride` hops apart, ascending: breadth first and greedy."""
    seen, chosen, queue = set(seeds), set(seeds), deque(seeds)
    if not queue:
        queue.append(0)  # as in the published tool, where it starts the search but is not itself chosen here
    lowest = 0
    while True:
        while queue:
            for w in neighbours[queue.popleft()]:
                if w not in seen:
                    seen.add(w)
                    queue.append(w)
                    if chosen.isdisjoint(_ball(neighbours, w, stride - 1)):
                        chosen.add(w)
        while lowest < len(neighbours) and lowest in seen:
            lowest += 1
        if not restart or lowest == len(neighbours):
            return sorted(chosen)
        seen.add(lowest)
        chosen.add(lowest)
        queue.append(lowest)


def _padded(rows: list[list[int]], value: int) -> np.ndarray:
    table = np.full((len(rows), max(map(len, rows), default=0)), value, np.int32)
    for line, row in zip(table, rows, strict=True):
        line[: len(row)] = row
    return table
