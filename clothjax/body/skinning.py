"""Forward kinematics, linear blend skinning and shape blend shapes of bodies and garments."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from clothjax.types import Array, Body, Garment, Pose

HIGHEST = jax.lax.Precision.HIGHEST  # positions are metres to a tenth of a millimetre: no reduced matmuls


def shaped_joints(body: Body, betas: Float[Array, " S"]) -> Float[Array, "J 3"]:
    """Joints [J, 3] m of the body of shape `betas` [S], in the canonical pose."""
    return body.joints + jnp.einsum("jcs,s->jc", body.joint_shapedirs, betas, precision=HIGHEST)


def shaped_vertices(wearable: Body | Garment, betas: Float[Array, " S"]) -> Float[Array, "N 3"]:
    """Vertices [N, 3] m of a body or garment of shape `betas` [S], in the canonical pose."""
    return wearable.vertices + jnp.einsum("ncs,s->nc", wearable.shapedirs, betas, precision=HIGHEST)


def forward_kinematics(
    rotations: Float[Array, "J 3 3"], joints: Float[Array, "J 3"], parents: Int[Array, " J"]
) -> tuple[Float[Array, "J 3 3"], Float[Array, "J 3"]]:
    """Global rotations [J, 3, 3] and positions [J, 3] m of the joints, the root at its canonical place.

    Args:
        rotations: [J, 3, 3] local to the parent.
        joints: [J, 3] m canonical joint positions.
        parents: [J] static integers, root -1, each before its children.
    """
    # Pointer jumping: every joint's transform goes to its ancestor's frame, twice as far up the tree in each step, so
    # that the number of steps is the logarithm of the tree's depth.
    ancestor = np.asarray(parents)
    rotation = rotations
    position = joints - jnp.where(ancestor[:, None] < 0, 0.0, joints[ancestor])
    while (ancestor >= 0).any():
        reached = (ancestor < 0)[:, None]
        moved = position[ancestor] + jnp.einsum("jab,jb->ja", rotation[ancestor], position, precision=HIGHEST)
        rotated = jnp.matmul(rotation[ancestor], rotation, precision=HIGHEST)
        position = jnp.where(reached, position, moved)
        rotation = jnp.where(reached[:, :, None], rotation, rotated)
        ancestor = np.where(ancestor < 0, -1, ancestor[ancestor])
    return rotation, position


def joint_transforms(
    rotations: Float[Array, "J 3 3"], joints: Float[Array, "J 3"], parents: Int[Array, " J"]
) -> Float[Array, "J 3 4"]:
    """Transforms [R_j | q_j - R_j J_j] as [J, 3, 4]: forward kinematics after the inverse bind matrices (m)."""
    return bound_transforms(*forward_kinematics(rotations, joints, parents), joints)


def bound_transforms(
    rotation: Float[Array, "J 3 3"], position: Float[Array, "J 3"], joints: Float[Array, "J 3"]
) -> Float[Array, "J 3 4"]:
    """Return the transforms [J, 3, 4] of `joint_transforms` where the forward kinematics are known.

    Args:
        rotation: [J, 3, 3] global.
        position: [J, 3] m of the posed joints.
        joints: [J, 3] m of the canonical joints.
    """
    offset = position - jnp.einsum("jab,jb->ja", rotation, joints, precision=HIGHEST)
    return jnp.concatenate([rotation, offset[:, :, None]], axis=-1)


def blend(weights: Float[Array, "N J"], transforms: Float[Array, "J 3 4"]) -> Float[Array, "N 3 4"]:
    """Per-vertex transforms sum_j w_ij T_j [N, 3, 4], from weights w [N, J] and transforms T [J, 3, 4]."""
    flat = jnp.matmul(weights, transforms.reshape(transforms.shape[0], 12), precision=HIGHEST)
    return flat.reshape(weights.shape[0], 3, 4)


def apply(transforms: Float[Array, "N 3 4"], points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Move points [N, 3] m by their own transforms [N, 3, 4]."""
    return jnp.einsum("nab,nb->na", transforms[:, :, :3], points, precision=HIGHEST) + transforms[:, :, 3]


def unapply(transforms: Float[Array, "N 3 4"], points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Invert `apply`: return the canonical points [N, 3] m of posed points [N, 3] m."""
    return unapply_direction(transforms, points - transforms[:, :, 3])


def carry(
    now: Float[Array, "N 3 4"], following: Float[Array, "N 3 4"], points: Float[Array, "N 3"]
) -> Float[Array, "N 3"]:
    """Return points [N, 3] m posed by transforms [N, 3, 4] as those of the following frame pose them."""
    return apply(following, unapply(now, points))


def unapply_direction(transforms: Float[Array, "N 3 4"], vectors: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Carry vectors [N, 3] back by the linear part of the transforms [N, 3, 4] (Cramer's rule).

    Blended matrices can be near singular (a joint folded by pi), so the determinant is bounded away from zero.
    """
    a, b, c = transforms[:, :, 0], transforms[:, :, 1], transforms[:, :, 2]
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=1)
    determinant = jnp.sum(a * rows[:, 0], axis=-1)
    safe = jnp.where(jnp.abs(determinant) < 1e-3, jnp.where(determinant < 0, -1e-3, 1e-3), determinant)
    return jnp.einsum("nab,nb->na", rows, vectors, precision=HIGHEST) / safe[:, None]


def pose_body(
    body: Body, vertices: Float[Array, "B 3"], joints: Float[Array, "J 3"], pose: Pose
) -> Float[Array, "B 3"]:
    """Posed vertices [B, 3] m of a body shaped to `vertices` [B, 3] and `joints` [J, 3], translation included."""
    transforms = joint_transforms(pose.rotations, joints, body.parents)
    moved = apply(blend(body.weights, transforms), pose_corrected(body.posedirs, vertices, pose))
    return moved + pose.translation[None]


def pose_corrected(posedirs: Array | None, vertices: Float[Array, "B 3"], pose: Pose) -> Float[Array, "B 3"]:
    """Canonical vertices [B, 3] m with SMPL's pose blend shapes [B, 3, 9 (J - 1)] added, where there are any."""
    if posedirs is None:
        return vertices
    features = (pose.rotations[1:] - jnp.eye(3, dtype=vertices.dtype)[None]).reshape(-1)
    return vertices + jnp.einsum("ncp,p->nc", posedirs, features, precision=HIGHEST)


def vertex_normals(vertices: Float[Array, "N 3"], faces: Int[Array, "F 3"]) -> Float[Array, "N 3"]:
    """Area-weighted unit normals [N, 3] of vertices [N, 3] m; zero where a vertex has no area around it."""
    corners = vertices[faces]
    face_normals = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = jnp.zeros_like(vertices).at[faces.reshape(-1)].add(jnp.repeat(face_normals, 3, axis=0))
    squared = jnp.sum(summed * summed, axis=-1, keepdims=True)
    return jnp.where(squared > 0, summed * jax.lax.rsqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)
