"""The reference solver: a time step of the cloth as the minimum of the potential that training minimises.

The solver is Newton's method on the sparse Hessian, assembled element by element, in float64 on the host. It measures
how far a network is from the optimum; it is never used to train.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from clothjax.config import PhysicsConfig
from clothjax.physics import contact_search, energies, hessians, incremental_potential
from clothjax.physics.incremental_potential import LAWS, Laws, TimeStep
from clothjax.types import Array, Mesh, Scalar

CG_ITERATIONS = 600
SHORTEST_STEP = 1e-8
ROUNDING = 1e-13  # rounding error of the potential, over the sum of the absolute energies
MAX_STRETCH = 2.0  # plausible length over that at rest
MAX_DEPTH = 0.01  # m, plausible depth in the body
TOLERANCE = 1e-6  # remaining force over the weight


class SolverInfo(NamedTuple):
    """The outcome of solving one time step."""

    converged: bool
    iterations: int
    gradient_norm: float  # N, of the free vertices
    relative_gradient: float  # gradient_norm over the norm of the free vertices' weights
    energy: float  # J
    stretch: float  # the largest of a face in any direction, 1 at rest
    depth: float  # m, of the free vertex farthest behind the surface that it may touch

    @property
    def ok(self) -> bool:
        """True if converged and physically plausible: no face stretched twofold, no vertex deeper than 1 cm."""
        return self.converged and self.stretch < MAX_STRETCH and self.depth < MAX_DEPTH


def solve_step(
    new0: Array,
    step: TimeStep,
    mesh: Mesh,
    pinned: Array,
    config: PhysicsConfig,
    *,
    tolerance: float = TOLERANCE,
    max_iterations: int = 500,
    laws: Laws = LAWS,
) -> tuple[np.ndarray, SolverInfo]:
    """Minimise `incremental_potential.potential` over the vertices that are not pinned.

    The method is Newton's, with conjugate gradients on the exact Hessian and a line search. The conjugate gradients
    stop at negative curvature. Their preconditioner is the inverse of a semidefinite Hessian's 3 x 3 diagonal blocks
    (see `hessians.blocks`). The minimum is a local one, of which folds have many: compare energies, not positions.
    Contact planes and the friction mask are those of `step`, so the potential is smooth.

    Args:
        new0: [V, 3] m, first positions; pinned vertices stay there.
        step: the time step; converted to float64.
        mesh: connectivity of the elements.
        pinned: [V] bool.
        config: constants of contact and friction.
        tolerance: the solve stops at this norm of the remaining force on the free vertices, as a fraction of the
            norm of their weights. It does not depend on the start, where penetration can make any force.
        max_iterations: most Newton iterations.
        laws: of stretching and collision; others than the default are for comparisons.

    Returns:
        Positions [V, 3] m in float64, and the outcome. `converged` is false if the tolerance was not met. `ok` is
        also false if a face is stretched to twice its length or a vertex is deep in the body.

    Raises:
        ValueError: a start that is not finite, or a vertex without mass.
    """
    x = np.array(new0, np.float64)
    step = jax.tree.map(to_float64, step)
    _check(x, step)
    step, mesh = _present(step, jax.tree.map(np.asarray, mesh), config)
    pattern = hessians.structure(step, mesh)
    free = np.broadcast_to(~np.asarray(pinned, bool)[:, None], x.shape)
    weight = max(float(np.linalg.norm(energies.GRAVITY * step.mass[free[:, 0]])), np.finfo(np.float64).tiny)

    with jax.enable_x64(True):
        evaluate = partial(_value_and_gradient, step=step, mesh=mesh, config=config, laws=laws)
        energy, gradient, _ = _host(evaluate(x), free)
        iterations = 0
        while _norm(gradient) > tolerance * weight and iterations < max_iterations:
            blocks, diagonal = hessians.blocks(x, step, mesh, pattern, config, laws)
            if not (np.isfinite(blocks).all() and np.isfinite(diagonal).all()):
                break
            # inexact far away, more exact as the gradient falls: the last iterations converge superlinearly
            forcing = min(0.1, np.sqrt(0.1 * _norm(gradient) / weight))
            direction = _conjugate_gradients(blocks, diagonal, gradient, free, pattern, forcing)
            iterations += 1
            x, energy, gradient, moved = _line_search(evaluate, x, energy, gradient, direction, free)
            if not moved:
                break
        stretch, depth = (float(value) for value in _condition(x, step, mesh, free[:, 0]))
    norm = _norm(gradient)
    return x, SolverInfo(norm <= tolerance * weight, iterations, norm, norm / weight, energy, stretch, depth)


def _present(step: TimeStep, mesh: Mesh, config: PhysicsConfig) -> tuple[TimeStep, Mesh]:
    """Return the step and the mesh, without hinges if the scene has no bending."""
    if "bending" not in config.without:
        return step, mesh
    rest = step.rest._replace(hinge_area=step.rest.hinge_area[:0], hinge_angle=step.rest.hinge_angle[:0])
    return step._replace(rest=rest), mesh._replace(hinges=mesh.hinges[:0])


@partial(jax.jit, static_argnames=("config", "laws"))
def _value_and_gradient(x, step, mesh, config, laws):
    """Evaluate the potential, its gradient, and a bound on the potential's rounding error."""

    def potential(x):
        elements = incremental_potential.elements(x, step, mesh, config, laws)
        return sum(jnp.sum(values) for values in elements.values()), elements

    (energy, elements), gradient = jax.value_and_grad(potential, has_aux=True)(x)
    return energy, gradient, ROUNDING * sum(jnp.sum(jnp.abs(values)) for values in elements.values())


