"""Seams of a mesh of panels: borders that lie on each other are joined, those that nearly do are told."""

from pathlib import Path

import igl
import numpy as np
from scipy.spatial import cKDTree

from clothjax.geometry.topology import boundary_mask, components
from data_prep.mesh import edge_table

WELD_DISTANCE = 1e-4  # m; closer vertices become one
BESIDE, MAYBE_BESIDE = 0.002, 0.005  # m, between the sides of a seam that is not sewn; of one that may be meant
LEAST_BESIDE = 0.05  # m, for which they must run so
NEIGHBOUR = 0.02  # m along a border, within which it is beside itself at any rate
HOLE = 0.1  # m, of a border that is a hole or a slit; it is not beside others
MEETING = 0.006  # m, around a vertex where borders meet
NARROW = 0.2  # of its length, of a slit
SPACING = 2.5e-4  # m, between the points of a border that are compared


def sewn(vertices: np.ndarray, faces: np.ndarray, distance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Join borders within `distance` m of each other, also where one has vertices that the other lacks.

    Returns:
        Vertices [W, 3] m and faces of the joined mesh, for each of the given vertices [V] its index there, and the
        number of border vertices that were set into the edges of another border.
    """
    border = np.flatnonzero(boundary_mask(faces, len(vertices)))
    near = np.zeros((0, 2), np.int64)
    if len(border):
        near = border[cKDTree(vertices[border]).query_pairs(distance, output_type="ndarray")]
    edges, size = edge_table(faces)[0], len(vertices)
    near = near[~np.isin(near.min(axis=1) * size + near.max(axis=1), edges[:, 0] * size + edges[:, 1])]
    _, first, index = np.unique(components(size, near), return_index=True, return_inverse=True)
    vertices, faces = vertices[first], index[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    faces, splits = _split_at_borders(vertices, faces, max(distance, WELD_DISTANCE))
    return vertices, faces, index, splits


def _split_at_borders(vertices: np.ndarray, faces: np.ndarray, distance: float) -> tuple[np.ndarray, int]:
    """Split border edges at the border vertices within `distance` m of them; return faces and the number of splits."""
    splits = 0
    while True:
        edges, _, count = edge_table(faces)
        border = np.unique(edges[count == 1])
        tree, at = cKDTree(vertices[border]) if len(border) else None, {}
        for a, b in edges[count == 1].tolist():
            along = vertices[b] - vertices[a]
            length = float(np.linalg.norm(along))
            inside = border[tree.query_ball_point(0.5 * (vertices[a] + vertices[b]), 0.5 * length)]
            place = (vertices[inside] - vertices[a]) @ along / max(length, 1e-12)
            off = np.linalg.norm(vertices[inside] - vertices[a] - np.outer(place / max(length, 1e-12), along), axis=1)
            on = (distance < place) & (place < length - distance) & (off < distance)
            if on.any():  # nearest to the middle, so that many vertices on one edge take few rounds
                at[a, b] = int(inside[on][np.abs(place[on] - 0.5 * length).argmin()])
        kept, halves = [], []
        for face in faces.tolist():
            corners = [(face[k], face[(k + 1) % 3], face[(k + 2) % 3]) for k in range(3)]
            split = next((c for c in corners if at.get((min(c[:2]), max(c[:2])), c[2]) != c[2]), None)
            if split is None:
                kept.append(face)
            else:
                a, b, c = split
                middle = at[min(a, b), max(a, b)]
                halves += [[a, middle, c], [middle, b, c]]
        if not halves:
            return faces, splits
        faces, splits = np.array(kept + halves), splits + len(halves) // 2


def seams(
    torn: tuple[np.ndarray, np.ndarray], vertices: np.ndarray, faces: np.ndarray, distance: float
) -> tuple[int, int]:
    """Count the pieces of a mesh and its seams: lines from junction to junction along which borders are joined.

    Args:
        torn: vertices [U, 3] m and faces of the mesh before it was welded and sewn.
        vertices: [V, 3] m, after.
        faces: [F, 3], after.
        distance: in m, within which it was sewn.
    """
    edges, _, times = edge_table(torn[1])
    borders, pieces = edges[times == 1], len(np.unique(components(len(torn[0]), torn[1])[torn[1]]))
    if not len(borders):
        return pieces, 0
    edges, _, times = edge_table(faces)
    edges = edges[times == 2]
    a, b = vertices[edges].swapaxes(0, 1)
    off = [igl.point_mesh_squared_distance(points, torn[0], borders)[0] for points in (a, (a + b) / 2, b)]
    edges = edges[np.max(off, axis=0) <= max(distance, WELD_DISTANCE) ** 2]
    order = np.argsort(edges.reshape(-1), kind="stable")
    _, first, meeting = np.unique(edges.reshape(-1)[order], return_index=True, return_counts=True)
    onward = first[meeting == 2]  # vertices at which a seam goes on
    return pieces, len(np.unique(components(len(edges), np.stack([order[onward], order[onward + 1]], axis=1) // 2)))


def check_seams(path: str | Path, vertices: np.ndarray, faces: np.ndarray, distance: float, allow: bool) -> list[str]:
    """Refuse a mesh whose borders run closely beside each other, or a border beside itself, as an open seam does.

    Args:
        path: of the mesh.
        vertices: [V, 3] m.
        faces: [F, 3].
        distance: in m, within which it was sewn.
        allow: take it as it is.

    Returns:
        What is so taken, or runs farther apart than seams do: at most one line.

    Raises:
        ValueError: naming the file, the place, and the distance that sews it.
    """
    borders = _borders(igl.bfs_orient(faces)[0])
    if not borders:
        return []
    loops = [_dense(vertices[loop]) for loop in borders]
    points, along = (np.concatenate(parts) for parts in zip(*loops, strict=True))
    number = np.concatenate([np.full(len(own), k) for k, (_, own) in enumerate(loops)])
    pairs = cKDTree(points).query_pairs(MAYBE_BESIDE, output_type="ndarray")
    lengths = np.array([own[-1] for _, own in loops])
    a, b = pairs.T
    onward = np.abs(along[a] - along[b])
    apart_along = np.minimum(onward, lengths[number[a]] - onward)
    longer = np.minimum(lengths[number[a]], lengths[number[b]]) > HOLE
    pairs = pairs[longer & ((number[a] != number[b]) | (apart_along > NEIGHBOUR))]
    apart = np.full(len(points), np.inf)
    between = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    for side in pairs.T:
        np.minimum.at(apart, side, between)
    meeting, times = np.unique(np.concatenate(borders), return_counts=True)
    if (times > 1).any():  # borders that meet at a vertex are near each other there
        apart[cKDTree(vertices[meeting[times > 1]]).query(points)[0] < MEETING] = np.inf
    for reach in (BESIDE, MAYBE_BESIDE):
        beside = apart < reach
        if SPACING * beside.sum() > LEAST_BESIDE:
            place, wide = np.round(points[beside][0], 2), max(np.quantile(apart[beside], 0.9), 1.01 * distance)
            sews = f"--sew {np.ceil(1e3 * wide):.0f} sews"
            said = f"two borders run {1e3 * np.median(apart[beside]):.1f} mm beside each other, as at {place} m"
            if reach == MAYBE_BESIDE or allow:
                return [f"{said}, and stay open; {sews} them"]
            raise ValueError(f"{path}: {said}: a seam that is not sewn? {sews} it, --allow leaves it open")
    slits = [own for own, _ in loops if _width(own) < BESIDE]
    if SPACING * sum(map(len, slits)) > LEAST_BESIDE:
        wide = 1e3 * max(map(_width, slits))
        return [f"{len(slits)} slits are up to {wide:.1f} mm wide, as at {np.round(slits[0][0], 2)} m, and stay open"]
    return []


def _width(border: np.ndarray) -> float:
    """Return the width in m of a border [n, 3] m that is a slit, inf for a hole."""
    long, wide = 2 * np.linalg.svd(border - border.mean(axis=0), compute_uv=False)[:2] / len(border) ** 0.5
    return float(wide) if wide < NARROW * long else np.inf


def _borders(faces: np.ndarray) -> list[np.ndarray]:
    """Return the borders of a mesh whose faces [F, 3] agree in their turn, each its vertices in order.

    At a vertex where several borders meet, a border goes on along the faces that it belongs to.
    """
    after = {(a, b): c for face in faces.tolist() for a, b, c in (face, [*face[1:], face[0]], [face[2], *face[:2]])}
    starts, found = [edge for edge in after if edge[::-1] not in after], []
    left = dict.fromkeys(starts)
    for start in starts:
        if start not in left:
            continue
        loop, edge = [], start
        while edge in left:
            del left[edge]
            loop.append(edge[0])
            edge = (edge[1], after[edge])
            while edge[::-1] in after:  # around the vertex, to the next face without a neighbour
                edge = (edge[0], after[edge[::-1]])
        found.append(np.array(loop))
    return found


def _dense(loop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points [n, 3] at most SPACING apart along a closed line [m, 3] m, and how far along it they are [n]."""
    ends = np.concatenate([loop, loop[:1]])
    lengths = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0.0, reached[-1], int(reached[-1] / SPACING) + 2)
    return np.stack([np.interp(at, reached, axis) for axis in ends.T], axis=1), at
