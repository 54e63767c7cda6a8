"""Relaxation of a decoded garment: a few steps down its stretching energy (METHOD.md, Decoder).

A linear span of blend shapes is stiffer than cloth: a fold in it stretches triangles, unless it has the small
displacements in the plane that go with the fold. These steps find them. They reach a few edges far; what is longer is
the code's.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from clothjax.geometry.vectors import at_corners
from clothjax.physics import energies, kernels
from clothjax.types import Array, Material, Mesh, Rest

RATE = 0.8  # of a Jacobi step; above 1.3 the shortest waves of a regular mesh grow
LONGEST = 0.005  # m, by which the gradient moves a vertex at most: far out of shape cloth is many times as stiff


class Elastic(NamedTuple):
    """The arguments of `energies.stretching` beside positions."""

    inverse: Array  # [F, 2, 2] 1/m
    area: Array  # [F] m^2
    mu: Array  # Pa
    lam: Array  # Pa


@jax.custom_vjp
def stretching_gradient(position: Array, faces: Array, elastic: Elastic) -> Array:
    """Return the gradient [V, 3] N of the stretching energy of faces [F, 3] by positions [V, 3] m.

    Its own derivative by positions is in closed form, which takes XLA a quarter of the time of the general one. There
    is none in forward mode, but that of a gradient through it is.
    """
    return _gradient(position, faces, elastic)


def _gradient(position: Array, faces: Array, elastic: Elastic) -> Array:
    return jax.grad(lambda x: jnp.sum(energies.stretching(at_corners(x, faces), *elastic)))(position)


def _forward(position: Array, faces: Array, elastic: Elastic) -> tuple[Array, tuple[Array, Array, Elastic]]:
    return _gradient(position, faces, elastic), (position, faces, elastic)


def _backward(arguments: tuple[Array, Array, Elastic], cotangent: Array) -> tuple[Array, None, Elastic]:
    position, faces, elastic = arguments
    corners, pull = jax.vjp(lambda x: at_corners(x, faces), position)
    # the Hessian is symmetric
    (by_position,) = pull(energies.stretching_hessian_product(corners, at_corners(cotangent, faces), *elastic))
    _, back = jax.vjp(lambda elastic: _gradient(position, faces, elastic), elastic)
    return by_position, None, *back(cotangent)


stretching_gradient.defvjp(_forward, _backward)


def mobility(rest: Rest, material: Material, mesh: Mesh, free: Float[Array, " V"]) -> Float[Array, " V"]:
    """Return how far a force moves each vertex in a step, [V] m/N: `RATE` over the stiffest direction of its own.

    That is the diagonal of the stretching energy's Hessian at rest, sum A h (2 mu + lambda) |g|^2 over its faces, with
    the gradient g of its shape function.

    Args:
        free: [V], 1 for a vertex that moves and 0 for a pinned one.
    """
    first, second = rest.inverse[:, 0], rest.inverse[:, 1]
    gradients = jnp.stack([first, second, -(first + second)], axis=1)  # [F, 3, 2] 1/m, at the corners
    stiffness = energies.THICKNESS * (2.0 * material.mu + material.lam) * rest.face_area
    own = stiffness[:, None] * jnp.sum(gradients * gradients, axis=-1)
    total = jnp.zeros(free.shape, own.dtype).at[mesh.faces].add(own)
    return jnp.where((free > 0) & (total > 0), RATE / jnp.where(total > 0, total, 1.0), 0.0)


def relaxed(
    position: Float[Array, "V 3"],
    mobility: Float[Array, " V"],
    rest: Rest,
    material: Material,
    mesh: Mesh,
    steps: int,
    momentum: float,
    placed: Callable[[Array], Array] | None = None,
) -> Float[Array, "V 3"]:
    """Return positions [V, 3] m after some steps down the stretching energy.

    Args:
        mobility: [V] m/N, of `mobility`; a step is longer than that by `momentum`.
        momentum: share of the last step that each goes on with. Its limit of stability rises as its length does.
        placed: moves positions [V, 3] m before each step, such as out of a body.
    """
    if steps == 0:
        return position
    if placed is None and kernels.used(position):
        return kernels.relaxed(position, mobility, rest, material, mesh, steps, momentum, LONGEST)
    elastic = Elastic(rest.inverse, rest.face_area, material.mu, material.lam)

    def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        position, before = carry
        position = position if placed is None else placed(position)
        move = -(1.0 + momentum) * mobility[:, None] * stretching_gradient(position, mesh.faces, elastic)
        length = jnp.sum(move * move, axis=-1, keepdims=True)
        move = move / jnp.sqrt(1.0 + length / LONGEST**2)
        if momentum > 0:
            move += momentum * (position - before)
        return (position + move, position), None

    return jax.lax.scan(step, (position, position), None, length=steps)[0][0]
