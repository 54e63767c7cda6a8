"""Elastic forces in closed form, for a Psi with forces: minus the gradient of the stretching and bending energies.

They are computed coordinate by coordinate, in a quarter of the time of the derivative of `clothjax.physics.energies`.
A vector is a tuple of its x, y and z, each [N] over the elements.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from clothjax.physics.energies import SLIVER, THICKNESS
from clothjax.types import Array, Material, Mesh, Rest

Vector = tuple[Array, Array, Array]


def around(mesh: Mesh, vertices: int) -> np.ndarray:
    """Return the corners of elements at each vertex [V, D] int32, by their number in faces, then hinges.

    A corner is numbered by its place in the element, then by the element. Rows end with the number of corners. A sum
    over a table takes half as long as scattering, and every runtime has it.

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
    first, second = _minus(corners[0], corners[2]), _minus(corners[1], corners[2])
    along = _plus(_times(a, first), _times(c, second))  # columns of the deformation gradient F
    across = _plus(_times(b, first), _times(d, second))
    strain = (0.5 * (_dot(along, along) - 1.0), 0.5 * _dot(along, across), 0.5 * (_dot(across, across) - 1.0))
    trace = material.lam * (strain[0] + strain[2])
    size = rest.face_area * THICKNESS
    of_along, shear, of_across = (
        size * x for x in (2.0 * material.mu * strain[0] + trace, 2.0 * material.mu * strain[1],
                           2.0 * material.mu * strain[2] + trace)
    )  # fmt: skip
    left = _plus(_times(of_along, along), _times(shear, across))
    right = _plus(_times(shear, along), _times(of_across, across))
    first, second = _plus(_times(a, left), _times(b, right)), _plus(_times(c, left), _times(d, right))
    return first, second, _times(-1.0, _plus(first, second))


def _bending(corners: list[Vector], rest: Rest, material: Material) -> tuple[Vector, ...]:
    """Return the gradients of `energies.bending` for the edge's ends and the two vertices opposite.

    Where a face has hardly any area there is no angle, and no gradient.
    """
    start, end, *opposite = corners
    edge, left, right = _minus(end, start), _minus(opposite[0], start), _minus(opposite[1], start)
    normals = _cross(edge, left), _cross(right, edge)
    squares = [_dot(normal, normal) for normal in normals]
    squared = _dot(edge, edge)
    size = jnp.maximum(jnp.maximum(squared, _dot(left, left)), _dot(right, right))
    flat = ~(jnp.minimum(*squares) > SLIVER * SLIVER * size * size)
    squared, squares = jnp.where(flat, 1.0, squared), [jnp.where(flat, 1.0, square) for square in squares]
    length = jnp.sqrt(squared)
    sine, cosine = _dot(_cross(*normals), edge), _dot(*normals) * length
    angle = jnp.arctan2(sine, jnp.where(flat, 1.0, cosine)) - rest.hinge_angle
    weight = jnp.where(flat, 0.0, material.bending / (4.0 * rest.hinge_area))
    torque = weight * squared * angle * length
    tips = [_times(-torque / square, normal) for square, normal in zip(squares, normals, strict=True)]
    places = [_dot(side, edge) / squared for side in (left, right)]  # of the opposite vertices along the edge
    longer = _times(weight * angle * angle, edge)
    at_end = _times(-1.0, _plus(_times(places[0], tips[0]), _times(places[1], tips[1])))
    at_start = _times(-1.0, _plus(at_end, _plus(*tips)))
    return _minus(at_start, longer), _plus(at_end, longer), *tips


def _plus(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _times(scale: Array | float, a: Vector) -> Vector:
    return (scale * a[0], scale * a[1], scale * a[2])


def _dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
