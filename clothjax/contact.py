"""Which part of the body each garment vertex may touch during a time step."""

import jax.numpy as jnp

from clothjax.skinning import vertex_normals
from clothjax.types import Array, Contact

BLOCK = 64


def surface(vertices: Array, faces: Array, kind: str) -> tuple[Array, Array]:
    """Points [P, 3] m and unit normals [P, 3] of a body [B, 3] m: its `vertices`, or its face centroids (`faces`)."""
    if kind == "vertices":
        return vertices, vertex_normals(vertices, faces)
    corners = vertices[faces]
    normal = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    squared = jnp.sum(normal * normal, axis=-1, keepdims=True)
    unit = normal / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    return jnp.mean(corners, axis=1), unit


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


def find(positions: Array, current: tuple[Array, Array], following: tuple[Array, Array]) -> Contact:
    """The contact planes of garment positions [V, 3] m at the current frame, kept for the whole step as in HOOD.

    Args:
        current, following: `surface` of the body at this frame and the next.
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
