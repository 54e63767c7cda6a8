"""Node and edge features of Phi, not yet normalised (METHOD.md, Phi).

Vectors are in the heading frame of the root, or in the canonical pose. Nothing here changes when the scene is moved, or
turned about the vertical. Phi normalises the features by running statistics (`normalisation.py`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from clothjax.body import skinning
from clothjax.config import MaterialConfig, ModelConfig
from clothjax.geometry.vectors import norm
from clothjax.material import material_inputs
from clothjax.physics import contact_search, energies
from clothjax.simulation.characters import Character, Window
from clothjax.simulation.scene import Scene
from clothjax.types import Array, ClothState, Contact

BODY_RADIUS = 0.03  # m, garment and body vertices closer than this are joined


class WorldFeatures(NamedTuple):
    """Features of Q body nodes, and of V pairs: each garment vertex with the body vertex nearest to it."""

    nodes: Array  # [Q, N], a row for every body vertex that may be nearest to some garment vertex
    slots: Array  # [V] int32, the row of `nodes` that each garment vertex is paired with
    active: Array  # [V] bool, whether the pair is close enough to count
    to_garment: Array  # [V, 9] of the edge from the body node to the garment vertex
    to_body: Array  # [V, 9] of the edge in the other direction


class Features(NamedTuple):
    """The features of one time step, as Phi's encoders read them after normalisation."""

    nodes: Array  # [V, N] of the garment
    edges: dict[str, jax.Array]  # [E, M] by edge set: `mesh`, `coarse0`, ...
    world: WorldFeatures | None  # None where there is no body

    def columns(self) -> dict[str, list[Array]]:
        """Return the arrays by what they are normalised with: `nodes`, `mesh` and, where there is a body, `world`.

        All arrays of one name have the same columns and are normalised by the same statistics. They are garment and
        body nodes [V, N] and [Q, N], edges of all edge sets [E, M], and pairs in both directions [V, 9].
        """
        nodes, pairs = [self.nodes], {}
        if self.world is not None:
            nodes.append(self.world.nodes)
            pairs["world"] = [self.world.to_garment, self.world.to_body]
        return {"nodes": nodes, "mesh": list(self.edges.values())} | pairs


def compute(
    scene: Scene,
    character: Character,
    state: ClothState,
    window: Window,
    contact: Contact | None,
    timestep: Array,
    guess: Array,
    force: Array,
    model: ModelConfig,
    material: MaterialConfig,
) -> Features:
    """Compute the inputs of Phi for one step: HOOD's, plus positions and accelerations (METHOD.md, Phi).

    Args:
        contact: planes at the body points nearest to the garment now; None where there is no body.
        timestep: s.
        guess: [V, 3] m, of the next positions: where the descent ends, else where the canonical displacement stays.
        force: [V, 3] N on the garment at `guess`, minus the potential's gradient.
    """
    turn = window.current.heading.T
    inputs = material_inputs(character.material, material)

    def node(velocity, acceleration, normal, position, log_mass, materials):
        shared = [velocity, acceleration, normal, position - window.current.root[None]]
        columns = [_rotate(turn, part) for part in shared]
        count = len(position)
        materials = jnp.broadcast_to(materials[None], (count, *materials.shape))
        return jnp.concatenate([*columns, _column(jnp.asarray(timestep), count), log_mass[:, None], materials], axis=-1)

    garment = node(
        state.velocity,
        state.acceleration,
        skinning.vertex_normals(state.position, scene.garment.faces),
        state.position,
        jnp.log(character.mass),
        inputs,
    )
    edge_points = {"now": state.position}
    extra = jnp.zeros((len(garment), 0), garment.dtype)
    if model.canonical_features:
        extra, drifted = _canonical(character, state, window, contact, guess, force)
        edge_points |= {"guess": guess, "drifted": drifted}
    edges = {
        name: mesh_edges(graph.senders, graph.receivers, edge_points, character.template, turn, timestep, inputs)
        for name, graph in scene.graph.items()
    }
    world = None
    if contact is not None:
        world = _world(state, window, contact, timestep, node, inputs, extra.shape[-1])
    return Features(jnp.concatenate([garment, extra], axis=-1), edges, world)


