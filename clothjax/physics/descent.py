"""Preconditioned nonlinear conjugate gradients, for any energy of any coordinates."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from clothjax.types import Array

COLUMNS = 32  # of a Hessian, computed together
MAX_LENGTH = 4.0  # of the step, where 1 is the configured cloth's at rest: others are softer or lighter


def descend(
    precondition: Callable[[Array], Array],
    latent: Array,
    garment: Callable[[Array], Array],
    potential: Callable[[Array], Array],
    steps: int,
    bound: float,
) -> Array:
    """The code [L] after some conjugate-gradient steps (Polak-Ribiere) on the potential of its garment.

    The length of a step is that of Newton's method along it, by the curvature that the potential has there: cloth
    that rests on the body is stiffer than any at rest, and would be thrown off it.

    Args:
        precondition: an approximate inverse Hessian times a gradient [L].
        garment: of a code, vertices [V, 3] m; potential: of these, J.
        bound: length that no step exceeds.
    """

    def step(carry, _):
        latent, direction, gradient, steepest = carry
        held, pullback = jax.vjp(garment, latent)
        force, hessian = jax.linearize(jax.grad(potential), held)
        new = pullback(force)[0]
        down = -precondition(new)
        kept = jnp.sum(new * (steepest - down)) / jnp.maximum(-jnp.sum(gradient * steepest), 1e-12)
        direction = down + jnp.maximum(kept, 0.0) * direction
        direction = jnp.where(jnp.sum(new * direction) < 0, direction, down)
        _, moved = jax.jvp(garment, (latent,), (direction,))
        slope, curvature = jnp.maximum(-jnp.sum(moved * force), 0.0), jnp.sum(moved * hessian(moved))
        convex = curvature > 0
        length = jnp.where(convex, jnp.minimum(slope / jnp.where(convex, curvature, 1.0), MAX_LENGTH), 1.0)
        push = jnp.where(slope > 0, length, 0.0) * direction
        # deep collisions push thousands of times harder than the rest
        push = push / jnp.sqrt(1.0 + jnp.sum(push * push) / bound**2)
        return (latent + push, direction, new, down), None

    zero = jnp.zeros_like(latent)
    (latent, *_), _ = jax.lax.scan(step, (latent, zero, zero, zero), None, length=steps)
    return latent


def warm_start(
    latent: Array, change: Array, garment: Callable[[Array], Array], potential: Callable[[Array], Array]
) -> Array:
    """Where the steps of `descend` begin: the last code [L], plus its last change if the potential is lower there.

    From the last code alone, what a few steps leave undone is like a drag on the cloth. The sum is far off where the
    motion changes at once.
    """
    here, there = latent, latent + change
    return jnp.where(potential(garment(there)) < potential(garment(here)), there, here)


def hessian(energy: Callable[[Array], Array], latent: Array) -> Array:
    """The Hessian [L, L] in J of an energy of codes, at a code [L]."""

    def column(direction):
        return jax.jvp(jax.grad(energy), (latent,), (direction,))[1]

    # some at a time: of a large garment all together would not fit into memory
    return jax.lax.map(column, jnp.eye(len(latent)), batch_size=COLUMNS)


def nearest_convex(matrix: Array) -> Array:
    """A symmetric matrix [L, L] without its negative eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    return jnp.matmul(vectors * jnp.maximum(values, 0.0)[None], vectors.T, precision="highest")


def regularised_inverse(matrix: Array, damping: float) -> Array:
    """The inverse of a convex Hessian [L, L] in J, with `damping` J added to its eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    inverse = 1.0 / (jnp.maximum(values, 0.0) + damping)
    return jnp.matmul(vectors * inverse[None], vectors.T, precision="highest")
