"""Nearest points of a cloud, nearest triangles of a mesh, nearest points of a triangle, and winding numbers."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.types import Array

BLOCK = 64  # points
PATCH = 32  # triangles
PART = 8  # triangles of a patch that one dipole stands for
SPREAD = 0.1  # squared length by which a part's dipole is spread, as a fraction of the part's area
PASSES = 4  # rounds over all positions, before only those without an answer are searched
CHUNK = 32  # positions searched together after that
STRIDES = 2  # steps of a search along a surface
LAST = jnp.iinfo(jnp.int32).max
TILE = 256  # triangles tried together, where all are


def _tries_all() -> bool:
    """Return whether searches try everything: on a GPU, loops that end early make a batch wait for its slowest."""
    return jax.default_backend() != "cpu"


class Patches(NamedTuple):
    """A triangle mesh prepared for searches: its F triangles are divided into G groups of neighbours, the patches."""

    faces: Array  # [F, 3] int32
    across: Array  # [F, 3] int32, the face across the edge opposite a corner; itself where there is none
    border: Array  # [B] bool, vertices of an edge that only one face has
    groups: Array  # [G, PATCH] int32, every face; a group repeats its last. Faces of each PART are neighbours
    around: Array  # [B, R] int32, the faces that have a vertex; a vertex repeats its last


def patches(vertices: np.ndarray, faces: np.ndarray) -> Patches:
    """Prepare a mesh of vertices [B, 3] m and faces [F, 3] for searches.

    The triangles are halved along the longest side of their box until a group has at most `PATCH`.
    """
    faces = np.asarray(faces)
    # half-edges (a, b) and (b, a) meet
    start, end = faces[:, [1, 2, 0]].reshape(-1), faces[:, [2, 0, 1]].reshape(-1)
    other = {pair: index // 3 for index, pair in enumerate(zip(start.tolist(), end.tolist(), strict=True))}
    reversed_edges = list(zip(end.tolist(), start.tolist(), strict=True))
    across = [other.get(pair, index // 3) for index, pair in enumerate(reversed_edges)]
    open_edge = np.array([pair not in other for pair in reversed_edges])
    border = np.zeros(len(vertices), bool)
    border[np.concatenate([start[open_edge], end[open_edge]])] = True
    centroids = np.asarray(vertices)[faces].mean(axis=1)
    # patches are halved in the same way, so that each PART of a patch holds neighbours too
    parts = [np.concatenate(halved(centroids, x, PART)) for x in halved(centroids, np.arange(len(faces)), PATCH)]
    across = np.reshape(across, (-1, 3)).astype(np.int32)
    return Patches(faces.astype(np.int32), across, border, even(parts, PATCH), _around(faces, len(vertices)))


def halved(points: np.ndarray, members: np.ndarray, size: int) -> list[np.ndarray]:
    """Divide some of the points [N, 3] into groups of `size` neighbours; the last group may have fewer."""
    if len(members) <= size:
        return [members]
    axis = np.ptp(points[members], axis=0).argmax()
    ordered = members[np.argsort(points[members, axis], kind="stable")]
    half = size * -(-len(members) // (2 * size))
    return halved(points, ordered[:half], size) + halved(points, ordered[half:], size)


def even(groups: list[np.ndarray], size: int) -> np.ndarray:
    """Return groups as rows [G, size] int32; a shorter one repeats its last."""
    return np.stack([np.pad(group, (0, size - len(group)), mode="edge") for group in groups]).astype(np.int32)


def _around(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the faces [B, R] int32 around each of `count` vertices; a vertex repeats its last."""
    order = np.argsort(faces.reshape(-1), kind="stable")
    valence = np.bincount(faces.reshape(-1), minlength=count)
    first = np.cumsum(valence) - valence
    place = first[:, None] + np.minimum(np.arange(valence.max()), np.maximum(valence[:, None] - 1, 0))
    return (order[np.minimum(place, faces.size - 1)] // 3).astype(np.int32)


def winding_number(positions: Array, corners: Array, groups: Array, asked: Array) -> Array:
    """Winding number [V] of triangles [F, 3, 3] m about positions [V, 3] m: 1 inside a closed mesh, 0 outside.

    A dipole stands for each part of a patch: the first order of Barill et al. (2018), spread so that it has no
    pole. The result is accurate farther from the mesh than the size of a part. Nearer, it is at least on the right
    side of 0.25. No gradient.

    Args:
        groups: [G, PATCH] of `patches`.
        asked: [V] bool, the positions to evaluate; the others get 0.
    """
    positions, corners, groups = jax.lax.stop_gradient(jax.tree.map(jnp.asarray, (positions, corners, groups)))
    members = groups.reshape(-1)
    again = jnp.concatenate([jnp.zeros(1, bool), members[1:] == members[:-1]])  # repeats that fill a group up
    area = 0.5 * jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = jnp.where(again[:, None], 0.0, area[members]).reshape(-1, PART, 3)
    size = jnp.sqrt(jnp.sum(area * area, axis=-1, keepdims=True))
    moment = jnp.sum(size * jnp.mean(corners, axis=1)[members].reshape(-1, PART, 3), axis=1)
    size, dipole = jnp.sum(size, axis=1), jnp.sum(area, axis=1)
    centre = moment / jnp.maximum(size, 1e-30)

    def around(position):
        # one coordinate after the other, so that it fuses
        offset = [centre[None, :, i] - position[:, None, i] for i in range(3)]
        along = sum(offset[i] * dipole[None, :, i] for i in range(3))
        squared = jnp.maximum(sum(x * x for x in offset) + SPREAD * size[None, :, 0], 1e-30)
        return jnp.sum(along / (squared * jnp.sqrt(squared)), axis=1) / (4.0 * jnp.pi)

    if _tries_all():
        return jnp.where(asked, around(positions), 0.0)
    rows, chunks = _chunks(asked)

    def chunk(index, winding):
        row = jax.lax.dynamic_slice(rows, (index * CHUNK,), (CHUNK,))
        return winding.at[row].set(around(positions[jnp.minimum(row, len(positions) - 1)]), mode="drop")

    return jax.lax.fori_loop(0, chunks, chunk, jnp.zeros(len(positions), positions.dtype))


def _chunks(chosen: Array) -> tuple[Array, Array]:
    """Indices of the true entries of [V], padded with V to whole chunks, and the number of chunks that have any."""
    count = chosen.shape[0]
    (rows,) = jnp.nonzero(chosen, size=-(-count // CHUNK) * CHUNK, fill_value=count)
    return rows, -(-jnp.sum(chosen) // CHUNK)


def nearest_point(positions: Array, points: Array) -> Array:
    """Find the index [V] of the point [P, 3] m nearest to each position [V, 3] m; the first of equals.

    Distances are taken about the points' centroid: |a|^2 - 2ab cancels badly far from the origin in float32.
    """
    centre = jnp.mean(points, axis=0, keepdims=True)
    count = -(-points.shape[0] // BLOCK)
    missing = count * BLOCK - points.shape[0]
    local = points - centre
    half = jnp.pad(0.5 * jnp.sum(local * local, axis=-1), (0, missing), constant_values=jnp.inf)
    half = half.reshape(count, BLOCK)
    local = jnp.pad(local, ((0, missing), (0, 0))).reshape(count, BLOCK, 3)
    positions = positions - centre

    def score(half, local, position):
        # half the squared distance, without the part that does not depend on the point; written out, so that it
        # fuses with the reduction and no [V, P] matrix is stored
        x, y, z = (position[..., i] * local[..., i] for i in range(3))
        return half - (x + y + z)

    # the minimum of a block vectorises, its place does not: find the block, then the place in it
    lowest = jnp.min(score(half[None], local[None], positions[:, None, None]), axis=-1)
    block = jnp.argmin(lowest, axis=1)
    place = jnp.argmin(score(half[block], local[block], positions[:, None]), axis=1)
    return (block * BLOCK + place).astype(jnp.int32)


def closest_on_triangle(positions: Array, corners: Array) -> tuple[Array, Array]:
    """Find the point of a triangle [..., 3, 3] m nearest to a position [..., 3] m.

    Triangles without area are the segments they have shrunk to.

    Returns:
        Barycentric coordinates [..., 3] of the point, and its squared distance [...] m^2.
    """
    origin = corners[..., 0, :]
    b, c, p = (jnp.moveaxis(x - origin, -1, 0) for x in (corners[..., 1, :], corners[..., 2, :], positions))
    v, w, squared = _closest(b, c, p)
    return jnp.stack([1.0 - v - w, v, w], axis=-1), squared


def _closest(
    b: Sequence[Array] | Array, c: Sequence[Array] | Array, p: Sequence[Array] | Array
) -> tuple[Array, Array, Array]:
    """Find (v, w) of the point v b + w c of the triangle (0, b, c) nearest to p, and |p - v b - w c|^2.

    Vectors are given by their coordinates, so that no array has an axis of three.
    """

    def dot(x, y):
        return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]

    def cross(x, y):
        return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]

    def along(product, squared):
        return jnp.clip(product / jnp.where(squared > 0, squared, 1.0), 0.0, 1.0)

    def apart(v, w):
        # not by products: they cancel near the triangle
        offset = [p[i] - v * b[i] - w * c[i] for i in range(3)]
        return dot(offset, offset)

    bb, bc, cc, bp, cp = dot(b, b), dot(b, c), dot(c, c), dot(b, p), dot(c, p)
    # by the normal: bb cc - bc^2, the same squared, has lost twice the digits on a sliver
    normal = cross(b, c)
    squared = dot(normal, normal)
    flat = squared <= 0
    safe = jnp.where(flat, 1.0, squared)
    v, w = dot(cross(p, c), normal) / safe, dot(cross(b, p), normal) / safe
    inside = ~flat & (v >= 0) & (w >= 0) & (v + w <= 1)
    best = jnp.where(inside, apart(v, w), jnp.inf)  # an edge of a sliver may be nearer: its inside is rounding
    zero = jnp.zeros_like(v)
    third = along(cp - bp + bb - bc, bb - 2.0 * bc + cc)
    for side_v, side_w in ((along(bp, bb), zero), (zero, along(cp, cc)), (1.0 - third, third)):
        squared = apart(side_v, side_w)
        better = squared < best
        v, w, best = jnp.where(better, side_v, v), jnp.where(better, side_w, w), jnp.where(better, squared, best)
    return v, w, best


def nearest_face_around(positions: Array, body: Array, patches: Patches, vertices: Sequence[Array]) -> Array:
    """Find the index [V] of the triangle of a mesh [B, 3] m nearest to each position [V, 3] m, from vertices near it.

    The faces around these vertices (each [V] int32) are tried first, then those around the nearest corner of the best
    face, `STRIDES` times. The search walks along the surface and does not see another limb. No gradient.
    """
    positions, body = jax.lax.stop_gradient((positions, body))
    corners = body[patches.faces]
    # the triangles around a vertex, one coordinate after the other: [B, 9, R]
    table = jnp.transpose(corners[patches.around], (0, 2, 3, 1)).reshape(len(patches.around), 9, -1)

    def nearest(vertex: Array) -> tuple[Array, Array]:
        triangles = table[vertex]
        origin = [triangles[:, i] for i in range(3)]
        b, c = ([triangles[:, first + i] - origin[i] for i in range(3)] for first in (3, 6))
        _, _, squared = _closest(b, c, [positions[:, i, None] - origin[i] for i in range(3)])
        least = jnp.min(squared, axis=1)
        place = jnp.min(jnp.where(squared == least[:, None], jnp.arange(squared.shape[1])[None], LAST), axis=1)
        return patches.around[vertex, jnp.minimum(place, squared.shape[1] - 1)], least

    def nearer(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
        return jax.tree.map(lambda x, y: jnp.where(other[1] < one[1], y, x), one, other)

    first, *others = map(nearest, vertices)
    for other in others:
        first = nearer(first, other)
    for _ in range(STRIDES):
        weights, _ = closest_on_triangle(positions, corners[first[0]])
        first = nearer(first, nearest(patches.faces[first[0], jnp.argmax(weights, axis=1)]))
    return first[0]


def nearest_face(positions: Array, corners: Array, groups: Array, apart: Array | None = None) -> Array:
    """Find the index [V] of the triangle [F, 3, 3] m nearest to each position [V, 3] m. Exact; no gradient.

    Groups are visited in the order of the distance to their boxes, until the next box is farther than the nearest
    triangle so far.

    Args:
        groups: [G, PATCH] of `patches`.
        apart: [F, 3] int32, three positions for which a triangle is never the answer. A mesh that searches itself
            gives the corners of its triangles.
    """
    positions, corners, groups = jax.lax.stop_gradient(jax.tree.map(jnp.asarray, (positions, corners, groups)))
    if _tries_all():
        return _nearest_of_all(positions, corners, apart)
    count, last_group = positions.shape[0], groups.shape[0] - 1
    grouped = corners[groups]
    low, high = jnp.min(grouped, axis=(1, 2)), jnp.max(grouped, axis=(1, 2))
    # one coordinate after the other, so that a patch's triangles lie side by side
    origin = grouped[:, :, 0]
    b, c = grouped[:, :, 1] - origin, grouped[:, :, 2] - origin
    table = jnp.concatenate([jnp.swapaxes(x, 1, 2) for x in (origin, b, c)], axis=1)  # [G, 9, PATCH]

    def beyond(axis):
        place = positions[:, None, axis]
        return jnp.square(jnp.maximum(jnp.maximum(low[None, :, axis] - place, place - high[None, :, axis]), 0.0))

    # The last bits of a squared distance hold its group; the distance becomes a little less. A minimum, which
    # vectorises, then gives both, and the next in order is the least above the last.
    bits = (1 << last_group.bit_length()) - 1
    bound = jax.lax.bitcast_convert_type((beyond(0) + beyond(1) + beyond(2)).astype(jnp.float32), jnp.int32)
    keys = (jnp.maximum(bound - 1, 0) & ~bits) | jnp.arange(groups.shape[0], dtype=jnp.int32)[None]

    def following(keys, last):
        return jnp.min(jnp.where(keys > last[:, None], keys, LAST), axis=1)

    def may_improve(key, best):
        return (key < LAST) & (jax.lax.bitcast_convert_type(key & ~bits, jnp.float32) < best)

    def visit(number, position, keys, best, face, last):
        key = following(keys, last)
        group = jnp.minimum(key & bits, last_group)
        triangles = table[group]
        offset = [position[:, i, None] - triangles[:, i] for i in range(3)]
        b, c = ([triangles[:, first + i] for i in range(3)] for first in (3, 6))
        _, _, squared = _closest(b, c, offset)
        if apart is not None:
            own = jnp.any(jnp.asarray(apart)[groups[group]] == number[:, None, None], axis=-1)
            squared = jnp.where(own, jnp.inf, squared)
        least = jnp.min(squared, axis=1)
        place = jnp.min(jnp.where(squared == least[:, None], jnp.arange(PATCH)[None], PATCH - 1), axis=1)
        better = may_improve(key, best) & (least < best)
        return jnp.where(better, least, best), jnp.where(better, groups[group, place], face), key

    number = jnp.arange(count)
    best, face = jnp.full(count, jnp.inf, positions.dtype), jnp.zeros(count, groups.dtype)
    last = jnp.full(count, -1, jnp.int32)
    for _ in range(min(PASSES, last_group + 1)):
        best, face, last = visit(number, positions, keys, best, face, last)
    left = may_improve(following(keys, last), best)
    rows, chunks = _chunks(left)

    def chunk(index, state):
        best, face = state
        row = jax.lax.dynamic_slice(rows, (index * CHUNK,), (CHUNK,))
        real = row < count
        row_or_last = jnp.minimum(row, count - 1)
        position, key = positions[row_or_last], keys[row_or_last]

        def more(state):
            best, face, last, _ = state
            best, face, last = visit(row_or_last, position, key, best, face, last)
            return best, face, last, real & may_improve(following(key, last), best)

        state = (best[row_or_last], face[row_or_last], last[row_or_last], real)
        row_best, row_face, _, _ = jax.lax.while_loop(lambda state: jnp.any(state[3]), more, state)
        return best.at[row].set(row_best, mode="drop"), face.at[row].set(row_face, mode="drop")

    return jax.lax.fori_loop(0, chunks, chunk, (best, face))[1]


def _nearest_of_all(positions: Array, corners: Array, apart: Array | None) -> Array:
    """Find the nearest triangles like `nearest_face`, by trying all of them, a tile at a time."""
    number, last = jnp.arange(len(positions)), len(corners) - 1
    tiles = jnp.minimum(jnp.arange(-(-len(corners) // TILE) * TILE), last).reshape(-1, TILE).astype(jnp.int32)

    def tile(nearest: tuple[Array, Array], rows: Array) -> tuple[tuple[Array, Array], None]:
        best, face = nearest
        origin = corners[rows, 0]
        b, c = ([(corners[rows, k] - origin)[None, :, i] for i in range(3)] for k in (1, 2))
        _, _, squared = _closest(b, c, [positions[:, i, None] - origin[None, :, i] for i in range(3)])
        if apart is not None:
            own = jnp.any(jnp.asarray(apart)[rows][None] == number[:, None, None], axis=-1)
            squared = jnp.where(own, jnp.inf, squared)
        least, place = jnp.min(squared, axis=1), jnp.argmin(squared, axis=1)
        better = least < best
        return (jnp.where(better, least, best), jnp.where(better, rows[place], face)), None

    first = (jnp.full(len(positions), jnp.inf, positions.dtype), jnp.zeros(len(positions), jnp.int32))
    return jax.lax.scan(tile, first, tiles)[0][1]
