"""Forces on the cloth in the space of codes, which a Psi with forces reads (METHOD.md, Psi with forces)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import PhysicsConfig
from clothjax.geometry.clusters import Clusters, nearest_in_clusters
from clothjax.networks.normalisation import Whitening
from clothjax.physics import incremental_potential
from clothjax.physics.incremental_potential import TimeStep
from clothjax.types import Array, Contact, Mesh

KINDS = {"momentum": ("inertia", "gravity"), "elasticity": ("stretching", "bending"), "contact": ("collision",)}
"""Terms of the incremental potential that make up each kind of force: momentum is to where the cloth would fly freely.
Friction, and contact of cloth with itself, are not felt."""
DEPTH = 1e-3  # m, at which a felt plane pushes as hard as the collision energy does
HIGHEST = 0.01  # m, of the height of an arc by which a plane is raised
SMALLEST = 1e-9  # least eigenvalue of an inverse Hessian, relative to its largest


def spring(distance: Array, offset: float) -> Array:
    """Quadratic penetration [V] m^3 at signed distances [V] m, whose force at `DEPTH` is that of `energies.collision`.

    A force that grows as the depth does tells how far to move; that of the cubic energy vanishes near the surface.
    """
    return 1.5 * DEPTH * jnp.maximum(offset - distance, 0.0) ** 2


LAWS = incremental_potential.Laws(collision=spring)


def whitening(inverse_hessian: Array) -> Whitening:
    """Return the whitening of an inverse mean Hessian [L, L] in 1/J, on the host."""
    values, vectors = np.linalg.eigh(np.asarray(inverse_hessian, np.float64))
    sizes = np.sqrt(np.maximum(values, SMALLEST * values[-1]))
    return Whitening(
        to=np.asarray((vectors / sizes) @ vectors.T, np.float32),
        back=np.asarray((vectors * sizes) @ vectors.T, np.float32),
    )


def touching_edges(mesh: Mesh, config: PhysicsConfig) -> Array:
    """Return the edges [E, 2] of a garment that touch the body between their ends: all, or none."""
    return mesh.edges if config.edge_contact else mesh.edges[:0]


def felt_planes(position: Array, surface: tuple[Array, Array], clusters: Clusters, edges: Array) -> Contact:
    """Return the planes that Psi feels, `raised`: of the body's face whose centroid is nearest to a vertex.

    Args:
        position: [V, 3] m, the held garment at the next frame.
        surface: centroids [F, 3] m and unit normals [F, 3] of the body's faces at the next frame.
        clusters: of the garment's vertices and of the faces' centroids.
        edges: [E, 2] int32, of `touching_edges`.
    """
    return raised(planes_of(surface, nearest_in_clusters(position, surface[0], clusters)), position, edges)


def planes_of(surface: tuple[Array, Array], face: Array) -> Contact:
    """Return the planes [V] of faces [V] of a surface, as of `felt_planes`."""
    point, normal = (row[face] for row in surface)
    return Contact(point, point, normal, normal, face)


def raised(planes: Contact, position: Array, edges: Array, times: float = 1.0) -> Contact:
    """Return planes that are raised, so that edges over a round body stay outside of it between their ends.

    That is by the height of an arc over its chord, (n_a - n_b) . (x_a - x_b) / 8 for normals n at its ends x. A vertex
    has that of its highest edge. Arguments as of `felt_planes`.

    Args:
        times: how many heights.
    """
    normal, (start, end) = planes.normal, edges.T
    bulge = jnp.sum((normal[start] - normal[end]) * (position[start] - position[end]), axis=-1) / 8
    bulge = jnp.minimum(bulge, HIGHEST)
    height = jnp.zeros_like(position[:, 0]).at[edges.T].max(bulge)
    point = planes.point + times * height[:, None] * normal
    return planes._replace(point=point, point_next=point)


def on_vertices(position: Array, step: TimeStep, mesh: Mesh, config: PhysicsConfig) -> Array:
    """Return the forces [3, V, 3] in N on a garment: for each of `KINDS`, minus the gradient of its energies.

    Args:
        position: [V, 3] m, the held garment at the next frame.
        step: the time step, with the contact of `felt_planes`, which pushes by `spring`.
    """

    def force(names: tuple[str, ...]) -> Array:
        others = {name for kind in KINDS.values() for name in kind}.difference(names)

        def energy(new: Array) -> Array:
            terms = incremental_potential.elements(new, step, mesh, config, LAWS, others)
            return sum((jnp.sum(terms[name]) for name in names if name in terms), jnp.zeros(()))

        return -jax.grad(energy)(position)

    return jnp.stack([force(names) for names in KINDS.values()])


def reduced(
    garment: Callable[[Array], Array],
    code: Array,
    held: Array,
    step: TimeStep,
    surface: tuple[Array, Array] | None,
    clusters: Clusters | None,
    mesh: Mesh,
    config: PhysicsConfig,
) -> Array:
    """Return the forces [3, L] in J on a code [L]: `on_vertices` of the held garment, pulled back to the code.

    Args:
        garment: from a code to vertices [V, 3] m at the next frame, before relaxation.
        held: [V, 3] m, the garment of now in the pose of the next frame.
        step: the time step; its contact is not used.
        surface, clusters: as of `felt_planes`; None where there is no body to touch.
    """
    _, pullback = jax.vjp(garment, code)
    edges = touching_edges(mesh, config)
    touched = None if surface is None or clusters is None else felt_planes(held, surface, clusters, edges)
    step = step._replace(contact=touched)
    forces = on_vertices(held, step, mesh, config)
    return jax.vmap(lambda force: pullback(force)[0])(forces)
