"""Contact planes that the vertices and edges of a garment may touch, found once per time step."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from clothjax.geometry.clusters import NO_EDGES, Clusters, divided, middles
from clothjax.geometry.proximity import (
    Patches,
    closest_on_triangle,
    nearest_face,
    nearest_face_around,
    nearest_point,
    winding_number,
)
from clothjax.geometry.vectors import unit
from clothjax.physics import kernels
from clothjax.types import Array, Body, Contact, EdgeContact, Garment, Mesh, SelfContact

ON_SURFACE = 1e-5  # m, closer than this the direction to the surface is rounding
DEEP = 0.7  # of a triangle's size, the root of its area: deeper than this the winding number must agree
WOUND = 0.25  # least winding number inside; it is 0 outside, 1 inside, and half of that behind an open sheet
LEVEL = 1e-4  # m, planes that differ by less count as one


def find(
    positions: Float[Array, "V 3"],
    body: Float[Array, "B 3"],
    body_next: Float[Array, "B 3"],
    patches: Patches,
    ahead: Float[Array, "V 3"] | None = None,
) -> Contact:
    """Find one contact plane for each position [V, 3] m: through the nearest point of the body, normal to the offset.

    The distance to a plane is the signed distance to the body, with the sign from pseudonormals (Baerentzen & Aanaes
    2005). In bent hips and knees, skinning turns skin inside out and pushes it through to the other side. Pseudonormals
    then call a position inside that is centimetres in front of the body. A position deep inside, by the size of its
    triangle, therefore counts as inside only if the body winds around it. Past an open border of the body, the surface
    is taken to continue by the same depth.

    Plane and point move with their triangle to the next frame. A passing foot would take its planes along, through
    cloth that it does not touch. A plane stays behind if it would leave the expected position deep inside where the
    body does not wind around it.

    Args:
        body: [B, 3] m at this frame.
        body_next: [B, 3] m at the next frame.
        patches: the faces of the body, of `proximity.patches`.
        ahead: [V, 3] m, expected positions at the next frame; None lets every plane move along.
    """
    positions, body, body_next, patches = jax.tree.map(jnp.asarray, (positions, body, body_next, patches))
    if kernels.used(positions):
        face = kernels.nearest_face(positions, body, patches)
    else:
        face = nearest_face(positions, body[patches.faces], patches.groups)
    return _planes(positions, face, body, body_next, patches, ahead)


def _planes(
    positions: Float[Array, "V 3"],
    face: Int[Array, " V"],
    body: Float[Array, "B 3"],
    body_next: Float[Array, "B 3"],
    patches: Patches,
    ahead: Float[Array, "V 3"] | None,
) -> Contact:
    """Find contact planes as in `find`, from the nearest triangles [V]."""
    faces, corners = patches.faces, body[patches.faces]
    here, there = corners[face], body_next[faces[face]]
    weights, _ = jax.lax.stop_gradient(closest_on_triangle(positions, here))
    point, point_next = (jnp.einsum("vk,vkc->vc", weights, x, precision="highest") for x in (here, there))

    offset = positions - point
    apart = jnp.sum(offset * offset, axis=-1, keepdims=True)
    pseudonormal, border = jax.lax.stop_gradient(_pseudonormal(body, corners, patches, face, weights))
    inside = jnp.sum(offset * pseudonormal, axis=-1, keepdims=True) < 0
    deep = apart > DEEP**2 * jax.lax.stop_gradient(_areas(here))[:, None]
    doubtful = inside & deep
    inside &= ~doubtful | (winding_number(positions, corners, patches.groups, doubtful[:, 0])[:, None] > WOUND)
    side = jnp.where(inside, -1.0, 1.0)
    on_surface = (apart < ON_SURFACE**2) | (border[:, None] & ~deep)
    normal = jnp.where(on_surface, pseudonormal, side * offset / jnp.sqrt(jnp.where(on_surface, 1.0, apart)))
    local = jnp.einsum("vca,vc->va", _axes(here), normal, precision="highest")
    normal_next = jnp.einsum("vca,va->vc", _axes(there), local, precision="highest")
    no_axes = jnp.sum(normal_next * normal_next, axis=-1, keepdims=True) < 0.99  # of a triangle without area
    normal_next = jnp.where(no_axes, normal, normal_next)
    if ahead is not None:
        gap = jax.lax.stop_gradient(distance(ahead, point_next, normal_next))
        doubtful = gap < -DEEP * jnp.sqrt(jax.lax.stop_gradient(_areas(there)))
        passed = doubtful & (winding_number(ahead, body_next[faces], patches.groups, doubtful) <= WOUND)
        back = gap - jnp.maximum(jax.lax.stop_gradient(distance(positions, point, normal)), 0.0)
        point_next += jnp.where(passed, back, 0.0)[:, None] * normal_next
    return Contact(point, point_next, normal, normal_next, faces[face, jnp.argmax(weights, axis=1)])


def find_at_edges(
    positions: Float[Array, "V 3"],
    planes: Contact,
    mesh: Mesh,
    body: Float[Array, "B 3"],
    body_next: Float[Array, "B 3"],
    patches: Patches,
    ahead: Float[Array, "V 3"] | None = None,
) -> EdgeContact:
    """Find the contact of each edge at the place between its ends that comes nearest to the body.

    At that place the planes of both ends are equally far. Over an edge of the body with one end on either side, it is
    the point of the garment's edge above it; over a flat part, the middle. The search for the nearest triangle starts
    from those nearest to the ends.

    Args:
        positions: [V, 3] m of the vertices.
        planes: contact of the vertices, from `find`.
        body: [B, 3] m at this frame.
        body_next: [B, 3] m at the next frame.
        ahead: [V, 3] m, as in `find`.
    """
    positions, body, body_next, patches = jax.tree.map(jnp.asarray, (positions, body, body_next, patches))
    a, b = mesh.edges[:, 0], mesh.edges[:, 1]
    start, end = positions[a], positions[b]

    def beyond(position, own, other):
        # how much farther an end is from its own plane than from that of the other end
        to_own, to_other = (distance(position, planes.point[i], planes.normal[i]) for i in (own, other))
        return jnp.maximum(to_own - to_other, 0.0) + LEVEL

    before, after = beyond(start, a, b), beyond(end, b, a)
    place = jax.lax.stop_gradient(before / (before + after))

    def between(x):
        return x[a] + place[:, None] * (x[b] - x[a])

    search = kernels.nearest_face_around if kernels.used(positions) else nearest_face_around
    face = search(between(positions), body, patches, [planes.index[end] for end in (a, b)])
    later = None if ahead is None else between(ahead)
    contact = _planes(between(positions), face, body, body_next, patches, later)
    return EdgeContact(place, contact.point_next, contact.normal_next)


def find_on_self(positions: Float[Array, "V 3"], patches: Patches) -> SelfContact:
    """Find the garment's point nearest to each of its vertices [V, 3] m, on triangles that do not have the vertex."""
    positions, patches = jax.tree.map(jnp.asarray, (positions, patches))
    corners = positions[patches.faces]
    face = nearest_face(positions, corners, patches.groups, patches.faces)
    here = corners[face]
    weights, _ = jax.lax.stop_gradient(closest_on_triangle(positions, here))
    offset = positions - jnp.einsum("vk,vkc->vc", weights, here, precision="highest")
    apart = jnp.sum(offset * offset, axis=-1, keepdims=True)
    on_surface = apart < ON_SURFACE**2
    across = unit(jnp.cross(here[:, 1] - here[:, 0], here[:, 2] - here[:, 0]))
    normal = jnp.where(on_surface, across, offset / jnp.sqrt(jnp.where(on_surface, 1.0, apart)))
    return SelfContact(patches.faces[face], weights, jax.lax.stop_gradient(normal))


