"""Descent of the potential by preconditioned nonlinear conjugate gradients (METHOD.md, Descent)."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from clothjax.types import Array

COLUMNS = 32  # columns of a Hessian that are computed together
MAX_LENGTH = 4.0  # longest step, where 1 is right for the configured cloth at rest: others are softer or lighter


class _Iterate(NamedTuple):
    """A descent after some steps."""

    latent: Array  # [L]
    direction: Array  # [L] of the last step
    gradient: Array  # [L] where that step began
    steepest: Array  # [L] minus the preconditioned gradient there
    energy: Array  # J, there


def _step(
    last: _Iterate,
    precondition: Callable[[Array], Array],
    garment: Callable[[Array], Array],
    potential: Callable[[Array], Array],
    bound: float,
) -> _Iterate:
    """Take one step of `descend`."""
    x, pullback = jax.vjp(garment, last.latent)
    energy, force = jax.value_and_grad(potential)(x)
    new = pullback(force)[0]
    down = -precondition(new)
    beta = jnp.sum(new * (last.steepest - down)) / jnp.maximum(-jnp.sum(last.gradient * last.steepest), 1e-12)
    direction = down + jnp.maximum(beta, 0.0) * last.direction
    direction = jnp.where(jnp.sum(new * direction) < 0, direction, down)
    _, moved = jax.jvp(garment, (last.latent,), (direction,))
    # forwards twice: the product with the Hessian takes twice as long
    _, curvature = jax.jvp(lambda y: jax.jvp(potential, (y,), (moved,))[1], (x,), (moved,))
    slope = jnp.maximum(-jnp.sum(moved * force), 0.0)
    convex = curvature > 0
    length = jnp.where(convex, jnp.minimum(slope / jnp.where(convex, curvature, 1.0), MAX_LENGTH), 1.0)
    push = jnp.where(slope > 0, length, 0.0) * direction
    # deep collisions push thousands of times harder than the rest
    push = push / jnp.sqrt(1.0 + jnp.sum(push * push) / bound**2)
    return _Iterate(last.latent + push, direction, new, down, energy)


def _first(latent: Array) -> _Iterate:
    zero = jnp.zeros_like(latent)
    return _Iterate(latent, zero, zero, zero, jnp.zeros((), latent.dtype))


def descend(
    precondition: Callable[[Array], Array],
    latent: Array,
    garment: Callable[[Array], Array],
    potential: Callable[[Array], Array],
    steps: int,
    bound: float,
) -> Array:
    """Take conjugate-gradient steps (Polak-Ribiere) from a code [L] down the potential of its garment.

    The length of a step is Newton's along its direction, from the local curvature of the potential. Cloth that rests
    on the body is stiffer than cloth at rest, and longer steps would throw it off.

    Args:
        precondition: from a gradient [L] to an approximate inverse Hessian times it.
        latent: [L], the first code.
        garment: from a code to vertices [V, 3] m.
        potential: from vertices to J.
        steps: number of steps.
        bound: length that no step exceeds.

    Returns:
        The last code [L].
    """

    iterate, _ = jax.lax.scan(
        lambda last, _: (_step(last, precondition, garment, potential, bound), None), _first(latent), None, length=steps
    )
    return iterate.latent


def converge(
    precondition: Callable[[Array], Array],
    latent: Array,
    garment: Callable[[Array], Array],
    potential: Callable[[Array], Array],
    steps: int,
    bound: float,
    tolerance: float,
) -> tuple[Array, Array]:
    """Descend like `descend` until little energy is left to gain; it has no derivative in reverse mode.

    Args:
        steps: most steps.
        tolerance: half of g^T P g that ends the descent, as a share of the energy gained so far, plus as much of 10 mJ.

    Returns:
        The last code [L], and the number of steps.
    """
    began = potential(garment(latent))

    def goes_on(carry):
        iterate, count = carry
        left = -0.5 * jnp.sum(iterate.gradient * iterate.steepest)
        gained = jnp.maximum(began - iterate.energy, 0.0)
        return (count < steps) & ((count < 2) | (left > tolerance * (gained + 0.01)))

    def step(carry):
        iterate, count = carry
        return _step(iterate, precondition, garment, potential, bound), count + 1

    iterate, count = jax.lax.while_loop(goes_on, step, (_first(latent), jnp.int32(0)))
    return iterate.latent, count


def warm_start(
    latent: Array, change: Array, garment: Callable[[Array], Array], potential: Callable[[Array], Array]
) -> Array:
    """Return the code [L] from which `descend` starts: the current one, plus its last change if the potential falls.

    From the current code alone, the error that a few steps leave acts like a drag on the cloth. The sum is far off
    where the motion changes abruptly.

    Args:
        latent, change: [L], the current code and its change in the last frame.
        garment, potential: as of `descend`.
    """
    here, there = latent, latent + change
    return jnp.where(potential(garment(there)) < potential(garment(here)), there, here)


def hessian(energy: Callable[[Array], Array], latent: Array) -> Array:
    """Return the Hessian [L, L] in J of an energy, a function from a code to J, at a code [L]."""

    def column(direction):
        return jax.jvp(jax.grad(energy), (latent,), (direction,))[1]

    # some columns at a time: all those of a large garment would not fit into memory
    return jax.lax.map(column, jnp.eye(len(latent)), batch_size=COLUMNS)


def nearest_convex(matrix: Array) -> Array:
    """Return a symmetric matrix [L, L] with its negative eigenvalues set to zero."""
    values, vectors = jnp.linalg.eigh(matrix)
    return jnp.matmul(vectors * jnp.maximum(values, 0.0)[None], vectors.T, precision="highest")


def regularised_inverse(matrix: Array, damping: float) -> Array:
    """Invert a convex Hessian [L, L] in J, with `damping` J added to its eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    inverse = 1.0 / (jnp.maximum(values, 0.0) + damping)
    return jnp.matmul(vectors * inverse[None], vectors.T, precision="highest")
