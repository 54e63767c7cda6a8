"""Encoder MLPs and message-passing blocks on several edge sets (HOOD; Pfaff et al. 2021)."""

from collections.abc import Mapping
from dataclasses import field
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
import numpy as np
from jax.ad_checkpoint import checkpoint_name

from clothjax.config import ModelConfig, Stack
from clothjax.networks import normalisation
from clothjax.networks.graph_features import Features
from clothjax.networks.mlp import MLP
from clothjax.types import Array

ARRIVED = "arrived"  # messages summed at their receivers, which the backward pass keeps
TYPES, LEVELS = (4, 9), (8, 4)  # rows and columns of the embeddings of node types and levels
Graphs = Mapping[str, jraph.GraphsTuple]  # edge sets, sorted by receiver


class World(NamedTuple):
    """Latents of Q body nodes beside a garment, and of V pairs: a garment vertex with the node nearest to it."""

    nodes: Array  # [Q, W] latents of the body nodes
    slots: Array  # [V] int32, the body node of each garment vertex
    active: Array  # [V] bool, the pairs that pass messages
    pairs: dict[str, jax.Array]  # latents [V, W]: `to_garment`, and `to_body` if body nodes are to be updated


class Latents(NamedTuple):
    """The latents, W numbers a row, that pass from block to block."""

    nodes: Array  # [V, W] of the garment
    body: Array | None  # [Q, W] of the body; None where there is no body
    edges: dict[str, Array]  # [E, W] by edge set
    pairs: dict[str, Array]  # [R, W] of the vertices in reach, as in `World`


# --- message passing ----------------------------------------------------------------------------------------------


class Block(nn.Module):
    """One residual message-passing block (METHOD.md, Graph network), on edge sets and pairs with the body.

    The first layer of each MLP multiplies node rows before these are gathered: there are fewer nodes than edges.
    """

    width: int
    layers: int
    graphs: Graphs = field(repr=False)  # among the vertices in reach
    rows: np.ndarray | None = field(repr=False)  # [R] the vertices in reach; None: all
    body: bool = True
    in_chunks: bool = False  # MLPs run over some rows at a time and are recomputed in the backward pass

    def setup(self):
        names = sorted((*self.graphs, "world") if self.body else self.graphs)
        hidden = (self.width,) * self.layers
        self.edge = {name: MLP((3 * self.width, *hidden)) for name in names}
        self.node = MLP(((1 + len(names)) * self.width, *hidden))

    def __call__(self, latents: Latents, slots: Array | None, active: Array | None) -> tuple[Latents, None]:
        """Return the latents after the block, and None, as a scan needs it.

        Args:
            latents: before the block.
            slots, active: [R] as in `World`, of the R vertices in reach.
        """
        nodes, body, edges, pairs = latents
        here, new_body = self._reached(nodes), body
        arrived, new_edges, new_pairs = {}, {}, {}
        for name, graph in self.graphs.items():
            message = self._message(name, here, here, edges[name], graph.receivers, graph.senders)
            arrived[name] = _sum_at(graph.receivers, message, len(here), indices_are_sorted=True)
            new_edges[name] = edges[name] + message
        if body is not None and slots is not None and active is not None:
            message = self._message("world", here, body, pairs["to_garment"], None, slots)
            arrived["world"] = jnp.where(active[:, None], message, 0.0)
            new_pairs["to_garment"] = pairs["to_garment"] + arrived["world"]
            if "to_body" in pairs:
                message = self._message("world", body, here, pairs["to_body"], slots, None)
                back = jnp.where(active[:, None], message, 0.0)
                new_pairs["to_body"] = pairs["to_body"] + back
                new_body = body + self._updated(body, _sum_at(slots, back, len(body)), None)
        everything = checkpoint_name(jnp.concatenate([arrived[name] for name in sorted(arrived)], axis=-1), ARRIVED)
        return Latents(nodes + self._updated(nodes, everything, self.rows), new_body, new_edges, new_pairs), None

    @nn.nowrap
    def _reached(self, rows: Array) -> Array:
        return rows if self.rows is None else rows[self.rows]

    @nn.nowrap
    def _updated(self, nodes: Array, arrived: Array, rows: np.ndarray | None) -> Array:
        """Compute MLP([node, 0, arrived]), with the messages that arrived at some rows as the last inputs."""
        first = self.node.dense[0]
        own = first.product(nodes) + first.bias[None]
        added = first.product(arrived, begin=first.inputs - arrived.shape[-1])
        return self.node.tail(own + added if rows is None else own.at[rows].add(added), self.in_chunks)

    @nn.nowrap
    def _message(self, name: str, targets, sources, latent, target_index, source_index) -> Array:
        """Compute MLP([target, source, edge]); the node parts of its first layer are multiplied before the gather."""
        mlp, width = self.edge[name], self.width
        first = mlp.dense[0]
        target, source = first.product(targets), first.product(sources, begin=width)
        target = target if target_index is None else target[target_index]
        source = source if source_index is None else source[source_index]
        return mlp.tail(target + source + first.product(latent, begin=2 * width) + first.bias[None], self.in_chunks)


