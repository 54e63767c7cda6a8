"""Which part of the body each garment vertex may touch during a time step."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.types import Array, Contact

BLOCK = 64  # points
PATCH = 16  # triangles
PASSES = 2  # of all positions, before only those without an answer are gone through
SHARE = 16  # of the positions, gone through at a time after that
ON_SURFACE = 1e-5  # m, closer than this the direction to the surface is rounding


class Patches(NamedTuple):
    """The triangles of a body, and small groups of neighbours among them."""

    faces: Array  # [F, 3] int32
    across: Array  # [F, 3] int32, the face across the edge opposite a corner; itself where there is none
    groups: Array  # [G, PATCH] int32, every face; the last of a group is repeated


def patches(vertices: np.ndarray, faces: np.ndarray) -> Patches:
    """Patches of a body [B, 3] m: halved along the longest side of their box until they are small enough."""
    faces = np.asarray(faces)
    # half-edges (a, b) and (b, a) meet
    start, end = faces[:, [1, 2, 0]].reshape(-1), faces[:, [2, 0, 1]].reshape(-1)
    other = {pair: index // 3 for index, pair in enumerate(zip(start.tolist(), end.tolist()))}
    across = [other.get(pair, index // 3) for index, pair in enumerate(zip(end.tolist(), start.tolist()))]
    centroids = np.asarray(vertices)[faces].mean(axis=1)

    def halve(members: np.ndarray) -> list[np.ndarray]:
        if len(members) <= PATCH:
            return [np.pad(members, (0, PATCH - len(members)), mode="edge")]
        axis = np.ptp(centroids[members], axis=0).argmax()
        ordered = members[np.argsort(centroids[members, axis], kind="stable")]
        half = PATCH * -(-len(members) // (2 * PATCH))
        return halve(ordered[:half]) + halve(ordered[half:])

    groups = np.stack(halve(np.arange(len(faces))))
    return Patches(faces.astype(np.int32), np.reshape(across, (-1, 3)).astype(np.int32), groups.astype(np.int32))


def centroids(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Centroids [F, 3] m and unit normals [F, 3] of the faces of a body [B, 3] m."""
    corners = vertices[faces]
    return jnp.mean(corners, axis=1), _unit(jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def nearest(positions: Array, points: Array) -> Array:
    """Index [V] of the point [P, 3] m nearest to each position [V, 3] m; the first of equals.

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
    """Barycentric coordinates [..., 3] of the point of a triangle [..., 3, 3] m nearest to [..., 3] m, and |.|^2 m^2.

    Triangles without area are the segments they have shrunk to.
    """
    origin, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    b, c, p = b - origin, c - origin, positions - origin
    bb, bc, cc, bp, cp = (jnp.sum(x * y, axis=-1) for x, y in ((b, b), (b, c), (c, c), (b, p), (c, p)))
    determinant = bb * cc - bc * bc
    flat = determinant <= 0
    safe = jnp.where(flat, 1.0, determinant)
    v, w = (cc * bp - bc * cp) / safe, (bb * cp - bc * bp) / safe
    inside = ~flat & (v >= 0) & (w >= 0) & (v + w <= 1)

    def along(product, squared):
        return jnp.clip(product / jnp.where(squared > 0, squared, 1.0), 0.0, 1.0)

    def away(v, w):
        # |v b + w c - p|^2 - |p|^2
        return v * (v * bb + 2.0 * w * bc - 2.0 * bp) + w * (w * cc - 2.0 * cp)

    zero = jnp.zeros_like(v)
    third = along(cp - bp + bb - bc, bb - 2.0 * bc + cc)
    sides = ((along(bp, bb), zero), (zero, along(cp, cc)), (1.0 - third, third))
    best = jnp.where(inside, -jnp.inf, jnp.inf)
    for side_v, side_w in sides:
        distance = away(side_v, side_w)
        better = distance < best
        v, w, best = jnp.where(better, side_v, v), jnp.where(better, side_w, w), jnp.where(better, distance, best)
    return jnp.stack([1.0 - v - w, v, w], axis=-1), jnp.sum(p * p, axis=-1) + away(v, w)


def nearest_face(positions: Array, corners: Array, groups: Array) -> Array:
    """Index [V] of the triangle [F, 3, 3] m nearest to each position [V, 3] m.

    Exact: groups are gone through in the order of the distance of their boxes, until the next box is farther than
    the nearest triangle found. No gradient.
    """
    positions, corners, groups = jax.lax.stop_gradient(jax.tree.map(jnp.asarray, (positions, corners, groups)))
    grouped = corners[groups]
    low, high = jnp.min(grouped, axis=(1, 2)), jnp.max(grouped, axis=(1, 2))

    def beyond(axis):
        place = positions[:, None, axis]
        return jnp.square(jnp.maximum(jnp.maximum(low[None, :, axis] - place, place - high[None, :, axis]), 0.0))

    bound = beyond(0) + beyond(1) + beyond(2)  # [V, G] m^2
    number = jnp.arange(groups.shape[0])[None]
    count = positions.shape[0]

    def visit(rows, bound, best, face):
        ahead = bound[rows]
        # two minima vectorise, an argmin does not
        first = ahead == jnp.min(ahead, axis=1, keepdims=True)
        group = jnp.min(jnp.where(first, number, groups.shape[0]), axis=1)
        _, squared = closest_on_triangle(positions[rows][:, None], grouped[group])
        place = jnp.argmin(squared, axis=1)
        found = jnp.take_along_axis(squared, place[:, None], axis=1)[:, 0]
        face = face.at[rows].set(jnp.where(found < best[rows], groups[group, place], face[rows]))
        return bound.at[rows, group].set(jnp.inf), best.at[rows].min(found), face

    def unfinished(rows, bound, best):
        return jnp.min(bound[rows], axis=1) < best[rows]

    def some(state):
        bound, best, face, left = state
        (rows,) = jnp.nonzero(left, size=max(1, count // SHARE), fill_value=count - 1)
        bound, best, face = visit(rows, bound, best, face)
        return bound, best, face, left.at[rows].set(unfinished(rows, bound, best))

    rows = jnp.arange(count)
    best, face = jnp.full(count, jnp.inf, positions.dtype), jnp.zeros(count, groups.dtype)
    for _ in range(min(PASSES, groups.shape[0])):
        bound, best, face = visit(rows, bound, best, face)
    state = (bound, best, face, unfinished(rows, bound, best))
    return jax.lax.while_loop(lambda state: jnp.any(state[3]), some, state)[2]


def find_on_triangles(positions: Array, body: Array, body_next: Array, patches: Patches) -> Contact:
    """The contact planes of garment positions [V, 3] m: through the nearest point of the body, across the way there.

    The plane's distance is the signed distance to the body, with the sign from pseudonormals (Baerentzen & Aanaes
    2005). Plane and point go with their triangle to the next frame.

    Args:
        body, body_next: [B, 3] m at this frame and the next.
    """
    positions, body, body_next, patches = jax.tree.map(jnp.asarray, (positions, body, body_next, patches))
    faces = patches.faces
    corners = body[faces]
    face = nearest_face(positions, corners, patches.groups)
    here, there = corners[face], body_next[faces[face]]
    weights, _ = jax.lax.stop_gradient(closest_on_triangle(positions, here))
    point, point_next = (jnp.einsum("vk,vkc->vc", weights, x, precision="highest") for x in (here, there))

    offset = positions - point
    apart = jnp.sum(offset * offset, axis=-1, keepdims=True)
    pseudonormal = jax.lax.stop_gradient(_pseudonormal(body, corners, patches, face, weights))
    side = jnp.where(jnp.sum(offset * pseudonormal, axis=-1, keepdims=True) < 0, -1.0, 1.0)
    on_surface = apart < ON_SURFACE**2
    normal = jnp.where(on_surface, pseudonormal, side * offset / jnp.sqrt(jnp.where(on_surface, 1.0, apart)))
    local = jnp.einsum("vca,vc->va", _axes(here), normal, precision="highest")
    turned = jnp.einsum("vca,va->vc", _axes(there), local, precision="highest")
    lost = jnp.sum(turned * turned, axis=-1, keepdims=True) < 0.5  # a triangle without area has no axes
    turned = jnp.where(lost, normal, turned)
    return Contact(point, point_next, normal, turned, faces[face, jnp.argmax(weights, axis=1)])


def _pseudonormal(body: Array, corners: Array, patches: Patches, face: Array, weights: Array) -> Array:
    """Unit normals [V, 3] of the face, edge or vertex that barycentric coordinates [V, 3] are on."""
    normals = _unit(jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    faces = patches.faces
    weighted = _angles(corners)[:, :, None] * normals[:, None]
    around = jnp.zeros_like(body).at[faces.reshape(-1)].add(weighted.reshape(-1, 3))
    zero = weights <= 1e-6
    count = jnp.sum(zero, axis=1)[:, None]
    edge = normals[face] + normals[patches.across[face, jnp.argmax(zero, axis=1)]]
    vertex = around[faces[face, jnp.argmax(weights, axis=1)]]
    return _unit(jnp.where(count == 0, normals[face], jnp.where(count == 1, edge, vertex)))


def _angles(corners: Array) -> Array:
    """Interior angles [F, 3] rad."""
    sides = [_unit(corners[:, (k + 1) % 3] - corners[:, k]) for k in range(3)]
    cosines = [-jnp.sum(sides[k] * sides[k - 1], axis=-1) for k in range(3)]
    return jnp.arccos(jnp.clip(jnp.stack(cosines, axis=1), -1.0, 1.0))


def _axes(corners: Array) -> Array:
    """Orthonormal axes [V, 3, 3], as columns, that go with triangles [V, 3, 3] m."""
    along = _unit(corners[:, 1] - corners[:, 0])
    normal = _unit(jnp.cross(along, corners[:, 2] - corners[:, 0]))
    return jnp.stack([along, jnp.cross(normal, along), normal], axis=-1)


def _unit(vectors: Array) -> Array:
    squared = jnp.sum(vectors * vectors, axis=-1, keepdims=True)
    return jnp.where(squared > 0, vectors / jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)


def find(positions: Array, current: tuple[Array, Array], following: tuple[Array, Array]) -> Contact:
    """The contact planes of garment positions [V, 3] m at the current frame, kept for the whole step as in HOOD.

    Args:
        current, following: points [P, 3] m and unit normals [P, 3] of the body at this frame and the next.
    """
    index = nearest(positions, current[0])
    return Contact(
        point=current[0][index],
        point_next=following[0][index],
        normal=current[1][index],
        normal_next=following[1][index],
        index=index,
    )


def distance(positions: Array, points: Array, normals: Array) -> Array:
    """Signed distance [V] m of positions [V, 3] m to their planes, positive outside."""
    return jnp.sum((positions - points) * normals, axis=-1)
