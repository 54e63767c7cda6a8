"""The incremental potential of one time step (METHOD.md, Incremental potential): its energies, and their plain sum."""

from collections.abc import Callable, Collection
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Bool, Float

from clothjax.config import PhysicsConfig
from clothjax.geometry.vectors import at_corners
from clothjax.physics import contact_search, kernels
from clothjax.physics.energies import bending, collision, friction, gravity, inertia, stretching
from clothjax.types import Array, Contact, EdgeContact, Material, Mesh, Rest, Scalar, SelfContact

FRICTION_RADIUS = 3e-3  # m, a distance (HOOD compares its square with this)
FRICTION_SMOOTHING = 1e-4  # m


class TimeStep(NamedTuple):
    """Everything that the incremental potential of a time step depends on, except the new positions."""

    position: Array  # [V, 3] m, at the current frame
    velocity: Array  # [V, 3] m per step, so that position + velocity is the inertial prediction
    mass: Array  # [V] kg
    rest: Rest
    material: Material
    contact: Contact | None  # None where there is no body
    touching: Array | None  # [V] bool, in contact now; None where there is no friction
    timestep: Array  # s
    edge_contact: EdgeContact | None = None
    self_contact: SelfContact | None = None


class Laws(NamedTuple):
    """Energy laws that a comparison with another solver may replace. Static: they are part of a compiled program."""

    stretching: Callable = stretching
    collision: Callable = collision


LAWS = Laws()


def touching(position: Float[Array, "V 3"], contact: Contact) -> Bool[Array, " V"]:
    """Return which vertices [V, 3] m are less than `FRICTION_RADIUS` from their contact planes: a mask [V]."""
    return contact_search.distance(position, contact.point, contact.normal) < FRICTION_RADIUS


def pushed(velocity: Float[Array, "V 3"], timestep: Scalar, external: Array | None) -> Float[Array, "V 3"]:
    """Return velocities [V, 3] m per step with which an external acceleration enters inertia: v + a h^2.

    Args:
        timestep: s.
        external: [3] m/s^2, or None.
    """
    return velocity if external is None else velocity + timestep**2 * external[None]


def elements(
    new: Float[Array, "V 3"],
    step: TimeStep,
    mesh: Mesh,
    config: PhysicsConfig,
    laws: Laws = LAWS,
    without: Collection[str] = (),
) -> dict[str, Array]:
    """Evaluate every term of the incremental potential at new positions [V, 3] m, element by element, in J.

    Training and the reference solver both minimise the sum of these; there is no other energy.

    Args:
        without: terms that are left out, beside those of the configuration.
    """
    moved = new - step.position
    terms: dict[str, Callable[[], Array]] = {
        "stretching": lambda: laws.stretching(
            at_corners(new, mesh.faces), step.rest.inverse, step.rest.face_area, step.material.mu, step.material.lam
        ),
        "bending": lambda: bending(
            at_corners(new, mesh.hinges), step.rest.hinge_area, step.rest.hinge_angle, step.material.bending
        ),
        # the height gained in the step: the same force as the height, without its large constant
        "gravity": lambda: gravity(moved[:, 1], step.mass),
        "inertia": lambda: inertia(moved - step.velocity, step.mass, step.timestep),
    }
    if (contact := step.contact) is not None:
        terms["collision"] = lambda: plane_collision(new, contact, config, laws)
    if contact is not None and (near := step.touching) is not None:
        terms["friction"] = lambda: plane_friction(moved, contact, step.mass, near, config)
    if (edges := step.edge_contact) is not None:
        terms["edge_collision"] = lambda: edge_collision(at_corners(new, mesh.edges), edges, config, laws)
    if (itself := step.self_contact) is not None:
        terms["self_collision"] = lambda: self_collision(
            jnp.concatenate([new[:, None], new[itself.corners]], axis=1), itself, config, laws
        )
    return {name: term() for name, term in terms.items() if name not in {*config.without, *without}}