def _sum_at(index: Any, rows: Any, count: int, indices_are_sorted: bool = False) -> jax.Array:
    """Sum rows [E, W] that have the same index [E], to [count, W]."""
    return jraph.segment_sum(rows, index, count, indices_are_sorted)


class Processor(nn.Module):
    """The step Process of Phi: stacks of message-passing blocks, one after the other, on node latents [V, W].

    All blocks of a stack have the same edge sets. They run as a scan, so their parameters have a leading axis of
    blocks. In a stack without `mesh`, only the vertices of its coarse levels exchange messages, with one another and
    with the body. The other vertices go through the node MLP alone.
    """

    stacks: tuple[Stack, ...]
    width: int
    layers: int
    level: np.ndarray = field(repr=False)  # [V] the deepest coarse level of a vertex, plus one; 0 for none
    remat: bool = False  # recompute blocks in the backward pass
    block: type[nn.Module] = Block

    @nn.compact
    def __call__(self, nodes: Array, graphs: Graphs, world: World | None) -> Array:
        """Return garment node latents [V, W] after all blocks.

        Args:
            nodes: [V, W] of the garment.
            graphs: edge sets with their latents [E, W]; senders and receivers are on the host.
            world: None where there is no body.
        """
        block = self.block
        if self.remat:
            policy = jax.checkpoint_policies.save_only_these_names(ARRIVED)
            block = nn.remat(block, prevent_cse=False, policy=policy)
        edges: dict[str, Any] = {name: graph.edges for name, graph in graphs.items()}
        body, pairs = (None, {}) if world is None else (world.nodes, world.pairs)
        for index, stack in enumerate(self.stacks):
            rows, among = reached(stack, graphs, self.level)
            here = slice(None) if rows is None else rows
            scanned = nn.scan(
                block,
                variable_axes={"params": 0},
                split_rngs={"params": True},
                in_axes=nn.broadcast,  # pyright: ignore[reportArgumentType]  # flax's annotation has integers alone
                length=stack.blocks,
            )
            blocks = scanned(
                self.width, self.layers, among, rows, world is not None,
                self.remat and jax.default_backend() == "cpu", name=str(index),
            )  # fmt: skip
            latents = Latents(
                nodes, body, {name: edges[name] for name in stack.edges}, {k: x[here] for k, x in pairs.items()}
            )
            slots, active = (None, None) if world is None else (world.slots[here], world.active[here])
            (nodes, body, updated, near), _ = blocks(latents, slots, active)
            edges = edges | updated
            pairs = {name: x.at[here].set(near[name]) for name, x in pairs.items()}
        return nodes


