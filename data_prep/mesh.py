"""Plain operations on triangle meshes: edges, connected parts, cutting, the surface of a field."""

import igl
import numpy as np

from clothjax.geometry.topology import components


def edge_table(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the edges of a mesh and how faces and edges meet.

    Args:
        faces: [F, 3].

    Returns:
        Edges [E, 2] with ascending ends; the edges ab, bc, ca of each face [F, 3]; the number of faces at each
        edge [E].
    """
    half_edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    size = int(half_edges.max()) + 1
    code, of_face, count = np.unique(
        half_edges[:, 0] * size + half_edges[:, 1], return_inverse=True, return_counts=True
    )
    return np.stack([code // size, code % size], axis=1), of_face.reshape(-1, 3), count


def component(vertices: np.ndarray, faces: np.ndarray, near: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the connected part with most faces, or the one with the vertex nearest to the point `near` [3]."""
    label = components(len(vertices), faces)
    wanted = np.bincount(label[faces[:, 0]]).argmax()
    if near is not None:
        used = np.unique(faces)
        wanted = label[used[((vertices[used] - near) ** 2).sum(axis=1).argmin()]]
    return compact(vertices, faces[label[faces[:, 0]] == wanted])


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh without its unused vertices."""
    used, index = np.unique(faces, return_inverse=True)
    return vertices[used], index.reshape(faces.shape)


def clip(vertices: np.ndarray, faces: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the part of a mesh where `distance` [V] is <= 0; new vertices keep 2 % away from an edge's ends."""
    distance = np.where(np.abs(distance) < 1e-9, -1e-9, distance)
    edges = edge_table(faces)[0]
    edges = edges[(distance[edges[:, 0]] > 0) != (distance[edges[:, 1]] > 0)]
    start, end = edges.T
    share = np.clip(distance[start] / (distance[start] - distance[end]), 0.02, 0.98)[:, None]
    cut = {(int(a), int(b)): len(vertices) + i for i, (a, b) in enumerate(edges)}
    vertices = np.concatenate([vertices, vertices[start] * (1 - share) + vertices[end] * share])
    inside = distance[faces] <= 0
    count = inside.sum(axis=1)
    triangles = faces[count == 3].tolist()
    for face, within in zip(faces.tolist(), inside):
        if within.sum() not in (1, 2):
            continue
        odd = int(np.argmax(within)) if within.sum() == 1 else int(np.argmin(within))
        a, b, c = (face[(odd + k) % 3] for k in range(3))
        x, y = cut[min(a, b), max(a, b)], cut[min(a, c), max(a, c)]
        triangles += [[a, x, y]] if within.sum() == 1 else [[b, c, y], [b, y, x]]
    return compact(vertices, np.array(triangles, int).reshape(-1, 3))


def zero_set(places: np.ndarray, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface on which a field [X, Y, Z], given at places [X, Y, Z, 3] of a grid, is zero."""
    values = np.ascontiguousarray(field.transpose(2, 1, 0)).reshape(-1)  # x runs fastest, as igl wants it
    corners = np.ascontiguousarray(places.transpose(2, 1, 0, 3)).reshape(-1, 3)
    return igl.marching_cubes(values, corners, *field.shape, 0.0)[:2]


def carried_over(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return at points [P, 3] the values [V, ...] of the nearest place on a mesh, [P, ...]."""
    _, face, foot = igl.point_mesh_squared_distance(points, vertices, faces)
    corners = [np.ascontiguousarray(vertices[faces[face, k]]) for k in range(3)]
    shares = np.clip(igl.barycentric_coordinates(foot, *corners), 0.0, 1.0)
    shares /= shares.sum(axis=1, keepdims=True)
    return np.einsum("pk,pk...->p...", shares, values[faces[face]])
