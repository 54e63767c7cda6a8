"""HOOD (Grigorev et al. 2023), as published, of the parts that Phi is made of: what shows, against the values of HOOD's
own code, that they are right.

It predicts an acceleration of every vertex where Phi predicts a code; there is no rig in it, only positions.
"""

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
import numpy as np

from clothjax.body import skinning
from clothjax.config import Stack
from clothjax.geometry import proximity
from clothjax.networks import graph_features, normalisation
from clothjax.networks.message_passing import Encoder, Processor, World
from clothjax.networks.mlp import MLP, Params
from clothjax.networks.normalisation import Statistics
from clothjax.types import Array

NORMAL, BODY, OMITTED, PINNED = range(4)  # rows of the type embedding; the others are not used
TYPES, LEVELS = (9, 9), (4, 4)  # rows and columns of the embeddings
NODE, EDGE, WORLD = 24, 12, 9  # columns
MATERIALS = 3  # the last of nodes and edges, not normalised
LEAST = 1e-8  # standard deviation
RADIUS = 0.03  # m
SCHEDULE = (
    Stack(("mesh", "coarse0"), 3),
    Stack(("coarse0", "coarse1"), 3),
    Stack(("coarse1",), 3),
    Stack(("coarse0", "coarse1"), 3),
    Stack(("mesh", "coarse0"), 3),
)


class Cloth(NamedTuple):
    """What HOOD knows of a garment and of the body under it."""

    rest: Array  # [V, 3] m
    faces: Array  # [F, 3] int32
    mass: Array  # [V] kg
    materials: Array  # [3] bending, mu and lambda, scaled to [0, 1]
    pinned: Array  # [V] bool
    graph: dict[str, jraph.GraphsTuple]  # `mesh`, `coarse0`, `coarse1`, and `coarse2`, which only the statistics see
    level: Array  # [V] int32, the deepest coarse level of a vertex, plus one; 0 for none
    body_faces: Array  # [Fb, 3] int32
    omitted: Array  # [B] bool, body vertices that touch nothing: hands


class State(NamedTuple):
    """A garment in motion."""

    previous: Array  # [V, 3] m
    position: Array  # [V, 3] m
    velocity: Array  # [V, 3] m per frame; 0 at pinned vertices, which are taken to have arrived


class Step(NamedTuple):
    """What one step predicted."""

    acceleration: Array  # [V, 3] m per frame^2
    output: Array  # [V, 3] of the decoder, before it is scaled
    active: Array  # [V] bool, garment vertices that the body is close to
    slots: Array  # [V] int32, their places among `vertices`
    vertices: Array  # [V] int32, of the body


class Network(nn.Module):
    """HOOD's encoders, message passing and decoder, at the published sizes.

    Not there is the encoder of `coarse2`, which nothing would read.
    """

    level: np.ndarray
    width: int = 128

    def setup(self):
        self.type_embedding = self.param("type_embedding", nn.initializers.normal(1.0), TYPES)
        self.level_embedding = self.param("level_embedding", nn.initializers.normal(1.0), LEVELS)
        self.encoder = Encoder(self.width, 3)
        self.processor = Processor(SCHEDULE, self.width, 3, self.level)
        self.decoder = MLP((self.width, self.width, self.width, 3), norm=False)

    def embed(self, kinds: Array, levels: Array) -> list[Array]:
        """Embeddings [N, 9] and [N, 4] of node types [N] and levels [N]."""
        return [self.type_embedding[kinds], self.level_embedding[levels]]

    def __call__(self, nodes: Array, edges: dict[str, Array], world: Array, slots, active, graph) -> Array:
        """The output [V, 3] of normalised features of nodes, edges and pairs, those of the garment before the body's
        and those towards the body before those towards the garment."""
        count = len(self.level)
        rows = self.encoder({"nodes": nodes, "world": world, **edges})
        nodes, world = rows["nodes"], rows["world"]
        graphs = {name: graph[name]._replace(edges=rows[name]) for name in edges}
        pairs = {"to_body": world[:count], "to_garment": world[count:]}
        return self.decoder(self.processor(nodes[:count], graphs, World(nodes[count:], slots, active, pairs)))


def init_statistics() -> dict[str, Statistics]:
    """Statistics of nothing yet, of the columns that are normalised."""
    columns = {"nodes": NODE - MATERIALS, "mesh": EDGE - MATERIALS, "world": WORLD, "output": 3}
    return {name: Statistics(*(jnp.zeros(n) for n in (count, count, ()))) for name, count in columns.items()}


