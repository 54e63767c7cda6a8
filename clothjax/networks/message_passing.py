"""Encoder MLPs and message-passing blocks on several edge sets (HOOD; Pfaff et al. 2021)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jraph
import numpy as np
from jax.ad_checkpoint import checkpoint_name

from clothjax.config import Stack
from clothjax.networks.mlp import Params, init_mlp, mlp_tail, mlp_tail_in_chunks, times
from clothjax.types import Array, EdgeSet

ARRIVED = "arrived"  # messages summed at their receivers, which the backward pass keeps


# --- message passing ----------------------------------------------------------------------------------------------


def init_processor(key: Array, stacks: tuple[Stack, ...], width: int, layers: int, body: bool = True) -> list[Params]:
    """Parameters of each stack of blocks, stacked along a leading axis so that depth is a scan."""
    hidden = (width,) * layers

    def block(key: Array, edges: tuple[str, ...]) -> Params:
        names = sorted((*edges, "world") if body else edges)
        keys = jax.random.split(key, len(names) + 1)
        params = {f"edge_{name}": init_mlp(k, (3 * width, *hidden)) for name, k in zip(names, keys[1:])}
        params["node"] = init_mlp(keys[0], ((1 + len(names)) * width, *hidden))
        return params

    keys = jax.random.split(key, len(stacks))
    return [
        jax.vmap(lambda k, s=stack: block(k, s.edges))(jax.random.split(key, stack.blocks))
        for stack, key in zip(stacks, keys)
    ]


class World(NamedTuple):
    """The body beside a garment, and the pairs of a garment vertex with the body node nearest to it."""

    nodes: Array  # [S, W] latents of the body nodes
    slots: Array  # [V] int32, the body node of each garment vertex
    active: Array  # [V] bool, the pairs that pass messages
    pairs: dict[str, Array]  # latents [V, W]: `to_garment`, and `to_body` if body nodes are to be updated


def process(
    params: list[Params],
    stacks: tuple[Stack, ...],
    nodes: Array,
    edges: dict[str, Array],
    world: World | None,
    graph: dict[str, EdgeSet],
    level: np.ndarray,
    *,
    remat: bool,
) -> Array:
    """Garment node latents [V, W] after all message-passing blocks.

    In a stack without the fine mesh only the vertices of its coarse levels send and receive, from the body too; the
    others go through the node MLP alone.

    Args:
        params: of `init_processor`.
        nodes: [V, W] of the garment.
        edges: latents [E, W] by edge set, on `graph`.
        world: None where there is no body.
        level: [V] the deepest coarse level of a vertex, plus one; 0 for none.
    """
    body, pairs = (None, {}) if world is None else (world.nodes, world.pairs)
    tail = mlp_tail_in_chunks if remat and jax.default_backend() == "cpu" else mlp_tail
    for stack, stacked in zip(stacks, params):
        rows, among = _reached(stack, graph, level)
        slots, active = (None, None) if world is None else (world.slots[rows], world.active[rows])

        def block(carry, p, rows=rows, among=among, slots=slots, active=active):
            return _block(p, *carry, rows, among, slots, active, tail), None

        if remat:
            block = jax.checkpoint(
                block, prevent_cse=False, policy=jax.checkpoint_policies.save_only_these_names(ARRIVED)
            )
        carry = (nodes, body, {name: edges[name] for name in stack.edges}, {k: x[rows] for k, x in pairs.items()})
        (nodes, body, updated, near), _ = jax.lax.scan(block, carry, stacked)
        edges = edges | updated
        pairs = {name: x.at[rows].set(near[name]) for name, x in pairs.items()}
    return nodes


def _reached(stack: Stack, graph: dict[str, EdgeSet], level: np.ndarray) -> tuple[Any, dict[str, EdgeSet]]:
    """Which vertices have edges in a stack, and its edges, numbered among these."""
    if stack.lowest_level == 0:
        return slice(None), {name: graph[name] for name in stack.edges}
    reached = np.asarray(level) >= stack.lowest_level
    number = np.cumsum(reached, dtype=np.int32) - 1
    return np.flatnonzero(reached), {name: EdgeSet(*(number[ends] for ends in graph[name])) for name in stack.edges}


def _block(params, nodes, body, edges, pairs, rows, graph, slots, active, tail):
    """One residual block. First layers are applied before what they read is gathered or put side by side.

    Args:
        tail: the other layers of an MLP, `_mlp_tail` in one of its forms.
    """
    here, new_body = nodes[rows], body
    arrived, new_edges, new_pairs = {}, {}, {}
    for name, latent in edges.items():
        senders, receivers = graph[name]
        message = _message(params[f"edge_{name}"], here, here, latent, receivers, senders, tail)
        arrived[name] = jraph.segment_sum(message, receivers, len(here), indices_are_sorted=True)
        new_edges[name] = latent + message
    if "to_garment" in pairs:
        message = _message(params["edge_world"], here, body, pairs["to_garment"], None, slots, tail)
        arrived["world"] = jnp.where(active[:, None], message, 0.0)
        new_pairs["to_garment"] = pairs["to_garment"] + arrived["world"]
    if "to_body" in pairs:
        message = _message(params["edge_world"], body, here, pairs["to_body"], slots, None, tail)
        back = jnp.where(active[:, None], message, 0.0)
        new_pairs["to_body"] = pairs["to_body"] + back
        at_body = jraph.segment_sum(back, slots, len(body))
        new_body = body + _node_update(params["node"], body, slice(None), at_body, tail)
    everything = checkpoint_name(jnp.concatenate([arrived[name] for name in sorted(arrived)], axis=-1), ARRIVED)
    return nodes + _node_update(params["node"], nodes, rows, everything, tail), new_body, new_edges, new_pairs


def _node_update(params: Params, nodes: Array, rows: Any, arrived: Array, tail: Callable) -> Array:
    """MLP([node, 0, arrived]) with the messages that arrived at some rows, as the last of its inputs."""
    kernel, bias = params["dense_0"]["kernel"], params["dense_0"]["bias"]
    own = times(nodes, kernel[: nodes.shape[-1]]) + bias[None]
    return tail(params, own.at[rows].add(times(arrived, kernel[-arrived.shape[-1] :])))


def _message(params, targets, sources, latent, target_index, source_index, tail):
    """MLP([target, source, edge]) with the node parts of its first layer multiplied before the gather."""
    width = latent.shape[-1]
    kernel, bias = params["dense_0"]["kernel"], params["dense_0"]["bias"]
    target, source = times(targets, kernel[:width]), times(sources, kernel[width : 2 * width])
    target = target if target_index is None else target[target_index]
    source = source if source_index is None else source[source_index]
    return tail(params, target + source + times(latent, kernel[2 * width :]) + bias[None])
