"""Descent of the potential by L-BFGS (METHOD.md, Descent).

Nocedal & Wright, Numerical Optimization, algorithm 7.4, without its loops: both are triangular systems (Byrd, Nocedal &
Schnabel 1994, Representations of quasi-Newton matrices).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from clothjax.types import Array

COLUMNS = 32  # columns of a Hessian that are computed together on a GPU; all of a large garment do not fit there
MEMORY = 32  # steps from which the curvature is known
SUFFICIENT = 1e-4  # share of what the slope promises that a step must gain (Armijo)
SHORTER = (0.1, 0.5)  # least and greatest share of a step that is tried after one that gained too little
SCALE = (0.05, 20.0)  # least and greatest scale of the preconditioner, of the curvature of the last step
ROUNDING = 1e-7  # of an energy, relative


class _Iterate(NamedTuple):
    """A descent after some steps."""

    latent: Array  # [L]
    energy: Array  # J
    gradient: Array  # [L]
    direction: Array  # [L] to the code that is tried next, and ...
    share: Array  # ... how far to go along it
    moves: Array  # [M, L] changes of the code, ...
    turns: Array  # [M, L] ... of the gradient, and ...
    products: Array  # [M, M] ... the product of each move with each turn as old or newer; stale with older ones
    newest: Array  # row of the last step; those before it go before it, in a ring


Precondition = Callable[[Array], Array]
Objective = Callable[[Array], tuple[Array, Array]]


def _direction(at: _Iterate, precondition: Precondition, bound: float) -> Array:
    """Return the quasi-Newton direction [L], no longer than `bound`."""

    order = (at.newest - jnp.arange(MEMORY, dtype=jnp.int32)) % MEMORY  # newest first, from the ring and into it
    products = at.products[order][:, order]
    curvature = jnp.diagonal(products)
    lower = jnp.tril(products) + jnp.diag(jnp.where(curvature > 0, 0.0, 1.0))
    along = _solved(lower, _times(at.moves, at.gradient)[order])
    rest = at.gradient - _times(along[order], at.turns)
    turn = at.turns[at.newest]
    # both at once: where the matrix is large, reading it is what takes time
    of_turn, of_rest = jax.vmap(precondition)(jnp.stack([turn, rest]))
    scale = curvature[0] / jnp.maximum(jnp.sum(turn * of_turn), 1e-20)
    of_rest = jnp.where(curvature[0] > 0, jnp.clip(scale, *SCALE), 1.0) * of_rest
    back = _solved(lower, curvature * along - _times(at.turns, of_rest)[order], transposed=True)
    new = of_rest + _times(back[order], at.moves)
    # deep collisions push thousands of times harder than the rest
    return -new / jnp.sqrt(1.0 + jnp.sum(new * new) / bound**2)


def _times(first: Array, second: Array) -> Array:
    return jnp.matmul(first, second, precision="highest")


def _solved(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    settings = {"left_side": True, "lower": True, "transpose_a": transposed}
    return jax.lax.linalg.triangular_solve(lower, right[:, None], **settings)[:, 0]


def _blank(latent: Array) -> _Iterate:
    """Return a descent of which nothing is known but its first code [L]: the first `_step` evaluates and keeps that."""
    steps = jnp.zeros((MEMORY, len(latent)), latent.dtype)
    products = jnp.zeros((MEMORY, MEMORY), latent.dtype)
    one, none = jnp.ones((), latent.dtype), jnp.zeros_like(latent)
    return _Iterate(latent, jnp.inf * one, none, none, one, steps, steps, products, jnp.int32(0))


def _step(last: _Iterate, objective: Objective, precondition: Precondition, bound: float) -> _Iterate:
    """Try one step: take it if the energy falls enough, else try a shorter one next.

    The objective is evaluated nowhere else, so that a program has it once.
    """
    tried = last.latent + last.share * last.direction
    energy, gradient = objective(tried)
    slope = last.share * jnp.sum(last.gradient * last.direction)
    falls = energy <= last.energy + SUFFICIENT * slope + ROUNDING * jnp.abs(last.energy)
    move, turn = tried - last.latent, gradient - last.gradient
    curvature = jnp.sum(move * turn)
    convex = falls & (curvature > 1e-10 * jnp.sqrt(jnp.sum(move * move) * jnp.sum(turn * turn)))

    row = jnp.where(convex, (last.newest + 1) % MEMORY, last.newest)

    def remembered(rows: Array, new: Array) -> Array:
        return jax.lax.dynamic_update_index_in_dim(rows, jnp.where(convex, new, rows[row]), row, 0)

    moves = remembered(last.moves, move)
    there = last._replace(
        latent=jnp.where(falls, tried, last.latent),
        energy=jnp.where(falls, energy, last.energy),
        gradient=jnp.where(falls, gradient, last.gradient),
        moves=moves,
        turns=remembered(last.turns, turn),
        products=remembered(
            last.products.T, jnp.where(jnp.arange(MEMORY, dtype=jnp.int32) == row, curvature, _times(moves, turn))
        ).T,
        newest=row,
    )
    # the minimum of the parabola through both energies and the slope
    bend = jnp.where(falls, 1.0, energy - last.energy - slope)  # which the blank descent has none of
    shorter = jnp.clip(-slope / (2.0 * jnp.maximum(bend, 1e-20)), *SHORTER)
    shorter = last.share * jnp.where(jnp.isfinite(energy), shorter, SHORTER[0])
    return there._replace(
        direction=jnp.where(falls, _direction(there, precondition, bound), last.direction),
        share=jnp.where(falls, 1.0, shorter),
    )


def descend(
    precondition: Precondition,
    latent: Array,
    garment: Callable[[Array], Array],
    potential: Callable[[Array], Array],
    steps: int,
    bound: float,
) -> Array:
    """Take steps of L-BFGS from a code [L] down the potential of its garment; the energy never rises.

    Args:
        precondition: from a gradient [L] to an approximate inverse Hessian times it.
        latent: [L], the first code.
        garment: from a code to vertices [V, 3] m.
        potential: from vertices to J.
        steps: number of steps that are tried, each for one gradient.
        bound: length that no step exceeds.

    Returns:
        The last code [L].
    """
    objective = jax.value_and_grad(lambda code: potential(garment(code)))

    def step(at: _Iterate, _: None) -> tuple[_Iterate, None]:
        return _step(at, objective, precondition, bound), None

    return jax.lax.scan(step, _blank(latent), None, length=1 + steps)[0].latent


def converge(
    precondition: Precondition,
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
        tolerance: half of the slope along the direction, were it not bounded, that ends the descent, as a share of the
            energy gained so far, plus as much of 10 mJ.

    Returns:
        The last code [L], and the number of steps.
    """
    objective = jax.value_and_grad(lambda code: potential(garment(code)))

    def goes_on(carry: tuple[_Iterate, Array, Array]) -> Array:
        at, first, count = carry
        short = 1.0 - jnp.sum(at.direction**2) / bound**2  # of a direction that is bounded; 1 is not
        left = -0.5 * jnp.sum(at.gradient * at.direction) / jnp.sqrt(jnp.maximum(short, 1e-6))
        return (count < steps) & ((count < 2) | (left > tolerance * (first - at.energy + 0.01)))

    def step(carry: tuple[_Iterate, Array, Array]) -> tuple[_Iterate, Array, Array]:
        last, first, count = carry
        at = _step(last, objective, precondition, bound)
        return at, jnp.where(count < 0, at.energy, first), count + 1

    blank = _blank(latent)
    at, _, count = jax.lax.while_loop(goes_on, step, (blank, blank.energy, jnp.int32(-1)))
    return at.latent, count


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
    both = jnp.stack([latent, latent + change])
    here, there = jax.lax.map(lambda code: potential(garment(code)), both)
    return jnp.where(there < here, both[1], both[0])


def hessian(energy: Callable[[Array], Array], latent: Array) -> Array:
    """Return the Hessian [L, L] in J of an energy, a function from a code to J, at a code [L]."""

    def column(direction):
        return jax.jvp(jax.grad(energy), (latent,), (direction,))[1]

    # a CPU takes eight times as long for several together
    together = None if jax.default_backend() == "cpu" else COLUMNS
    return jax.lax.map(column, jnp.eye(len(latent)), batch_size=together)


def nearest_convex(matrix: Array) -> Array:
    """Return a symmetric matrix [L, L] with its negative eigenvalues set to zero."""
    values, vectors = jnp.linalg.eigh(matrix)
    return jnp.matmul(vectors * jnp.maximum(values, 0.0)[None], vectors.T, precision="highest")


def regularised_inverse(matrix: Array, damping: float) -> Array:
    """Invert a convex Hessian [L, L] in J, with `damping` J added to its eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    inverse = 1.0 / (jnp.maximum(values, 0.0) + damping)
    return jnp.matmul(vectors * inverse[None], vectors.T, precision="highest")
