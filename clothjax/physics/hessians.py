"""The sparse Hessian of the potential of a time step, assembled element by element, and a preconditioner for it."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from clothjax.config import PhysicsConfig
from clothjax.physics import energies, incremental_potential
from clothjax.physics.incremental_potential import LAWS, Laws, TimeStep
from clothjax.types import Array, Mesh

VERTEX_TERMS = ("gravity", "inertia", "friction", "collision")


class Structure(NamedTuple):
    """The sparsity pattern of the potential's Hessian: N blocks of 3 x 3, for pairs of vertices (block sparse rows).

    Each pair of corners of each element (face, hinge, vertex, edge) has a block of its own, P in all. `gather` sums
    those of one pair of vertices.
    """

    indptr: np.ndarray  # [V + 1] int32, where the blocks of each vertex's row begin
    indices: np.ndarray  # [N] int32, column of each block
    gather: scipy.sparse.csr_array  # [N, P], one where block n sums the block of an element's pair of corners


def structure(step: TimeStep, mesh: Mesh) -> Structure:
    """Return the sparsity pattern of the Hessian of a time step."""
    count = len(step.mass)
    rows, columns = [], []
    for corners in _corners(step, mesh):
        pairs = (*corners.shape, corners.shape[1])
        rows.append(np.broadcast_to(corners[:, :, None], pairs).reshape(-1))
        columns.append(np.broadcast_to(corners[:, None, :], pairs).reshape(-1))
    key = np.concatenate(rows).astype(np.int64) * count + np.concatenate(columns)
    blocks, target = np.unique(key, return_inverse=True)
    row, column = blocks // count, blocks % count
    gather = scipy.sparse.csr_array(
        (np.ones(len(key)), (target.reshape(-1), np.arange(len(key)))), shape=(len(blocks), len(key))
    )
    indptr = np.searchsorted(row, np.arange(count + 1))
    return Structure(indptr.astype(np.int32), column.astype(np.int32), gather)


def _corners(step: TimeStep, mesh: Mesh) -> list[np.ndarray]:
    """List the vertices of the elements over which the potential is a sum, kind by kind."""
    vertices = np.arange(len(step.mass))[:, None]
    kinds = [np.asarray(mesh.faces), np.asarray(mesh.hinges), vertices]
    if step.edge_contact is not None:
        kinds.append(np.asarray(mesh.edges))
    if step.self_contact is not None:
        kinds.append(np.concatenate([vertices, step.self_contact.corners], axis=1))
    return kinds


def blocks(
    x: Array, step: TimeStep, mesh: Mesh, pattern: Structure, config: PhysicsConfig, laws: Laws = LAWS
) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the Hessian of the potential, and the diagonal of a positive semidefinite approximation of it.

    The approximation preconditions the solve. It clamps the stress of stretching to tension (principal values >= 0).
    It takes the square of the residual's gradient for bending (Gauss-Newton), and the positive eigenvalues for terms of
    single vertices.

    Args:
        x: [V, 3] m, the positions.
        pattern: of `structure`, for the same step and mesh.

    Returns:
        The blocks [N, 3, 3] N/m of the Hessian, in the order of `pattern`, and those [V, 3, 3] on the diagonal of the
        approximation.
    """
    pairs, diagonal = _element_hessians(x, step, mesh, config, laws)
    return (pattern.gather @ np.asarray(pairs).reshape(-1, 9)).reshape(-1, 3, 3), np.asarray(diagonal)


