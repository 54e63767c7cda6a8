"""Forces on the cloth in the space of codes, which a Psi with forces reads (METHOD.md, Psi with forces)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import PhysicsConfig
from clothjax.networks.normalisation import Whitening
from clothjax.physics import incremental_potential
from clothjax.physics.incremental_potential import TimeStep
from clothjax.types import Array, Mesh

KINDS = {
    "momentum": ("inertia", "gravity"),  # to where the cloth would fly freely
    "elasticity": ("stretching", "bending"),
    "contact": ("collision", "edge_collision", "friction", "self_collision"),
}
"""Terms of the incremental potential that make up each kind of force."""
SMALLEST = 1e-9  # least eigenvalue of an inverse Hessian, relative to its largest


def whitening(inverse_hessian: Array) -> Whitening:
    """Return the whitening of an inverse mean Hessian [L, L] in 1/J, on the host."""
    values, vectors = np.linalg.eigh(np.asarray(inverse_hessian, np.float64))
    sizes = np.sqrt(np.maximum(values, SMALLEST * values[-1]))
    return Whitening(
        to=np.asarray((vectors / sizes) @ vectors.T, np.float32),
        back=np.asarray((vectors * sizes) @ vectors.T, np.float32),
    )


def reduced(garment: Callable[[Array], Array], code: Array, step: TimeStep, mesh: Mesh, config: PhysicsConfig) -> Array:
    """Return the forces [3, L] in J on a code [L]: for each of `KINDS`, minus the gradient of its energies.

    Args:
        garment: from a code to vertices [V, 3] m at the next frame.
    """
    position, pullback = jax.vjp(garment, code)

    def force(names: tuple[str, ...]) -> Array:
        def energy(new: Array) -> Array:
            terms = incremental_potential.energies(new, step, mesh, config)
            return sum((terms[name] for name in names if name in terms), jnp.zeros(()))

        return -jax.grad(energy)(position)

    on_vertices = jnp.stack([force(names) for names in KINDS.values()])
    return jax.vmap(lambda force: pullback(force)[0])(on_vertices)
