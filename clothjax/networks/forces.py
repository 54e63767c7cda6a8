"""Forces on the cloth in the space of codes, which a Psi with forces reads (METHOD.md, Psi with forces)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import PhysicsConfig
from clothjax.networks.normalisation import Whitening
from clothjax.physics import contact_search, incremental_potential
from clothjax.physics.incremental_potential import TimeStep
from clothjax.simulation.characters import Window
from clothjax.simulation.scene import Scene
from clothjax.types import Array

KINDS = {
    "momentum": ("inertia", "gravity"),  # to where the cloth would fly freely
    "elasticity": ("stretching", "bending"),
    "contact": ("collision",),
}
"""Terms of the incremental potential that make up each kind of force. Friction, and contact of edges
and of cloth with itself, are not felt."""
SMALLEST = 1e-9  # least eigenvalue of an inverse Hessian, relative to its largest


def whitening(inverse_hessian: Array) -> Whitening:
    """Return the whitening of an inverse mean Hessian [L, L] in 1/J, on the host."""
    values, vectors = np.linalg.eigh(np.asarray(inverse_hessian, np.float64))
    sizes = np.sqrt(np.maximum(values, SMALLEST * values[-1]))
    return Whitening(
        to=np.asarray((vectors / sizes) @ vectors.T, np.float32),
        back=np.asarray((vectors * sizes) @ vectors.T, np.float32),
    )


def felt(step: TimeStep, held: Array, body: Array, faces: Array, candidates: Array) -> TimeStep:
    """Return a time step with the contact that Psi feels, for which there is no search.

    A vertex feels the plane of the face, of its candidates, whose centroid is nearest.

    Args:
        held: [V, 3] m, the held garment at the next frame.
        body: [B, 3] m at the next frame.
        faces: [F, 3] of the body.
        candidates: [V, K] int32, faces.
    """
    if step.contact is None:
        return step
    points, normals = contact_search.centroids(body, faces)
    apart = held[:, None] - points[candidates]
    nearest = jnp.argmin(jnp.sum(apart * apart, axis=-1), axis=1)
    face = jnp.take_along_axis(candidates, nearest[:, None], axis=1)[:, 0]
    return step._replace(contact=step.contact._replace(point_next=points[face], normal_next=normals[face]))


def reduced(
    garment: Callable[[Array], Array],
    code: Array,
    step: TimeStep,
    window: Window,
    scene: Scene,
    candidates: Array,
    config: PhysicsConfig,
) -> Array:
    """Return the forces [3, L] in J on a code [L]: for each of `KINDS`, minus the gradient of its energies.

    Args:
        garment: from a code to vertices [V, 3] m at the next frame.
        window: the character around the step.
        candidates: [V, K] int32, as of `felt`.
    """
    position, pullback = jax.vjp(garment, code)
    step = felt(step, position, window.following.body, jnp.asarray(scene.body.faces), candidates)

    def force(names: tuple[str, ...]) -> Array:
        def energy(new: Array) -> Array:
            terms = incremental_potential.energies(new, step, scene.mesh, config)
            return sum((terms[name] for name in names if name in terms), jnp.zeros(()))

        return -jax.grad(energy)(position)

    on_vertices = jnp.stack([force(names) for names in KINDS.values()])
    return jax.vmap(lambda force: pullback(force)[0])(on_vertices)