@partial(jax.jit, static_argnames=("config", "laws"))
def _element_hessians(x: Array, step: TimeStep, mesh: Mesh, config: PhysicsConfig, laws: Laws) -> tuple[Array, Array]:
    """Blocks [P, 3, 3] N/m of all pairs of corners, in the order of `_corners`, and the diagonal of `blocks`."""
    rest, material = step.rest, step.material

    def face_energy(points, inverse, area):
        return laws.stretching(points[None], inverse[None], area[None], material.mu, material.lam)[0]

    def vertex_energy(new):
        elements = incremental_potential.elements(new, step, mesh, config, laws)
        return sum((jnp.sum(elements[name]) for name in VERTEX_TERMS if name in elements), jnp.zeros((), x.dtype))

    # every vertex term depends on one vertex only, so three directions give all 3 x 3 blocks
    axes = jnp.broadcast_to(jnp.eye(3, dtype=x.dtype)[:, None, :], (3, *x.shape))
    columns = jax.vmap(lambda axis: jax.jvp(jax.grad(vertex_energy), (x,), (axis,))[1])(axes)
    vertex = jnp.moveaxis(columns, 0, -1)
    values, vectors = jnp.linalg.eigh(vertex)
    positive = jnp.einsum("vab,vb,vcb->vac", vectors, jnp.maximum(values, 0.0), vectors)

    bending, bending_diagonal = _bending(x[mesh.hinges], step)
    exact = [
        jax.vmap(jax.hessian(face_energy))(x[mesh.faces], rest.inverse, rest.face_area),
        bending,
        vertex[:, None, :, None],
    ]
    diagonal = positive.at[mesh.faces].add(_stretching_diagonal(x[mesh.faces], step))
    diagonal = diagonal.at[mesh.hinges].add(bending_diagonal)
    # the last two are convex
    if step.edge_contact is not None:
        energy = partial(incremental_potential.edge_collision, config=config, laws=laws)
        exact.append(jax.vmap(jax.hessian(energy))(x[mesh.edges], step.edge_contact))
        diagonal = diagonal.at[mesh.edges].add(_own(exact[-1]))
    if step.self_contact is not None:
        energy = partial(incremental_potential.self_collision, config=config, laws=laws)
        own = jnp.arange(len(x), dtype=step.self_contact.corners.dtype)[:, None]
        corners = jnp.concatenate([own, step.self_contact.corners], axis=1)
        exact.append(jax.vmap(jax.hessian(energy))(x[corners], step.self_contact))
        diagonal = diagonal.at[corners].add(_own(exact[-1]))
    return jnp.concatenate([jnp.swapaxes(each, 2, 3).reshape(-1, 3, 3) for each in exact]), diagonal


def _own(blocks: Array) -> Array:
    """Return the blocks [n, k, 3, 3] on the diagonal of [n, k, 3, k, 3]."""
    return jnp.moveaxis(jnp.diagonal(blocks, axis1=1, axis2=3), -1, 1)


def _stretching_diagonal(corners: Array, step: TimeStep) -> Array:
    """Diagonal [F, 3, 3, 3] N/m of the Hessian of stretching with the second Piola-Kirchhoff stress clamped."""
    inverse, mu, lam = step.rest.inverse, step.material.mu, step.material.lam
    eye = jnp.eye(2, dtype=corners.dtype)
    # F = sum_i x_i b_i^T
    b = jnp.concatenate([inverse, -jnp.sum(inverse, axis=1, keepdims=True)], axis=1)
    deformation = jnp.einsum("fia,fip->fap", corners, b)
    strain = energies.green_strain(corners, inverse)
    trace = strain[:, 0, 0] + strain[:, 1, 1]
    stress = 2.0 * mu * strain + lam * trace[:, None, None] * eye[None]

    mean = 0.5 * (stress[:, 0, 0] + stress[:, 1, 1])
    spread = 0.5 * (stress[:, 0, 0] - stress[:, 1, 1])
    radius = jnp.sqrt(spread * spread + stress[:, 0, 1] * stress[:, 0, 1]) + 1e-12 * mu
    high, low = jnp.maximum(mean + radius, 0.0), jnp.maximum(mean - radius, 0.0)
    # the isotropic function that clamps both principal values, as slope * stress + shift * I
    slope = (high - low) / (2.0 * radius)
    shift = high - slope * (mean + radius)
    clamped = slope[:, None, None] * stress + shift[:, None, None] * eye[None]

    half = 0.5 * jnp.einsum("fip,faq->fpqia", b, deformation)
    change = half + jnp.swapaxes(half, 1, 2)  # of the strain, with every coordinate
    trace_change = change[:, 0, 0] + change[:, 1, 1]
    blocks = 2.0 * mu * jnp.einsum("fpqia,fpqib->fiab", change, change)
    blocks = blocks + lam * trace_change[:, :, :, None] * trace_change[:, :, None, :]
    geometric = jnp.einsum("fip,fpq,fiq->fi", b, clamped, b)
    blocks = blocks + jnp.einsum("fi,ab->fiab", geometric, jnp.eye(3, dtype=corners.dtype))
    return (step.rest.face_area * energies.THICKNESS)[:, None, None, None] * blocks


