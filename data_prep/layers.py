"""Layers of a garment: the two sides of one with thickness, and parts that lie inside of other parts."""

from pathlib import Path
from typing import NamedTuple

import igl
import numpy as np

from clothjax.geometry.topology import components
from data_prep.dressing import outward
from data_prep.placement import Surface

THICKEST = 0.02  # m, between the sides of a garment with thickness
FARTHEST = 0.1  # m, from a layer to the one around it
FAR_APART = 3.0  # times the distance in the middle; two strips across a narrow tongue are farther apart
OPPOSED = -0.8  # cosine between the normals of two sides, at most
SMOOTH = 0.5  # cosine between the normals of two faces that are beside each other, at least; a strip is at an edge
PATCH = 0.001  # of a part's area; of smaller smooth pieces it is not decided by themselves which side they are
LEAST_SIDE, MOST_SIDE = 0.35, 0.65  # of a part's area, that is its outer side
INWARD = 1e-5  # m, from which a ray starts beside its own face


class Sides(NamedTuple):
    """Which faces of a mesh are a side of something with thickness."""

    thick: np.ndarray  # [F] bool, of a part with thickness
    opposite: np.ndarray  # [F], the face of the other side behind it, -1 for none
    faces: np.ndarray  # [F, 3], turned so that their normals point out of the material
    apart: float  # m, between the sides, in the middle


def sides(vertices: np.ndarray, faces: np.ndarray) -> Sides:
    """Find the parts of a mesh [V, 3] m, [F, 3] that are mostly two sides, back to back and joined somewhere."""
    turned, part = igl.bfs_orient(faces)
    normal, area = _normals(vertices, turned)
    hits = [_first_hit(vertices, turned, way * normal, THICKEST) for way in (-1, 1)]
    found = np.stack([_meets(part, normal, hit, OPPOSED) for hit, _ in hits])
    share = np.stack([np.bincount(part, area * met) for met in found]) / np.bincount(part, area)
    behind = share[0] >= share[1]
    thick = share.max(axis=0)[part] > 0.5
    hit, distance, met = (np.where(behind[part], *ways) for ways in (*zip(*hits, strict=True), found))
    met &= thick
    apart = float(np.median(distance[met])) if met.any() else 0.0
    opposite = np.where(met & (distance < FAR_APART * apart), hit, -1)
    return Sides(thick, opposite, np.where(behind[part][:, None], turned, turned[:, ::-1]), apart)


def outer_side(path: str | Path, vertices: np.ndarray, two: Sides, surface: Surface) -> np.ndarray:
    """Return which faces [F] bool remain of a mesh if of each part with thickness only the outer side is kept.

    The strip that joins the sides, along hems, has neither side behind it. It goes with the inner one.

    Args:
        path: of the mesh.
        vertices: [V, 3] m.
        two: its sides.
        surface: of the body, vertices [B, 3] m and faces.

    Raises:
        ValueError: naming the file and the place, if a part has no two sides alike.
    """
    normal, area = _normals(vertices, two.faces)
    beside = igl.triangle_triangle_adjacency(two.faces)[0]
    pairs = np.stack([np.repeat(np.arange(len(beside)), 3), beside.reshape(-1)], axis=1)
    pairs = pairs[(pairs >= 0).all(axis=1)]
    has = two.opposite >= 0
    meeting = has & (two.faces[two.opposite][:, :, None] == two.faces[:, None]).any(axis=(1, 2))
    cosine = (normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(axis=1)
    hem = meeting[pairs].all(axis=1) & (cosine < 0)  # where the sides meet without a strip
    part = components(len(beside), pairs)
    patch = components(len(beside), pairs[has[pairs].all(axis=1) & (cosine > SMOOTH)])
    sure = has & (np.bincount(patch, area)[patch] > PATCH * np.bincount(part, area)[part])
    side = components(len(beside), pairs[sure[pairs].all(axis=1) & ~hem])
    outer = sure & looks_away(vertices, two.faces, side, surface)[side]
    doubtful = components(len(beside), pairs[~sure[pairs].any(axis=1) & (cosine > SMOOTH)])
    on_outer, on_inner = (
        np.isin(doubtful, doubtful[np.isin(two.faces, two.faces[which]).any(axis=1) & ~sure])
        for which in (outer, sure & ~outer)
    )
    kept = ~two.thick | outer | (~sure & on_outer & ~on_inner)
    share = np.bincount(part, area * kept) / np.bincount(part, area)
    wrong = two.thick & ((share < LEAST_SIDE) | (share > MOST_SIDE))[part]
    if wrong.any():
        place = np.round(vertices[two.faces[wrong][0]].mean(axis=0), 2)
        raise ValueError(
            f"{path}: the part at {place} m has no outer side that can be told from an inner one: delete its inner "
            "side and the strip between, or leave it out (--object)"
        )
    return kept


def inside(vertices: np.ndarray, faces: np.ndarray, surface: Surface) -> tuple[np.ndarray, float]:
    """Return which faces [F] bool are of parts that lie mostly inside of other parts, as a lining does.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3].
        surface: of the body, vertices [B, 3] m and faces; inside is towards it.

    Returns:
        These faces, and the distance in m to the parts around them, in the middle; 0 for none.
    """
    turned, part = igl.bfs_orient(faces)
    away = looks_away(vertices, turned, part, surface)
    turned = np.where(away[part][:, None], turned, turned[:, ::-1])
    normal, area = _normals(vertices, turned)
    hit, distance = _first_hit(vertices, turned, normal, FARTHEST)
    # another part, met from its inside: the other leg is met from its outside
    under = (hit >= 0) & (part[hit] != part) & ((normal[hit] * normal).sum(axis=1) > 0)
    within = (np.bincount(part, area * under) > 0.5 * np.bincount(part, area))[part]
    return within, float(np.median(distance[within & under])) if within.any() else 0.0


def looks_away(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, surface: Surface) -> np.ndarray:
    """Return for each part [P] bool of a mesh whether most of its area looks away from the body.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3].
        part: [F], of each face, from 0 to P - 1.
        surface: of the body, vertices [B, 3] m and faces.
    """
    normal, area = _normals(vertices, faces)
    away = outward(vertices[faces].mean(axis=1), *surface)[1]
    return np.bincount(part, area * (away * normal).sum(axis=1)) >= 0


def _normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit normals [F, 3] and areas [F] m^2 of faces."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, 1e-12)[:, None], length / 2


def _first_hit(
    vertices: np.ndarray, faces: np.ndarray, directions: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the face [F] that a ray from each face's middle meets first within `reach` m, -1 for none, and where."""
    vertices, faces = np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
    tree = igl.AABB()
    tree.init(vertices, faces)
    start = vertices[faces].mean(axis=1) + INWARD * directions
    face, distance, _ = tree.intersect_ray_first(vertices, faces, start, np.ascontiguousarray(directions), reach)
    return face, distance


def _meets(part: np.ndarray, normal: np.ndarray, hit: np.ndarray, cosine: float) -> np.ndarray:
    """Return which rays [F] bool met a face of their own part whose normal is opposed to their face's."""
    return (hit >= 0) & (part[hit] == part) & ((normal[hit] * normal).sum(axis=1) < cosine)
