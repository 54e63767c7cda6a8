"""Isotropic remeshing of triangles with boundary: split, collapse, flip, relax (Botsch and Kobbelt 2004).

Boundary vertices slide along the boundary's own polyline, the others on the input surface.
"""

import igl
import numpy as np

from clothjax.geometry.topology import boundary_mask
from data_prep.mesh import compact, edge_table


def remesh(
    vertices: np.ndarray, faces: np.ndarray, length: float, iterations: int = 6
) -> tuple[np.ndarray, np.ndarray]:
    """Remesh a surface and its boundary with edges of about one length.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3], manifold.
        length: of the new edges, m.
        iterations: repetitions of the four passes.

    Returns:
        New vertices [W, 3] m and faces [G, 3].
    """
    surface, triangles = vertices.copy(), faces.copy()
    edges, _, count = edge_table(triangles)
    border = edges[count == 1]
    for k in range(iterations):
        vertices, faces = split(vertices, faces, 4 / 3 * length)
        for _ in range(12 if k == 0 else 3):
            vertices, faces, collapsed = collapse(vertices, faces, 0.8 * length, 4 / 3 * length)
            if not collapsed:
                break
        for _ in range(3):
            faces, flipped = flip(vertices, faces)
            if not flipped:
                break
        vertices = relax(vertices, faces)
        vertices = igl.point_mesh_squared_distance(vertices, surface, triangles)[2]
        if len(border):
            outer = boundary_mask(faces, len(vertices))
            vertices[outer] = _onto_segments(vertices[outer], surface[border[:, 0]], surface[border[:, 1]])
    return vertices, faces


def resample(vertices: np.ndarray, faces: np.ndarray, wanted: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Remesh a surface to the `wanted` number of vertices within 3 %; return it and the length of its edges in m."""
    # equilateral triangles: two faces of sqrt(3)/4 h^2 for each vertex
    length = np.sqrt(igl.doublearea(vertices, faces).sum() / wanted / np.sqrt(3))
    shape, triangles = remesh(vertices, faces, length, 6)
    for _ in range(4):
        if abs(len(shape) / wanted - 1) < 0.03:
            break
        length *= np.sqrt(len(shape) / wanted)
        shape, triangles = remesh(shape, triangles, length, 3)
    return shape, triangles, float(length)


def split(vertices: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Halve every edge longer than `longest` [m], cutting each face in two, three or four."""
    edges, of_face, _ = edge_table(faces)
    long = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) > longest
    middle = np.full(len(edges), -1)
    middle[long] = len(vertices) + np.arange(long.sum())
    vertices = np.concatenate([vertices, vertices[edges[long]].mean(axis=1)])
    middles = middle[of_face]
    count = (middles >= 0).sum(axis=1)
    pieces = [faces[count == 0]]
    for (a, b, c), (x, y, z), n in zip(faces[count > 0], middles[count > 0], count[count > 0]):
        # x on ab, y on bc, z on ca; turned until the single cut is on ab, or the two cuts are on ab and bc
        while n < 3 and not (x >= 0 and (n == 1 or y >= 0)):
            a, b, c, x, y, z = b, c, a, y, z, x
        if n == 3:
            pieces.append([[a, x, z], [x, b, y], [z, y, c], [x, y, z]])
        elif n == 1:
            pieces.append([[a, x, c], [x, b, c]])
        elif np.sum((vertices[a] - vertices[y]) ** 2) < np.sum((vertices[x] - vertices[c]) ** 2):
            pieces.append([[x, b, y], [a, x, y], [a, y, c]])
        else:
            pieces.append([[x, b, y], [a, x, c], [x, y, c]])
    return vertices, np.concatenate([np.asarray(p).reshape(-1, 3) for p in pieces])


