"""The garment of a model: decoded, skinned, and, for a Psi with forces, felt (METHOD.md, Psi with forces).

Garments are [3, V], coordinate by coordinate, because processors are fast at long rows.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from clothjax.body import skinning
from clothjax.config import Config
from clothjax.geometry.clusters import middles, nearest_and_of_edges
from clothjax.networks import forces, psi
from clothjax.physics import contact_search, incremental_potential, relaxation
from clothjax.physics.incremental_potential import TimeStep
from clothjax.runtime.models import Drape, Felt, ForcePredictor, Layer, Model, Network, Shown
from clothjax.types import Array, Contact, Pose

HIGHEST = jax.lax.Precision.HIGHEST
STILL = 2.5e-5  # of the rotation matrices, and in m: a pose that changes by less stands still
AWAKE = 60  # frames that the cloth moves freely for on a body that stands still; then ...
SLOWING = 0.95  # ... in each frame the change of the code shrinks by this
DEEPEST = 0.02  # m, by which a vertex or an edge is pushed out at most: what seems deeper is behind a plane's end
REACH = 0.05  # m, farther from the middle of an edge a face, by its centroid, is not touched
SHOWN_MOMENTUM, OUTSIDE_MOMENTUM = 0.8, 0.5  # of `model.shown_relaxation`: of its steps, then of ...
ROUNDS, TURNS = 2, 6  # ... its rounds, and their turns
RAISED = 1.5  # heights of arcs, of planes that a garment touches which does not feel: relaxation draws its edges in


class ShownRelaxation(NamedTuple):
    """How a garment is relaxed that is shown where another feels: in steps, then in rounds outside the body."""

    steps: int
    momentum: float  # of the steps
    rounds: int  # each with the planes that are nearest as it begins
    turns: int  # of a round: pushed out of the planes, then a step
    outside_momentum: float  # of the turns


class Touched(NamedTuple):
    """Planes of the body that a garment may touch."""

    vertices: Contact
    edges: Contact  # of their middles, ...
    far: Array  # [E] bool ... which touch none of these planes


def blend_weights(network: Network, latent: Array, config: Config) -> Array:
    """Return the weights [K] of the blend shapes `Network.shapes` for a code [C]."""
    read = network.read
    product = latent @ read.kernel if isinstance(read, Layer) else latent[-len(read.bias) :]
    x, skip = jnp.split(read.bias + product, [network.width])
    for layer in network.decoder:
        x = jax.nn.relu(x) @ layer.kernel + layer.bias
    weights = x + skip if config.model.decoder_skip else x
    weights = jax.nn.relu(weights) if config.model.blendshape_relu else weights
    return weights if network.mix is None else weights @ network.mix.kernel + network.mix.bias


def shown(model: Model, latent: Array, transforms: Array, moved: Array | float = 0.0) -> Array:
    """Return the vertices [V, 3] m of a code [C], relative to the root's translation.

    Args:
        transforms: [J', 3, 4] of the joints.
        moved: [3, V] m, what is added in the canonical pose.
    """
    garment = _canonical(model, latent, Shown(model.network.shapes, model.network.weights), model.wearer.template)
    return _skin(_rows(model.network.weights, transforms), garment + moved).T


def shown_outside(model: Model, latent: Array, drape: Drape, touched: Touched, transforms: Array) -> Array:
    """Return the vertices [V, 3] m of a Psi with forces, where the body pushes no more; arguments of `shown`.

    The garment that feels is pushed out, edges and vertices, and relaxed, in turn: what is only pushed out is
    stretched. The state does not know of this.

    Args:
        drape: after the step; what it feels is often what is shown.
        touched: of `predict`, relative to the root's translation.
    """
    parts, offset, outside = _forces(model), model.config.physics.collision_offset, drape.position
    if parts.felt is not None and parts.felt.mesh is not None:
        return _relaxed_outside(model, shown(model, latent, transforms), touched, parts.felt)
    edges = forces.touching_edges(parts.mesh, model.config.physics)

    def targets(positions: Array, planes: Contact) -> tuple[Array, Array, Array]:
        point, normal = planes.point_next, planes.normal_next
        gap = contact_search.distance(positions, point, normal)
        return point, normal, jnp.minimum(offset, gap + DEEPEST)

    of_vertices = targets(outside, touched.vertices)
    point, normal, apart = targets(middles(outside, edges), touched.edges)
    of_edges = (point, normal, jnp.where(touched.far, -jnp.inf, apart))

    def pushed_out(garment: Array) -> Array:
        garment = contact_search.edges_pushed_out(garment, edges, *of_edges, DEEPEST)
        return contact_search.pushed_out(garment, *of_vertices, DEEPEST)

    outside = pushed_out(_relaxed(model, outside, relaxation_steps(model), 0.0, pushed_out))
    if parts.felt is None:
        return outside
    back = skinning.unapply_direction(_matrices(model, transforms), outside - drape.position)
    moved = drape.garment + back.T - _canonical(model, latent, *felt_garment(model))
    taken = jnp.sum(moved[:, parts.felt.around] * parts.felt.shares[None], axis=-1)  # what is shown takes part in it
    point, normal, apart = (row[parts.felt.nearest] for row in of_vertices)
    return contact_search.pushed_out(shown(model, latent, transforms, taken), point, normal, apart, DEEPEST)


def _relaxed_outside(model: Model, garment: Array, touched: Touched, felt: Felt) -> Array:
    """Return the garment [V, 3] m that does not feel, relaxed, then pushed out and relaxed in turn.

    Where it is near tells what it touches. That changes as it is pushed and relaxed, so it is asked anew.

    Args:
        garment: before that.
        touched: by the garment that feels.
    """
    cloth, how = model.wearer.cloth, shown_relaxation(model)
    assert cloth is not None and cloth.shown is not None and felt.mesh is not None
    (rest, mobility), mesh = cloth.shown, felt.mesh
    sides = jnp.concatenate([mesh.faces[:, [i, (i + 1) % 3]] for i in range(3)])
    garment = relaxation.relaxed(garment, mobility, rest, cloth.material, mesh, how.steps, how.momentum)

    def lifted(garment: Array, _: None) -> tuple[Array, None]:
        planes = _nearest_beside(garment, touched, felt)
        planes = forces.raised(planes._replace(point=planes.point_next), garment, sides, RAISED)
        point, normal = planes.point_next, planes.normal_next
        gap = contact_search.distance(garment, point, normal)
        apart = jnp.minimum(model.config.physics.collision_offset, gap + DEEPEST)

        def pushed_out(garment: Array) -> Array:
            return contact_search.pushed_out(garment, point, normal, apart, DEEPEST)

        turns = how.turns, how.outside_momentum
        garment = relaxation.relaxed(garment, mobility, rest, cloth.material, mesh, *turns, pushed_out)
        return pushed_out(garment), None

    return jax.lax.scan(lifted, garment, None, length=how.rounds)[0]


def _nearest_beside(position: Array, touched: Touched, felt: Felt) -> Contact:
    """Return, for vertices [V, 3] m, the planes of which the points are nearest, among those `Felt.beside`."""
    assert felt.beside is not None
    far = jnp.concatenate([jnp.zeros(len(touched.vertices.point), bool), touched.far])
    both = jax.tree.map(lambda *rows: jnp.concatenate(rows), touched.vertices, touched.edges)
    apart = jnp.sum((both.point_next[felt.beside] - position[:, None]) ** 2, axis=-1)
    nearest = jnp.argmin(jnp.where(far[felt.beside], jnp.inf, apart), axis=1)
    chosen = jnp.take_along_axis(felt.beside, nearest[:, None], axis=1)[:, 0]
    return jax.tree.map(lambda rows: rows[chosen], both)


def begin(model: Model, latent: Array, transforms: Array) -> Drape:
    """Return how the garment of a Psi with forces hangs for a code [L], at rest; arguments as of `shown`."""
    garment, position = _hung(model, latent, transforms)
    return Drape(jnp.zeros_like(latent), garment, position, jnp.zeros_like(position), jnp.float32(0.0))


def stood(drape: Drape, rotations: Array, advance: Array, external: Array | None) -> Drape:
    """Count a frame for which the body stands still, or begin to count again.

    Args:
        drape: of the current frame.
        rotations: [2, J, 3, 3] of the next frame and the current one.
        advance: [3] m, the root's step.
        external: [3] m/s^2 or None, as of `inference.step`.
    """
    still = (jnp.max(jnp.abs(rotations[0] - rotations[1])) < STILL) & jnp.all(jnp.abs(advance) < STILL)
    if external is not None:
        still &= jnp.all(external == 0.0)
    return drape._replace(still=jnp.where(still, drape.still + 1.0, 0.0))


def predict(
    model: Model, latent: Array, drape: Drape, transforms: Array, pose: Pose, advance: Array, external: Array | None
) -> tuple[Array, Touched]:
    """Predict the next code from the forces on the held garment at the next frame.

    Args:
        latent, drape: of the current frame, the latter as `stood` returns it.
        transforms: [J', 3, 4] of the joints at the next frame.
        pose: of the next frame.
        advance: [3] m, the root's step to it.
        external: [3] m/s^2 or None, as of `inference.step`.

    Returns:
        The code [L], not yet clipped, and what the held garment touches, relative to the root's new translation.
    """
    parts, cloth, config = _forces(model), model.wearer.cloth, model.config
    assert cloth is not None
    felt, _ = felt_garment(model)
    rows, timestep = _rows(felt.weights, transforms), 1.0 / config.fps
    held = (_skin(rows, drape.garment) + advance[:, None]).T
    body = skinning.pose_corrected(parts.corrections, cloth.body, pose)
    posed = (_skin(_rows(parts.body, transforms), body.T) + advance[:, None]).T
    surface, edges = contact_search.centroids(posed, parts.faces), forces.touching_edges(parts.mesh, config.physics)
    nearest, of_edges = nearest_and_of_edges(held, surface[0], parts.clusters, edges)
    planes = forces.planes_of(surface, nearest)
    step = TimeStep(
        position=drape.position,
        velocity=incremental_potential.pushed(drape.velocity, timestep, external),
        mass=cloth.mass,
        rest=cloth.rest,
        material=cloth.material,
        contact=forces.raised(planes, held, edges),
        touching=None,
        timestep=jnp.float32(timestep),
    )
    on_vertices = forces.on_vertices(held, step, parts.mesh, config.physics)
    carried_back = jnp.einsum("abv,kva->kbv", rows[:, :3], on_vertices, precision=HIGHEST)
    on_weights = jnp.matmul(carried_back.reshape(len(forces.KINDS), -1), felt.shapes.T, precision=HIGHEST)
    _, pullback = jax.vjp(lambda code: blend_weights(model.network, code, config), latent)
    pulls = jax.vmap(lambda force: pullback(force)[0])(on_weights)
    code = psi.next_code(
        parts.params,
        parts.scales,
        latent,
        drape.change,
        pulls,
        cloth.constants,
        config.stage2,
        SLOWING ** jnp.maximum(drape.still - AWAKE, 0.0),
    )
    at_edges = forces.planes_of(surface, of_edges)
    far = jnp.sum((middles(held, edges) - at_edges.point) ** 2, axis=-1) > REACH**2

    def rooted(planes: Contact) -> Contact:
        return planes._replace(point_next=planes.point_next - advance[None])

    return code, Touched(rooted(planes), rooted(at_edges), far)


def follow(model: Model, latent: Array, before: Array, drape: Drape, transforms: Array, advance: Array) -> Drape:
    """Return how the garment hangs after a step, relative to the root's new translation.

    Args:
        latent, before: [L] the new code and the one before it.
        drape: before the step.
        transforms, advance: as of `predict`.
    """
    garment, position = _hung(model, latent, transforms)
    velocity = position + advance[None] - drape.position
    return Drape(latent - before, garment, position, velocity, drape.still)


def _hung(model: Model, latent: Array, transforms: Array) -> tuple[Array, Array]:
    """Return the garment that feels, for a code [L]: [3, V] m in the canonical pose, and [V, 3] m posed and relaxed."""
    felt, template = felt_garment(model)
    garment = _canonical(model, latent, felt, template)
    position, steps = _skin(_rows(felt.weights, transforms), garment).T, relaxation_steps(model)
    if steps == 0:
        return garment, position
    relaxed = _relaxed(model, position, steps, model.config.model.relaxation_momentum)
    back = skinning.unapply_direction(_matrices(model, transforms), relaxed - position)
    return garment + back.T, relaxed


def _relaxed(
    model: Model, position: Array, steps: int, momentum: float, placed: Callable[[Array], Array] | None = None
) -> Array:
    """Return the garment that feels [V, 3] m after some steps of relaxation; arguments as of `relaxation.relaxed`."""
    cloth, mesh = model.wearer.cloth, _forces(model).mesh
    if steps == 0:
        return position
    assert cloth is not None and cloth.mobility is not None
    return relaxation.relaxed(position, cloth.mobility, cloth.rest, cloth.material, mesh, steps, momentum, placed)


def _matrices(model: Model, transforms: Array) -> Array:
    """Return the transforms [V, 3, 4] of the vertices that feel, from those [J', 3, 4] of the joints."""
    return jnp.moveaxis(_rows(felt_garment(model)[0].weights, transforms), 2, 0)


def _forces(model: Model) -> ForcePredictor:
    assert isinstance(model.network.predictor, ForcePredictor)
    return model.network.predictor


def relaxation_steps(model: Model) -> int:
    """Return how many steps relax the garment that feels."""
    assert model.wearer.cloth is not None
    return 0 if model.wearer.cloth.mobility is None else model.config.model.relaxation


def shown_relaxation(model: Model) -> ShownRelaxation:
    settings = model.config.model
    if settings.shown_relaxation > 0:
        return ShownRelaxation(settings.shown_relaxation, SHOWN_MOMENTUM, ROUNDS, TURNS, OUTSIDE_MOMENTUM)
    steps = relaxation_steps(model)
    return ShownRelaxation(steps, settings.relaxation_momentum, 1, steps, 0.0)


def felt_garment(model: Model) -> tuple[Shown, Array]:
    """Return the garment that feels, and its template [3, V] m."""
    felt, cloth = _forces(model).felt, model.wearer.cloth
    if felt is None:
        return Shown(model.network.shapes, model.network.weights), model.wearer.template
    assert cloth is not None and cloth.template is not None
    return Shown(felt.shapes, felt.weights), cloth.template


def _canonical(model: Model, latent: Array, garment: Shown, template: Array) -> Array:
    """Return a garment [3, V] m in the canonical pose, for a code [C] and its template [3, V] m."""
    weights = blend_weights(model.network, latent, model.config)
    return template + jnp.matmul(weights, garment.shapes, precision=HIGHEST).reshape(3, -1)


def _rows(weights: Array, transforms: Array) -> Array:
    """Return the transforms [3, 4, V] of vertices with weights [J', V], from those [J', 3, 4] of the joints."""
    return jnp.matmul(transforms.reshape(-1, 12).T, weights, precision=HIGHEST).reshape(3, 4, -1)


def _skin(rows: Array, garment: Array) -> Array:
    """Return a garment [3, V] m, moved by the transforms [3, 4, V] of its vertices."""
    x, y, z = (rows[:, i] * garment[None, i] for i in range(3))
    return x + y + z + rows[:, 3]
