"""Connectivity of a triangle mesh: edges, hinges, components, boundary. NumPy only."""

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from clothjax.types import Mesh


def mesh(faces: np.ndarray, vertex_count: int | None = None) -> Mesh:
    """Build the faces, hinges and edges of a triangle mesh.

    Args:
        faces: [F, 3] vertex indices.
        vertex_count: V, by default the highest index plus one.

    Returns:
        Mesh with hinges [H, 4], sorted by edge. A hinge has the edge (a, b) as directed in its left face, then the
        vertices opposite it in the left and in the right face. The left face is the first of the two in `faces`. An
        edge of three or more faces makes one hinge of the first two, as in HOOD (Grigorev et al. 2023).

    Raises:
        ValueError: if an index is out of range, a face has a vertex twice, or the array is not [F, 3] of integers.
    """
    faces = _checked(faces, vertex_count)
    corners, sorted_edges = _corners(faces)
    order = np.lexsort((np.arange(len(corners)) // 3, sorted_edges[:, 1], sorted_edges[:, 0]))
    ranked = sorted_edges[order]
    same_as_previous = np.r_[False, (ranked[1:] == ranked[:-1]).all(axis=1)]
    second = np.flatnonzero(same_as_previous & ~np.r_[False, same_as_previous[:-1]])
    left, right = corners[order[second - 1]], corners[order[second]]
    return Mesh(faces, np.concatenate([left, right[:, 2:]], axis=1).astype(np.int32), edges(faces))


def free_mesh(faces: np.ndarray, pinned: np.ndarray) -> Mesh:
    """Build the `mesh` of the faces, hinges and edges that have a vertex which is not pinned.

    Args:
        pinned: [V] bool.
    """
    return Mesh(*(elements[~pinned[elements].all(axis=1)] for elements in mesh(faces, len(pinned))))


def edges(faces: np.ndarray) -> np.ndarray:
    """Return the undirected edges [E, 2] int32 of faces [F, 3], lower index first, sorted, without repeats."""
    return np.unique(_corners(_checked(faces))[1], axis=0).astype(np.int32).reshape(-1, 2)


def directed(undirected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both directions of undirected edges [E, 2] as senders and receivers, each [2 E] int32.

    They are sorted by receiver, then by sender.
    """
    undirected = np.asarray(undirected, np.int32).reshape(-1, 2)
    both = np.concatenate([undirected, undirected[:, ::-1]])
    both = both[np.lexsort((both[:, 0], both[:, 1]))]
    return np.ascontiguousarray(both[:, 0]), np.ascontiguousarray(both[:, 1])


def components(vertex_count: int, links: np.ndarray) -> np.ndarray:
    """Return the connected component [V] int32 of every vertex, numbered from zero in order of their lowest vertices.

    Args:
        vertex_count: V.
        links: [E, 2] edges or [F, 3] faces.
    """
    links = np.asarray(links)
    ends = np.stack([links[:, :-1].ravel(), links[:, 1:].ravel()])
    graph = scipy.sparse.coo_array((np.ones(ends.shape[1], bool), ends), shape=(vertex_count, vertex_count))
    labels = connected_components(graph, directed=False)[1]
    _, first, member = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[member].astype(np.int32)


def boundary_mask(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Return a mask [V] bool of the vertices on an edge that only one face has."""
    mask = np.zeros(vertex_count, bool)
    mask[_boundary(faces)] = True
    return mask


def boundary_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the boundaries of a mesh, such as neck, hem and cuffs.

    Args:
        faces: [F, 3] vertex indices.

    Returns:
        Vertices [N] int32 of each boundary, ascending; boundaries in order of their lowest vertices. Boundaries
        that share a vertex come out as one.
    """
    border = _boundary(faces)
    used = np.unique(border)
    label = components(int(border.max(initial=-1)) + 1, border)[used]
    return [used[label == part] for part in np.unique(label)]


def _boundary(faces: np.ndarray) -> np.ndarray:
    """Return the edges [N, 2] int32 that only one face has, lower index first."""
    sorted_edges = _corners(_checked(faces))[1]
    code = sorted_edges[:, 0].astype(np.int64) * (int(sorted_edges.max(initial=0)) + 1) + sorted_edges[:, 1]
    _, first, count = np.unique(code, return_index=True, return_counts=True)
    return sorted_edges[first[count == 1]]


def _corners(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each face's edges with the vertices opposite [3 F, 3], in file order, and the sorted edges [3 F, 2]."""
    corners = np.stack([faces, np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=1).reshape(-1, 3)
    return corners, np.sort(corners[:, :2], axis=1)


def _checked(faces: np.ndarray, vertex_count: int | None = None) -> np.ndarray:
    """Return faces [F, 3] as int32, or raise a ValueError that names the first wrong face."""
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
