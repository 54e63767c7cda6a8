"""Elastic forces in closed form, for a Psi with forces: minus the gradient of the stretching and bending energies.

The derivative of `clothjax.physics.energies` is as fast, but it scatters. Sums over a table are in every runtime.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from clothjax.geometry.vectors import Vector, cross, dot, minus, plus, times
from clothjax.physics.energies import SLIVER, THICKNESS
from clothjax.types import Array, Material, Mesh, Rest


def around(mesh: Mesh, vertices: int) -> np.ndarray:
    """Return the corners of elements at each vertex [V, D] int32, by their number in faces, then hinges.

    A corner is numbered by its place in the element, then by the element. Rows end with the number of corners.

    Args:
        vertices: V.
    """
    corners = np.concatenate([np.asarray(elements).T.reshape(-1) for elements in (mesh.faces, mesh.hinges)])
    order, counts = np.argsort(corners, kind="stable"), np.bincount(corners, minlength=vertices)
    table = np.full((vertices, counts.max(initial=1)), len(corners), np.int32)
    table[np.repeat(np.arange(vertices), counts), np.concatenate([np.arange(count) for count in counts])] = order
    return table


def elastic(
    position: Float[Array, "V 3"], rest: Rest, material: Material, mesh: Mesh, table: Int[Array, "V D"]
) -> Float[Array, "V 3"]:
    """Return the elastic forces [V, 3] in N at positions [V, 3] m.

    Args:
        table: of `around`.
    """
    corners = jnp.concatenate([mesh.faces.T.reshape(-1), mesh.hinges.T.reshape(-1)])
    x, y, z = (position[:, axis][corners] for axis in range(3))
    faces, hinges = len(mesh.faces), len(mesh.hinges)

    def corner(begin: int, count: int) -> Vector:
        return x[begin : begin + count], y[begin : begin + count], z[begin : begin + count]

    triangle = [corner(k * faces, faces) for k in range(3)]
    hinge = [corner(3 * faces + k * hinges, hinges) for k in range(4)]
    gradients = (*_stretching(triangle, rest, material), *_bending(hinge, rest, material))
    none = jnp.zeros(1, position.dtype)
    columns = [jnp.concatenate([*of_one, none]) for of_one in zip(*gradients, strict=True)]
    return -jnp.stack([jnp.sum(column[table], axis=1) for column in columns], axis=1)


def _stretching(corners: list[Vector], rest: Rest, material: Material) -> tuple[Vector, ...]:
    """Return the gradients of `energies.stretching` for the three corners: A h F S of the inverse rest edges."""
    a, b, c, d = rest.inverse.reshape(-1, 4).T
    first, second = minus(corners[0], corners[2]), minus(corners[1], corners[2])
    along = plus(times(a, first), times(c, second))  # columns of the deformation gradient F
    across = plus(times(b, first), times(d, second))
    strain = (0.5 * (dot(along, along) - 1.0), 0.5 * dot(along, across), 0.5 * (dot(across, across) - 1.0))
    trace = material.lam * (strain[0] + strain[2])
    size = rest.face_area * THICKNESS
    of_along, shear, of_across = (
        size * x for x in (2.0 * material.mu * strain[0] + trace, 2.0 * material.mu * strain[1],
                           2.0 * material.mu * strain[2] + trace)
    )  # fmt: skip
    left = plus(times(of_along, along), times(shear, across))
    right = plus(times(shear, along), times(of_across, across))
    first, second = plus(times(a, left), times(b, right)), plus(times(c, left), times(d, right))
    return first, second, times(-1.0, plus(first, second))


def _bending(corners: list[Vector], rest: Rest, material: Material) -> tuple[Vector, ...]:
    """Return the gradients of `energies.bending` for the edge's ends and the two vertices opposite.

    Where a face has hardly any area there is no angle, and no gradient.
    """
    start, end, *opposite = corners
    edge, left, right = minus(end, start), minus(opposite[0], start), minus(opposite[1], start)
    normals = cross(edge, left), cross(right, edge)
    squares = [dot(normal, normal) for normal in normals]
    squared = dot(edge, edge)
    size = jnp.maximum(jnp.maximum(squared, dot(left, left)), dot(right, right))
    flat = ~(jnp.minimum(*squares) > SLIVER * SLIVER * size * size)
    squared, squares = jnp.where(flat, 1.0, squared), [jnp.where(flat, 1.0, square) for square in squares]
    length = jnp.sqrt(squared)
    sine, cosine = dot(cross(*normals), edge), dot(*normals) * length
    angle = jnp.arctan2(sine, jnp.where(flat, 1.0, cosine)) - rest.hinge_angle
    weight = jnp.where(flat, 0.0, material.bending / (4.0 * rest.hinge_area))
    torque = weight * squared * angle * length
    tips = [times(-torque / square, normal) for square, normal in zip(squares, normals, strict=True)]
    places = [dot(side, edge) / squared for side in (left, right)]  # of the opposite vertices along the edge
    longer = times(weight * angle * angle, edge)
    at_end = times(-1.0, plus(times(places[0], tips[0]), times(places[1], tips[1])))
    at_start = times(-1.0, plus(at_end, plus(*tips)))
    return minus(at_start, longer), plus(at_end, longer), *tips