def reached(stack: Stack, graphs: Graphs, level: np.ndarray) -> tuple[np.ndarray | None, Graphs]:
    """Find the R vertices in reach of a stack: those that have edges in it.

    Args:
        level: [V], as of `Processor`.

    Returns:
        Their indices [R], None for all vertices; and the edge sets, whose senders and receivers count these vertices.
    """
    among = {name: graphs[name]._replace(edges=None) for name in stack.edges}
    if stack.lowest_level == 0:
        return None, among
    within = np.asarray(level) >= stack.lowest_level
    number = np.cumsum(within, dtype=np.int32) - 1
    count = np.array([within.sum()], np.int32)
    return np.flatnonzero(within), {
        name: graph._replace(senders=number[graph.senders], receivers=number[graph.receivers], n_node=count)
        for name, graph in among.items()
    }


class Encoder(nn.Module):
    """The step Encode of Phi: an MLP for each kind of rows, from features [N, columns] to latents [N, W].

    A kind is a key of the argument: `nodes`, an edge set such as `mesh`, or `world`.
    """

    width: int
    layers: int

    @nn.compact
    def __call__(self, rows: dict[str, Any]) -> dict[str, Any]:
        """Return the argument with latents [N, W] in place of rows [N, columns].

        A kind may have several arrays, such as the nodes of garment and body; they go through the same MLP.
        """
        hidden = (self.width,) * self.layers
        latents = {}
        for name, parts in rows.items():
            mlp = MLP((jax.tree.leaves(parts)[0].shape[-1], *hidden), name=name)
            latents[name] = jax.tree.map(mlp, parts)
        return latents


class MessagePassing(nn.Module):
    """Encode and Process (METHOD.md, Phi): from features to the node latents [V, W] of a garment.

    The collection `statistics` has running statistics of the features; `phi.observe` updates them.
    """

    config: ModelConfig
    graphs: Graphs = field(repr=False)  # of the garment, without latents
    level: np.ndarray = field(repr=False)  # [V] int32, as in `Processor`
    pinned: np.ndarray = field(repr=False)  # [V] bool
    block: type[nn.Module] = Block

    @nn.compact
    def __call__(self, seen: Features) -> Array:
        """Return the node latents [V, W] of the garment."""
        config, world = self.config, seen.world
        type_embedding = self.param("type_embedding", nn.initializers.normal(1.0), TYPES)
        level_embedding = self.param("level_embedding", nn.initializers.normal(1.0), LEVELS)
        columns = {name: parts[0].shape[-1] for name, parts in seen.columns().items()}
        statistics = {
            name: self.variable("statistics", name, normalisation.empty_statistics, count).value
            for name, count in columns.items()
        }

        def scaled(name: str, rows: Array) -> Array:
            return normalisation.standardise(statistics[name], rows)

        def nodes(rows: Array, kind: Array, level: Array) -> Array:
            embedded = jnp.concatenate([type_embedding[kind], level_embedding[level]], axis=-1)
            return jnp.concatenate([scaled("nodes", rows), embedded], axis=-1)

        rows: dict[str, Any] = {
            "nodes": {"garment": nodes(seen.nodes, 3 * np.asarray(self.pinned, np.int32), jnp.asarray(self.level))}
        }
        rows |= {name: scaled("mesh", x) for name, x in seen.edges.items()}
        if world is not None:
            ones = jnp.ones(len(world.nodes), jnp.int32)
            rows["nodes"]["body"] = nodes(world.nodes, ones, 0 * ones)
            rows["world"] = {"to_garment": scaled("world", world.to_garment)}
            if config.body_nodes == "updated":
                rows["world"]["to_body"] = scaled("world", world.to_body)
        latents = Encoder(config.width, config.mlp_layers, name="encoder")(rows)
        body = None
        if world is not None:
            body = World(latents["nodes"]["body"], world.slots, world.active, latents["world"])
        graphs = {name: graph._replace(edges=latents[name]) for name, graph in self.graphs.items()}
        processor = Processor(
            config.processor, config.width, config.mlp_layers, self.level, config.remat, self.block, name="processor"
        )
        return processor(latents["nodes"]["garment"], graphs, body)
