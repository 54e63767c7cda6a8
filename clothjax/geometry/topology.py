"""Connectivity of a triangle mesh: edges, hinges, components, boundary. NumPy only."""

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from clothjax.types import Mesh


def mesh(faces: np.ndarray, vertex_count: int | None = None) -> Mesh:
    """Faces, hinges and edges of a triangle mesh.

    Args:
        faces: [F, 3] vertex indices.
        vertex_count: V, by default the highest index plus one.

    Returns:
        Mesh with hinges [H, 4] sorted by edge: (a, b) as directed in the left face, the first in `faces`; the
        vertices opposite it in the left and in the right face. Of three or more faces that share an edge the
        first two make the hinge, as in HOOD (Grigorev et al. 2023).

    Raises:
        ValueError: an index out of range, a vertex twice in a face, or not an [F, 3] array of integers.
    """
    faces = _checked(faces, vertex_count)
    corners, sorted_edges = _corners(faces)
    order = np.lexsort((np.arange(len(corners)) // 3, sorted_edges[:, 1], sorted_edges[:, 0]))
    ranked = sorted_edges[order]
    same_as_previous = np.r_[False, (ranked[1:] == ranked[:-1]).all(axis=1)]
    second = np.flatnonzero(same_as_previous & ~np.r_[False, same_as_previous[:-1]])
    left, right = corners[order[second - 1]], corners[order[second]]
    return Mesh(faces, np.concatenate([left, right[:, 2:]], axis=1).astype(np.int32), edges(faces))


def edges(faces: np.ndarray) -> np.ndarray:
    """Undirected edges [E, 2] int32 of faces [F, 3], lower index first, sorted, without repeats."""
    return np.unique(_corners(_checked(faces))[1], axis=0).astype(np.int32).reshape(-1, 2)


def directed(undirected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Senders and receivers [2 E] int32 of both directions of undirected edges [E, 2], sorted by receiver, then by
    sender."""
    undirected = np.asarray(undirected, np.int32).reshape(-1, 2)
    both = np.concatenate([undirected, undirected[:, ::-1]])
    both = both[np.lexsort((both[:, 0], both[:, 1]))]
    return np.ascontiguousarray(both[:, 0]), np.ascontiguousarray(both[:, 1])


def components(vertex_count: int, undirected: np.ndarray) -> np.ndarray:
    """Connected component [V] int32 of every vertex, numbered from zero in order of their lowest vertices."""
    undirected = np.asarray(undirected).reshape(-1, 2)
    ones = np.ones(len(undirected), bool)
    graph = scipy.sparse.coo_array((ones, undirected.T), shape=(vertex_count, vertex_count))
    labels = connected_components(graph, directed=False)[1]
    _, first, member = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[member].astype(np.int32)


def boundary_vertices(faces: np.ndarray) -> np.ndarray:
    """Vertices [N] int32, ascending, on an edge that only one face has."""
    return np.unique(_boundary(faces)).astype(np.int32)


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Closed boundaries of a mesh, such as neck, hem and cuffs.

    Args:
        faces: [F, 3] vertex indices.

    Returns:
        Vertices [N] int32 of each loop, from its lowest on and as directed in the faces, where these agree;
        loops in order of their lowest vertices. Loops that share a vertex come out as one. Edges with three
        faces or more may leave runs that do not close.
    """
    half_edges = _boundary(faces).tolist()
    # Backward steps come last, so that a half-edge is walked backwards only where the faces disagree.
    steps: dict[int, list[tuple[int, int]]] = {}
    for index, (a, b) in enumerate(half_edges):
        steps.setdefault(a, []).append((index, b))
    for index, (a, b) in enumerate(half_edges):
        steps.setdefault(b, []).append((index, a))
    used: set[int] = set()

    def step(vertex):
        return next(((index, head) for index, head in steps[vertex] if index not in used), None)

    loops = []
    for start in sorted(steps):
        while (taken := step(start)) is not None:
            loop = [start]
            while taken is not None:
                used.add(taken[0])
                loop.append(taken[1])
                taken = step(taken[1])
            loops.append(np.array(loop[:-1] if loop[-1] == start else loop, np.int32))
    return loops


def _boundary(faces: np.ndarray) -> np.ndarray:
    """Half-edges [N, 2] of the edges that only one face has."""
    corners, sorted_edges = _corners(_checked(faces))
    _, inverse, count = np.unique(sorted_edges, axis=0, return_inverse=True, return_counts=True)
    return corners[count[inverse.reshape(-1)] == 1, :2]


def _corners(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every face's edges and the vertices opposite [3 F, 3] in file order; the edges, sorted [3 F, 2]."""
    corners = np.stack([faces, np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=1).reshape(-1, 3)
    return corners, np.sort(corners[:, :2], axis=1)


def _checked(faces: np.ndarray, vertex_count: int | None = None) -> np.ndarray:
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise ValueError(f"faces must be integers [F, 3], not {faces.dtype} {list(faces.shape)}; triangulate the mesh")
    limit = int(faces.max(initial=-1)) + 1 if vertex_count is None else vertex_count
    outside = ((faces < 0) | (faces >= limit)).any(axis=1)
    if outside.any():
        face = int(np.argmax(outside))
        raise ValueError(
            f"face {face} is {faces[face].tolist()}, but vertex indices must be from 0 to {limit - 1}; "
            "check that faces count from zero and belong to these vertices"
        )
    repeated = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if repeated.any():
        face = int(np.argmax(repeated))
        raise ValueError(f"face {face} is {faces[face].tolist()}: its vertices must differ; remove such faces")
    return faces.astype(np.int32)