def find_at_centroids(
    positions: Float[Array, "V 3"], body: Float[Array, "B 3"], body_next: Float[Array, "B 3"], faces: Int[Array, "F 3"]
) -> Contact:
    """Find the planes of the body's faces [F, 3] whose centroids are nearest to positions [V, 3] m, as in HOOD.

    Args:
        body: [B, 3] m at this frame.
        body_next: [B, 3] m at the next frame.
    """
    (point, normal), (point_next, normal_next) = centroids(body, faces), centroids(body_next, faces)
    face = nearest_point(positions, point)
    return Contact(point[face], point_next[face], normal[face], normal_next[face], nearest_point(positions, body))


def clusters(garment: Garment, body: Body, edges: Int[Array, "E 2"] = NO_EDGES) -> Clusters:
    """Divide a garment's vertices, with edges, and the centroids of a body's faces into clusters, on the host."""
    return divided(garment.vertices, np.asarray(body.vertices)[np.asarray(body.faces)].mean(axis=1), edges)


def centroids(
    vertices: Float[Array, "B 3"], faces: Int[Array, "F 3"]
) -> tuple[Float[Array, "F 3"], Float[Array, "F 3"]]:
    """Centroids [F, 3] m and unit normals [F, 3] of the faces of a body [B, 3] m."""
    corners = vertices[faces]
    return jnp.mean(corners, axis=1), unit(jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def distance(
    positions: Float[Array, "*n 3"], points: Float[Array, "*n 3"], normals: Float[Array, "*n 3"]
) -> Float[Array, "*n"]:
    """Signed distance [V] m of positions [V, 3] m to their planes, positive outside."""
    return jnp.sum((positions - points) * normals, axis=-1)


def pushed_out(
    positions: Float[Array, "V 3"],
    points: Float[Array, "V 3"],
    normals: Float[Array, "V 3"],
    apart: Float[Array, " V"],
    farthest: float,
) -> Float[Array, "V 3"]:
    """Return positions [V, 3] m, those less than `apart` [V] m outside their planes moved along the normals to there.

    None is moved by more than `farthest` m.
    """
    return positions + _depth(positions, points, normals, apart, farthest)[:, None] * normals


def edges_pushed_out(
    positions: Float[Array, "V 3"],
    edges: Int[Array, "E 2"],
    points: Float[Array, "E 3"],
    normals: Float[Array, "E 3"],
    apart: Float[Array, " E"],
    farthest: float,
) -> Float[Array, "V 3"]:
    """Return positions [V, 3] m, the ends of edges moved as `pushed_out` moves their middles.

    A vertex is moved by the mean over those of its edges that are moved.
    """
    depth = _depth(middles(positions, edges), points, normals, apart, farthest)[:, None]
    rows = jnp.concatenate([depth * normals, jnp.where(depth > 0, 1.0, 0.0)], axis=1)
    total = jnp.zeros_like(positions, shape=(len(positions), 4)).at[edges.T].add(rows)
    return positions + total[:, :3] / jnp.maximum(total[:, 3:], 1.0)


def _depth(positions: Array, points: Array, normals: Array, apart: Array, farthest: float) -> Array:
    """Return how far [V] m positions are to be pushed out of planes; arguments as of `pushed_out`."""
    return jnp.clip(apart - distance(positions, points, normals), 0.0, farthest)


def _pseudonormal(body: Array, corners: Array, patches: Patches, face: Array, weights: Array) -> tuple[Array, Array]:
    """Unit normals [V, 3] of the face, edge or vertex at barycentric coordinates [V, 3], and whether it is a border."""
    normals = unit(jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    faces = patches.faces
    weighted = _angles(corners)[:, :, None] * normals[:, None]
    around = jnp.zeros_like(body).at[faces.reshape(-1)].add(weighted.reshape(-1, 3))
    zero = weights <= 1e-6
    count = jnp.sum(zero, axis=1)[:, None]
    across = patches.across[face, jnp.argmax(zero, axis=1)]
    corner = faces[face, jnp.argmax(weights, axis=1)]
    border = jnp.where(count[:, 0] == 1, across == face, (count[:, 0] > 1) & patches.border[corner])
    edge = normals[face] + normals[across]
    return unit(jnp.where(count == 0, normals[face], jnp.where(count == 1, edge, around[corner]))), border


def _areas(corners: Array) -> Array:
    """Areas [V] m^2 of triangles [V, 3, 3] m."""
    across = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * jnp.sqrt(jnp.sum(across * across, axis=-1))


def _angles(corners: Array) -> Array:
    """Interior angles [F, 3] rad."""
    sides = [unit(corners[:, (k + 1) % 3] - corners[:, k]) for k in range(3)]
    cosines = [-jnp.sum(sides[k] * sides[k - 1], axis=-1) for k in range(3)]
    return jnp.arccos(jnp.clip(jnp.stack(cosines, axis=1), -1.0, 1.0))


def _axes(corners: Array) -> Array:
    """Orthonormal axes [V, 3, 3], as columns, that move with triangles [V, 3, 3] m."""
    along = unit(corners[:, 1] - corners[:, 0])
    normal = unit(jnp.cross(along, corners[:, 2] - corners[:, 0]))
    return jnp.stack([along, jnp.cross(normal, along), normal], axis=-1)