def plane_collision(
    new: Float[Array, "V 3"], contact: Contact, config: PhysicsConfig, laws: Laws = LAWS
) -> Float[Array, " V"]:
    """Collision energy [V] J of vertices [V, 3] m with their planes."""
    gap = contact_search.distance(new, contact.point_next, contact.normal_next)
    return config.collision_stiffness * laws.collision(gap, config.collision_offset)


def plane_friction(
    moved: Float[Array, "V 3"],
    contact: Contact,
    mass: Float[Array, " V"],
    touching: Bool[Array, " V"],
    config: PhysicsConfig,
) -> Float[Array, " V"]:
    """Friction energy [V] J of vertices that moved by [V, 3] m in a step, of those that were touching their planes."""
    normal = contact.normal + contact.normal_next
    length = jnp.sqrt(jnp.maximum(jnp.sum(normal * normal, axis=-1, keepdims=True), 1e-12))
    slid = moved - (contact.point_next - contact.point)
    return friction(slid, normal / length, mass, touching, config.friction_coefficient, FRICTION_SMOOTHING)


def edge_collision(
    ends: Float[Array, "*n 2 3"], contact: EdgeContact, config: PhysicsConfig, laws: Laws = LAWS
) -> Float[Array, "*n"]:
    """Collision energy [...] J of edges [..., 2, 3] m with the planes at their places of `contact`."""
    start, end = ends[..., 0, :], ends[..., 1, :]
    # differences first: far from the origin the place itself is coarse
    offset = (start - contact.point_next) + contact.place[..., None] * (end - start)
    distance = jnp.sum(offset * contact.normal_next, axis=-1)
    return config.collision_stiffness * laws.collision(distance, config.collision_offset)


def self_collision(
    points: Float[Array, "*n 4 3"], contact: SelfContact, config: PhysicsConfig, laws: Laws = LAWS
) -> Float[Array, "*n"]:
    """Collision energy [...] J of garment vertices with garment triangles.

    Args:
        points: [..., 4, 3] m, a vertex and then the three corners of the triangle that it may touch.
    """
    offset = jnp.sum(contact.weights[..., :, None] * (points[..., :1, :] - points[..., 1:, :]), axis=-2)
    distance = jnp.sum(offset * contact.normal, axis=-1)
    return config.collision_stiffness * laws.collision(distance, config.self_offset)


def energies(
    new: Float[Array, "V 3"], step: TimeStep, mesh: Mesh, config: PhysicsConfig, laws: Laws = LAWS
) -> dict[str, Array]:
    """Evaluate the terms of the incremental potential at new positions [V, 3] m, each a scalar in J."""
    return {name: jnp.sum(values) for name, values in elements(new, step, mesh, config, laws).items()}


def potential(new: Float[Array, "V 3"], step: TimeStep, mesh: Mesh, config: PhysicsConfig) -> Float[Array, ""]:
    """Evaluate the incremental potential at new positions [V, 3] m: the plain sum of its energies, a scalar in J.

    A time step of the cloth minimises it.
    """
    compiled = _in_kernels(new, step, mesh, config) if kernels.used(new) else {}
    terms = elements(new, step, mesh, config, without=compiled) | compiled
    return sum(map(jnp.sum, terms.values()))  # pyright: ignore[reportReturnType]  # there are terms


def _in_kernels(new: Array, step: TimeStep, mesh: Mesh, config: PhysicsConfig) -> dict[str, Array]:
    """Return the energies that kernels have, in J."""
    terms: dict[str, Callable[[], Array]] = {
        "stretching": lambda: kernels.stretching(new, step.rest, step.material, mesh),
        "bending": lambda: kernels.bending(new, step.rest, step.material, mesh),
    }
    if (edges := step.edge_contact) is not None:
        constants = config.collision_stiffness, config.collision_offset
        terms["edge_collision"] = lambda: kernels.edge_collision(new, edges, mesh, *constants)
    return {name: term() for name, term in terms.items() if name not in config.without}