def _bending(corners: Array, step: TimeStep) -> tuple[Array, Array]:
    """Hessian [H, 4, 3, 4, 3] N/m of `energies.bending`, and the diagonal [H, 4, 3, 3] of its Gauss-Newton form.

    The energy is k / (8 A) r^2 with the residual r = l (theta - theta_0), l the length of the edge.
    """

    def one(corners: Array, angle: Array, stiffness: Array) -> tuple[Array, Array]:
        edge, eye = corners[1] - corners[0], jnp.eye(3, dtype=corners.dtype)
        length = jnp.sqrt(jnp.sum(edge * edge))
        slopes, second = _dihedral_angle(*(corners[i] - corners[0] for i in (1, 2, 3)))
        turned = 2.0 * angle * edge[None, :, None] * slopes[:, None, :]
        blocks = length * length * (slopes[:, None, :, None] * slopes[None, :, None, :] + angle * second)
        blocks = blocks.at[0].add(turned).at[:, 0].add(jnp.swapaxes(turned, 1, 2)).at[0, 0].add(angle * angle * eye)
        # the first corner moves all three vectors backwards
        blocks = jnp.concatenate([-jnp.sum(blocks, axis=0, keepdims=True), blocks], axis=0)
        blocks = jnp.concatenate([-jnp.sum(blocks, axis=1, keepdims=True), blocks], axis=1)
        residual = (length * slopes).at[0].add(angle * edge / jnp.where(length > 0, length, 1.0))
        residual = jnp.concatenate([-jnp.sum(residual, axis=0, keepdims=True), residual])
        diagonal = residual[:, :, None] * residual[:, None, :]
        return stiffness * jnp.swapaxes(blocks, 1, 2), stiffness * diagonal

    angle = energies.dihedral_angle(corners) - step.rest.hinge_angle
    return jax.vmap(one)(corners, angle, step.material.bending / (4.0 * step.rest.hinge_area))


def _dihedral_angle(edge: Array, left: Array, right: Array) -> tuple[Array, Array]:
    """First and second derivatives of `energies.dihedral_angle`, [3, 3] 1/m and [3, 3, 3, 3] 1/m^2, of a hinge.

    They are by the vectors [3] m from the first corner to the others. In closed form they take a fifth of the time
    (Tamstorf and Grinspun 2013, Discrete bending forces and their Jacobians).
    """
    length = jnp.sqrt(jnp.sum(edge * edge))
    length = jnp.where(length > 0, length, 1.0)
    along = edge / length
    normals = jnp.cross(edge, left), jnp.cross(right, edge)
    areas = [jnp.sum(normal * normal) for normal in normals]
    size = jnp.max(jnp.abs(jnp.stack([edge, left, right])))
    flat = jnp.minimum(*areas) <= (energies.SLIVER * size * size) ** 2  # as in the energy: a face of hardly any area

    def outer(one: Array, other: Array) -> Array:
        return one[:, None] * other[None]

    def times_cross(matrix: Array, vector: Array) -> Array:  # M [v]x, so that M [v]x w = M (v x w)
        return jnp.cross(matrix, vector[None])

    by_edge, of_edge, slopes, own, mixed = 0.0, 0.0, [], [], []
    for normal, area, other, sign in zip(normals, areas, (left, right), (-1.0, 1.0), strict=True):
        scale = jnp.where(flat, 0.0, 1.0 / jnp.where(flat, 1.0, area))
        # the normal over its square, and how that changes with the normal
        over = scale * normal
        change = scale * jnp.eye(3, dtype=edge.dtype) - 2.0 * outer(over, over)
        turning = sign * times_cross(change, other)
        share = jnp.sum(other * along)
        by_edge += share * over
        of_edge += outer(over, other - share * along) / length + share * turning
        slopes.append(-length * over)
        own.append(sign * length * times_cross(change, edge))
        mixed.append(-outer(over, along) - length * turning)
    zero = jnp.zeros_like(own[0])
    blocks = [[of_edge, mixed[0].T, mixed[1].T], [mixed[0], own[0], zero], [mixed[1], zero, own[1]]]
    return jnp.stack([by_edge, *slopes]), jnp.stack([jnp.stack(row) for row in blocks])