def step(
    params: Params,
    statistics: dict[str, Statistics],
    cloth: Cloth,
    state: State,
    bodies: Array,
    target: Array,
    timestep: Array,
    *,
    training: bool,
) -> tuple[State, dict[str, Statistics], Step]:
    """One step of HOOD: the next state, the statistics with this step in them, and what it predicted.

    Args:
        bodies: [3, B, 3] m at the previous, this and the next frame.
        target: [V, 3] m where skinning would put the garment next. Pinned vertices go there.
        timestep: s.
        training: collect statistics; otherwise they are only used.
    """
    network = Network(cloth.level, params["decoder"]["dense_0"]["bias"].shape[0])
    fixed = cloth.pinned[:, None]
    previous, position = jnp.where(fixed, state.position, state.previous), jnp.where(fixed, target, state.position)
    before, now, following = bodies
    index = proximity.nearest_point(position, now)
    count = len(position)
    vertices, slots = jnp.unique(index, size=count, fill_value=0, return_inverse=True)
    slots = slots.astype(jnp.int32).reshape(-1)
    offset = position - now[index]
    active = (jnp.sum(offset * offset, axis=-1) <= RADIUS**2) & ~cloth.omitted[index]
    active_body = jnp.zeros(count, jnp.int32).at[slots].max(active.astype(jnp.int32)) > 0
    used = dict(statistics)

    def normalised(name, rows, counted=None):
        """By statistics that know these rows already, if this is training."""
        columns = used[name].mean.shape[0]
        if training:
            used[name] = normalisation.observe(used[name], jax.lax.stop_gradient(rows[:, :columns]), counted)
        scaled = normalisation.standardise(used[name], rows[:, :columns], bound=jnp.inf, least=LEAST)
        return jnp.concatenate([scaled, rows[:, columns:]], axis=-1)

    def node(velocity, kinds, levels, normal, log_mass, materials):
        dt = jnp.broadcast_to(jnp.reshape(timestep, (1, 1)), (count, 1))
        embedded = network.apply({"params": params}, kinds, levels, method="embed")
        return jnp.concatenate([velocity, *embedded, normal, dt, log_mass[:, None], materials], axis=-1)

    ones = jnp.ones_like(position[:, :1])
    garment_rows = node(
        jnp.where(fixed, 0.0, state.velocity),
        jnp.where(cloth.pinned, PINNED, NORMAL),
        cloth.level,
        skinning.vertex_normals(position, cloth.faces),
        jnp.log(cloth.mass),
        cloth.materials[None] * ones,
    )
    body_rows = node(
        (now - before)[vertices],
        jnp.full(count, BODY),
        jnp.zeros_like(slots),
        skinning.vertex_normals(now, cloth.body_faces)[vertices],
        -ones[:, 0],
        -jnp.ones_like(cloth.materials)[None] * ones,
    )
    nodes = normalised(
        "nodes", jnp.concatenate([garment_rows, body_rows]), jnp.concatenate([jnp.ones_like(active), active_body])
    )
    level_frame = jnp.eye(3, dtype=position.dtype)
    edges = {}
    for name in ("mesh", "coarse0", "coarse1", "coarse2"):  # in this order, which the statistics see
        graph = cloth.graph[name]
        rows = graph_features.mesh_edges(
            graph.senders, graph.receivers, {"now": position}, cloth.rest, level_frame, timestep, cloth.materials
        )
        edges[name] = normalised("mesh", rows)
    del edges["coarse2"]
    to_body, to_garment = graph_features.world_edges(offset, position - following[index], level_frame, timestep)
    world = normalised("world", jnp.concatenate([to_body, to_garment]), jnp.concatenate([active, active]))

    output = network.apply({"params": params}, nodes, edges, world, slots, active, cloth.graph)
    scale = used["output"]
    acceleration = output * jnp.sqrt(jnp.maximum(scale.variance, LEAST**2))[None] + scale.mean[None]
    if training:
        used["output"] = normalisation.observe(scale, jax.lax.stop_gradient(target - 2.0 * position + previous))
    velocity = jnp.where(fixed, 0.0, state.velocity + acceleration)  # pinned vertices are at their target already
    return State(position, position + velocity, velocity), used, Step(acceleration, output, active, slots, vertices)