@jax.jit
def _condition(x: Array, step: TimeStep, mesh: Mesh, free: Array) -> tuple[Array, Array]:
    """Measure the largest stretch of a face, and the depth in m of the deepest free vertex."""
    strain = energies.green_strain(x[mesh.faces], step.rest.inverse)
    mean, spread = 0.5 * (strain[:, 0, 0] + strain[:, 1, 1]), 0.5 * (strain[:, 0, 0] - strain[:, 1, 1])
    largest = mean + jnp.sqrt(spread * spread + strain[:, 0, 1] * strain[:, 0, 1])
    stretch = jnp.sqrt(jnp.maximum(1.0 + 2.0 * jnp.max(largest), 0.0))
    depth = jnp.zeros((), x.dtype)
    if step.contact is not None:
        distance = contact_search.distance(x, step.contact.point_next, step.contact.normal_next)
        depth = jnp.max(jnp.where(free, -distance, 0.0), initial=0.0)
    return stretch, depth


def _host(result, free) -> tuple[float, np.ndarray, float]:
    """Bring the result of `_value_and_gradient` to the host, with the gradient of pinned vertices set to zero."""
    energy, gradient, rounding = result
    return float(energy), np.where(free, np.asarray(gradient), 0.0), float(rounding)


def _check(x: np.ndarray, step: TimeStep) -> None:
    """Raise a ValueError for a start that is not finite or a vertex without mass."""
    bad = ~np.isfinite(x).all(axis=1)
    if bad.any():
        raise ValueError(f"solve_step: new0[{np.argmax(bad)}] is {x[np.argmax(bad)]}; a start must be finite")
    if not (step.mass > 0).all():
        vertex = np.argmin(step.mass)
        raise ValueError(
            f"solve_step: vertex {vertex} has mass {step.mass[vertex]} kg, which must be > 0; "
            "remove vertices that belong to no face of positive area"
        )


def to_float64(leaf: Array | Scalar) -> np.ndarray:
    """Convert floats to an array of float64; return other arrays with their dtype."""
    array = np.asarray(leaf)
    return array.astype(np.float64) if np.issubdtype(array.dtype, np.floating) else array


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Return the inner product of two arrays; BLAS would share it out, and wait for cores that others use."""
    return float(np.sum(a * b))


def _norm(a: np.ndarray) -> float:
    return _dot(a, a) ** 0.5


def _conjugate_gradients(blocks, diagonal, gradient, free, pattern, forcing) -> np.ndarray:
    """Return a descent direction [V, 3] m: the Newton step to a residual `forcing`, or up to negative curvature.

    Args:
        blocks, diagonal: of `hessians.blocks`; the inverse of the second is the preconditioner.
        free: [V, 3] bool, coordinates that move.
    """
    rows = np.repeat(np.arange(len(diagonal)), np.diff(pattern.indptr))
    moving = (free[rows, 0] & free[pattern.indices, 0])[:, None, None]
    matrix = scipy.sparse.bsr_array((np.where(moving, blocks, 0.0), pattern.indices, pattern.indptr))
    inverse = np.linalg.inv(diagonal)

    def preconditioned(residual: np.ndarray) -> np.ndarray:
        return np.einsum("vab,vb->va", inverse, residual.reshape(-1, 3)).reshape(-1)

    residual = -gradient.reshape(-1)
    solution, search = np.zeros_like(residual), preconditioned(residual)
    squared = _dot(residual, search)
    limit = forcing**2 * squared
    for iteration in range(CG_ITERATIONS):
        product = matrix @ search
        curvature = _dot(search, product)
        if curvature <= 0:
            if iteration == 0:
                solution = search
            break
        length = squared / curvature
        solution += length * search
        residual -= length * product
        next_search = preconditioned(residual)
        previous, squared = squared, _dot(residual, next_search)
        if squared < limit:
            break
        search = next_search + (squared / previous) * search
    return solution.reshape(-1, 3)


def _line_search(evaluate, x, energy, gradient, direction, free):
    """Backtrack (Armijo) along a direction from x; the last result is true if a better point was found."""
    slope = _dot(gradient, direction)
    squared = _dot(gradient, gradient)
    length = 1.0
    while length >= SHORTEST_STEP:
        trial = x + length * direction
        trial_energy, trial_gradient, rounding = _host(evaluate(trial), free)
        lower = trial_energy <= energy + 1e-4 * length * slope
        # near the minimum the decrease drowns in the rounding of the energy, but not that of the gradient
        level = abs(trial_energy - energy) <= rounding and _dot(trial_gradient, trial_gradient) < squared
        if lower or level:
            return trial, trial_energy, trial_gradient, True
        length *= 0.5
    return x, energy, gradient, False
