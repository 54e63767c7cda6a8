"""The sparse Hessian of the potential of a time step, assembled element by element: exact, and semidefinite."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from clothjax.config import PhysicsConfig
from clothjax.geometry.vectors import norm
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
    diagonal: np.ndarray  # [V] int32, the blocks on the diagonal
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
    return Structure(indptr.astype(np.int32), column.astype(np.int32), np.flatnonzero(row == column), gather)


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
    """Evaluate the Hessian of the potential: the exact one, and a positive semidefinite approximation of it.

    The approximation preconditions the solve with the exact one. It clamps the stress of stretching to tension
    (principal values >= 0). It takes the square of the residual's gradient for bending (Gauss-Newton), and the positive
    eigenvalues for terms of single vertices.

    Args:
        x: [V, 3] m, the positions.
        pattern: of `structure`, for the same step and mesh.

    Returns:
        The blocks [N, 3, 3] N/m of both, in the order of `pattern`.
    """
    exact, semidefinite = (
        (pattern.gather @ np.asarray(pairs).reshape(-1, 9)).reshape(-1, 3, 3)
        for pairs in _element_hessians(x, step, mesh, config, laws)
    )
    return exact, semidefinite


@partial(jax.jit, static_argnames=("config", "laws"))
def _element_hessians(x: Array, step: TimeStep, mesh: Mesh, config: PhysicsConfig, laws: Laws) -> tuple[Array, Array]:
    """Blocks [P, 3, 3] N/m of all pairs of corners of all elements, in the order of `_corners`: exact, semidefinite."""
    rest, material = step.rest, step.material
    corners, hinges = x[mesh.faces], x[mesh.hinges]

    def face_energy(points, inverse, area):
        return laws.stretching(points[None], inverse[None], area[None], material.mu, material.lam)[0]

    def hinge_energy(points, area, angle):
        return energies.bending(points[None], area[None], angle[None], material.bending)[0]

    def vertex_energy(new):
        elements = incremental_potential.elements(new, step, mesh, config, laws)
        return sum((jnp.sum(elements[name]) for name in VERTEX_TERMS if name in elements), jnp.zeros((), x.dtype))

    vertex_gradient = jax.grad(vertex_energy)

    # every vertex term depends on one vertex only, so three directions give all 3 x 3 blocks
    axes = jnp.broadcast_to(jnp.eye(3, dtype=x.dtype)[:, None, :], (3, *x.shape))
    columns = jax.vmap(lambda axis: jax.jvp(vertex_gradient, (x,), (axis,))[1])(axes)
    vertex = jnp.moveaxis(columns, 0, -1)
    values, vectors = jnp.linalg.eigh(vertex)
    positive = jnp.einsum("vab,vb,vcb->vac", vectors, jnp.maximum(values, 0.0), vectors)

    exact = [
        jax.vmap(jax.hessian(face_energy))(corners, rest.inverse, rest.face_area),
        jax.vmap(jax.hessian(hinge_energy))(hinges, rest.hinge_area, rest.hinge_angle),
        vertex[:, None, :, None],
    ]
    semidefinite = [
        _stretching_semidefinite(corners, step),
        _bending_semidefinite(hinges, step),
        positive[:, None, :, None],
    ]
    # the last two are convex
    convex = []
    if step.edge_contact is not None:
        energy = partial(incremental_potential.edge_collision, config=config, laws=laws)
        convex.append(jax.vmap(jax.hessian(energy))(x[mesh.edges], step.edge_contact))
    if step.self_contact is not None:
        energy = partial(incremental_potential.self_collision, config=config, laws=laws)
        points = jnp.concatenate([x[:, None], x[step.self_contact.corners]], axis=1)
        convex.append(jax.vmap(jax.hessian(energy))(points, step.self_contact))

    def pairs(elements: list[Array]) -> Array:
        return jnp.concatenate([jnp.swapaxes(element, 2, 3).reshape(-1, 3, 3) for element in elements])

    return pairs(exact + convex), pairs(semidefinite + convex)


def _stretching_semidefinite(corners: Array, step: TimeStep) -> Array:
    """Hessian [F, 3, 3, 3, 3] N/m of stretching with the second Piola-Kirchhoff stress clamped."""
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
    blocks = 2.0 * mu * jnp.einsum("fpqia,fpqjb->fiajb", change, change)
    blocks = blocks + lam * jnp.einsum("fia,fjb->fiajb", trace_change, trace_change)
    geometric = jnp.einsum("fip,fpq,fjq->fij", b, clamped, b)
    blocks = blocks + jnp.einsum("fij,ab->fiajb", geometric, jnp.eye(3, dtype=corners.dtype))
    return (step.rest.face_area * energies.THICKNESS)[:, None, None, None, None] * blocks


def _bending_semidefinite(hinges: Array, step: TimeStep) -> Array:
    """Gauss-Newton Hessian [H, 4, 3, 4, 3] N/m of bending: k / (4 A) r'^T r' with r = l (theta - theta_0)."""

    def residual(points, rest_angle):
        return norm(points[1] - points[0]) * (energies.dihedral_angle(points[None])[0] - rest_angle)

    slope = jax.vmap(jax.grad(residual))(hinges, step.rest.hinge_angle)
    stiffness = step.material.bending / (4.0 * step.rest.hinge_area)
    return jnp.einsum("h,hia,hjb->hiajb", stiffness, slope, slope)