def _world(
    state: ClothState, window: Window, contact: Contact, timestep: Array, node, inputs: Array, extra: int
) -> WorldFeatures:
    """Compute body node features and garment-body pair features.

    Args:
        node: builds rows of nodes.
        extra: columns of zeros that body rows are padded by.
    """
    bodies = [frame.body for frame in window]
    before, now, following = bodies
    normals, nearest, slots = window.current.normals, contact.index, contact.index
    if len(now) > len(nearest):  # the distinct ones, in slots
        vertices, slots = jnp.unique(nearest, size=len(nearest), fill_value=0, return_inverse=True)
        slots = slots.astype(jnp.int32).reshape(-1)
        before, now, following, normals = (x[vertices] for x in (before, now, following, normals))
    nodes = node(
        now - before, following - 2 * now + before, normals, now, -jnp.ones_like(now[:, 0]), -jnp.ones_like(inputs)
    )
    offset_now = state.position - bodies[1][nearest]
    offset_next = state.position - bodies[2][nearest]
    turn = window.current.heading.T
    to_body, to_garment = world_edges(offset_now, offset_next, turn, timestep)
    return WorldFeatures(
        nodes=jnp.pad(nodes, ((0, 0), (0, extra))),
        slots=slots,
        active=jnp.sum(offset_now * offset_now, axis=-1) <= BODY_RADIUS**2,
        to_garment=to_garment,
        to_body=to_body,
    )


def world_edges(offset_now: Array, offset_next: Array, turn: Array, timestep: Array) -> tuple[Array, Array]:
    """Compute features [V, 9] of the edges between garment vertices and body vertices, in both directions.

    Args:
        offset_now, offset_next: [V, 3] m from the body vertex, at this frame and at the next, to the garment vertex.
        turn: [3, 3] into the frame of the features.
        timestep: s.

    Returns:
        Features of the edges towards the body, and of those towards the garment.
    """

    def one(sign):
        parts = [
            _rotate(turn, sign * offset_now), norm(offset_now, keepdims=True), _rotate(turn, sign * offset_next),
            norm(offset_next, keepdims=True), _column(jnp.asarray(timestep), len(offset_now)),
        ]  # fmt: skip
        return jnp.concatenate(parts, axis=-1)

    return one(1.0), one(-1.0)


def _canonical(
    character: Character, state: ClothState, window: Window, contact: Contact | None, guess: Array, force: Array
):
    """Express the state in the next frame's canonical pose, [V, 22], or [V, 15] without a body; also return `drifted`.

    `guess` is that of `compute`, `drifted` [V, 3] m keeps the velocity. The next position lies, roughly,
    between these two guesses, and contact is measured from both. The force at `guess` is divided by the weight of the
    vertex and compressed, since it spans five decades.
    """
    following = window.following.garment
    displacement = skinning.unapply(window.current.garment, state.position) - character.template
    drifted = state.position + state.velocity
    down = jnp.zeros_like(drifted).at[:, 1].set(-1.0)
    pull = force / (energies.GRAVITY * character.mass[:, None])
    size = norm(pull, keepdims=True)
    pull = pull * jnp.where(size > 1e-6, jnp.arcsinh(size) / jnp.maximum(size, 1e-6), 1.0)
    columns = [
        displacement,
        skinning.unapply_direction(following, pull),
        skinning.unapply(following, drifted) - character.template,
        skinning.unapply_direction(following, down),
    ]
    if contact is not None:
        columns.append(skinning.unapply_direction(following, contact.normal_next))
    columns.append(character.template)
    if contact is not None:
        gaps = [contact_search.distance(x, contact.point_next, contact.normal_next)[:, None] for x in (guess, drifted)]
        columns += [jnp.clip(gap, -0.05, 0.05) for gap in gaps]
        columns += [jnp.maximum(0.003 - gap, 0.0) for gap in gaps]
    return jnp.concatenate(columns, axis=-1), drifted


def mesh_edges(senders, receivers, points, template, turn, timestep, inputs) -> jax.Array:
    """Compute features [E, M] of edges: relative positions now and at rest, the strain of each guess, and the material.

    Args:
        senders, receivers: [E] vertex indices.
        points: [V, 3] m by name: `now`, and the guesses `guess` and `drifted` where there are any.
        template: [V, 3] m, at rest.
        turn: [3, 3] into the frame of the features.
        timestep: s.
        inputs: [3] the material, or [0].
    """
    rest = template[senders] - template[receivers]
    rest_length = norm(rest, keepdims=True)
    now = points["now"][senders] - points["now"][receivers]
    columns = [_rotate(turn, now), norm(now, keepdims=True), rest, rest_length]
    for name in ("guess", "drifted"):
        if name in points:
            vector = points[name][senders] - points[name][receivers]
            columns.append(norm(vector, keepdims=True) / rest_length - 1.0)
    columns += [
        _column(jnp.asarray(timestep), len(senders)),
        jnp.broadcast_to(inputs[None], (len(senders), *inputs.shape)),
    ]
    return jnp.concatenate(columns, axis=-1)


def _rotate(turn: Array, vectors: Array) -> Array:
    return jnp.einsum("ab,nb->na", turn, vectors, precision="highest")


def _column(scalar: Array, count: int) -> Array:
    return jnp.broadcast_to(scalar.reshape(1, 1), (count, 1))