def collapse(
    vertices: np.ndarray, faces: np.ndarray, shortest: float, longest: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Collapse edges shorter than `shortest` [m], shortest first, never two that touch in one pass.

    An edge stays if its collapse would change the topology, stretch an edge beyond `longest`, or turn a face.

    Returns:
        Vertices, faces, and the number of collapsed edges.
    """
    edges, _, count = edge_table(faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    short = np.flatnonzero(length < shortest)
    short = short[np.argsort(length[short], kind="stable")]
    outer = boundary_mask(faces, len(vertices))
    fans = _fans(faces, len(vertices))
    triangles = faces.tolist()
    busy = np.zeros(len(vertices), bool)
    target = np.arange(len(vertices))
    vertices, collapsed = vertices.copy(), 0
    for e in short:
        a, b = edges[e]
        on_border = count[e] == 1
        if busy[a] or busy[b] or (outer[a] and outer[b] and not on_border):
            continue
        if outer[b] and not outer[a]:
            a, b = b, a
        near_a = {v for i in fans[a] for v in triangles[i]}
        near_b = {v for i in fans[b] for v in triangles[i]}
        if len((near_a & near_b) - {a, b}) != (1 if on_border else 2):
            continue
        if on_border and len(fans[a]) + len(fans[b]) < 4:
            continue
        place = vertices[a] if outer[a] and not outer[b] else (vertices[a] + vertices[b]) / 2
        ring = list((near_a | near_b) - {a, b})
        if np.sum((vertices[ring] - place) ** 2, axis=1).max() > longest**2:
            continue
        remaining = [triangles[i] for i in set(fans[a]) | set(fans[b]) if not {a, b} <= set(triangles[i])]
        if _turns(vertices, np.array(remaining).reshape(-1, 3), (a, b), place):
            continue
        vertices[a] = place
        target[b] = a
        busy[ring] = busy[a] = busy[b] = True
        collapsed += 1
    faces = target[faces]
    a, b, c = faces.T
    return *compact(vertices, faces[(a != b) & (b != c) & (c != a)]), collapsed


def flip(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int]:
    """Flip edges if that brings valences closer to six (four on the boundary) and folds nothing.

    Returns:
        Faces [F, 3], and the number of flipped edges.
    """
    edges, of_face, count = edge_table(faces)
    size = len(vertices)
    valence = np.bincount(edges.ravel(), minlength=size)
    ideal = np.where(boundary_mask(faces, size), 4, 6)
    sides: list[list[int]] = [[] for _ in edges]
    for i, row in enumerate(of_face.tolist()):
        for e in row:
            sides[e].append(i)
    present = {(int(a), int(b)) for a, b in edges}
    faces, touched, flipped = faces.copy(), np.zeros(len(faces), bool), 0
    for e in np.flatnonzero(count == 2):
        i, j = sides[e]
        if touched[i] or touched[j]:  # its other edges' entries in `sides` are stale
            continue
        first = faces[i].tolist()
        corner = next(k for k in range(3) if first[k] not in edges[e])
        p, s, t = (first[(corner + k) % 3] for k in range(3))  # face i is (s, t, p), face j holds t -> s
        q = next(v for v in faces[j].tolist() if v not in (s, t))
        new = (min(p, q), max(p, q))
        if p == q or new in present:
            continue
        quad, change = np.array([s, t, p, q]), np.array([-1, -1, 1, 1])
        excess = valence[quad] - ideal[quad]
        if np.sum((excess + change) ** 2) >= np.sum(excess**2) or _folds(vertices, s, t, p, q):
            continue
        faces[i], faces[j] = [s, q, p], [t, p, q]
        touched[[i, j]] = True
        present.discard((min(s, t), max(s, t)))
        present.add(new)
        valence[quad] += change
        flipped += 1
    return faces, flipped


def relax(vertices: np.ndarray, faces: np.ndarray, iterations: int = 3) -> np.ndarray:
    """Move vertices within the surface towards the area-weighted mean of their neighbours."""
    edges, _, count = edge_table(faces)
    size, border = len(vertices), edges[count == 1]
    outer = boundary_mask(faces, size)
    for _ in range(iterations):
        weight = np.bincount(faces.ravel(), np.repeat(igl.doublearea(vertices, faces), 3), size)
        total, weights, along = np.zeros((size, 3)), np.zeros(size), np.zeros((size, 3))
        for a, b in (edges.T, edges.T[::-1]):
            np.add.at(total, a, vertices[b] * weight[b, None])
            np.add.at(weights, a, weight[b])
        for a, b in (border.T, border.T[::-1]):
            np.add.at(along, a, vertices[b] / 2)
        normal = igl.per_vertex_normals(vertices, faces)
        move = total / weights[:, None] - vertices
        move -= (move * normal).sum(axis=1, keepdims=True) * normal
        move[outer] = along[outer] - vertices[outer]
        vertices = vertices + np.where(outer[:, None], 0.5, 0.7) * move
    return vertices


def _fans(faces: np.ndarray, count: int) -> list[list[int]]:
    """Return for each of `count` vertices the indices of its faces."""
    fans: list[list[int]] = [[] for _ in range(count)]
    for i, face in enumerate(faces.tolist()):
        for v in face:
            fans[v].append(i)
    return fans


def _turns(vertices: np.ndarray, faces: np.ndarray, moved: tuple[int, int], place: np.ndarray) -> bool:
    """Return True if a face would turn by more than 72 degrees when the moved vertices meet at one place."""
    old = vertices[faces]
    new = np.where(np.isin(faces, moved)[..., None], place, old)
    before = np.cross(old[:, 1] - old[:, 0], old[:, 2] - old[:, 0])
    after = np.cross(new[:, 1] - new[:, 0], new[:, 2] - new[:, 0])
    size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return bool(np.any((before * after).sum(axis=1) < 0.3 * size + 1e-16))


def _folds(vertices: np.ndarray, s: int, t: int, p: int, q: int) -> bool:
    """Return True if face (s, q, p) or (t, p, q) leans by more than 53 degrees from the plane of both."""
    x = vertices
    plane = np.cross(x[t] - x[s], x[p] - x[s]) + np.cross(x[s] - x[t], x[q] - x[t])
    new = np.stack([np.cross(x[q] - x[s], x[p] - x[s]), np.cross(x[p] - x[t], x[q] - x[t])])
    size = np.linalg.norm(new, axis=1) * np.linalg.norm(plane) + 1e-20
    return bool(np.any(new @ plane < 0.6 * size))


def _onto_segments(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Project points [n, 3] onto the nearest of the segments [m, 3]."""
    along = end - start
    share = ((points[:, None] - start) * along).sum(axis=-1) / (along**2).sum(axis=-1)
    nearest = start + np.clip(share, 0, 1)[..., None] * along
    best = ((points[:, None] - nearest) ** 2).sum(axis=-1).argmin(axis=1)
    return nearest[np.arange(len(points)), best]
