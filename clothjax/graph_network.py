"""Encoder MLPs and message-passing blocks on several edge sets (HOOD; Pfaff et al. 2021)."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph
import numpy as np
from jax.ad_checkpoint import checkpoint_name

from clothjax.config import Stack
from clothjax.types import Array, EdgeSet

Params = dict
ARRIVED = "arrived"  # messages summed at their receivers, which the backward pass keeps
CHUNK = 1024  # rows of an MLP at a time, where a CPU recomputes it: its layers then stay in the cache


# --- multilayer perceptrons ---------------------------------------------------------------------------------------


def init_dense(key: Array, inputs: int, outputs: int, gain: float = 2.0) -> Params:
    """A dense layer with kernel variance gain / inputs and zero bias; the gain 2 suits a ReLU behind it."""
    kernel = nn.initializers.variance_scaling(gain, "fan_in", "truncated_normal")
    return nn.Dense(outputs, kernel_init=kernel).init(key, jnp.zeros((1, inputs)))["params"]


def dense(params: Params, x: Array) -> Array:
    """A dense layer on [..., inputs]."""
    bias = params["bias"]
    return _times(x, params["kernel"]) + bias.reshape((1,) * (x.ndim - 1) + bias.shape)


def _times(x: Array, kernel: Array) -> Array:
    """x [..., inputs] times a kernel [inputs, outputs]; where that is in bfloat16, so is the product."""
    if kernel.dtype == jnp.bfloat16:
        return (x.astype(jnp.bfloat16) @ kernel).astype(x.dtype)
    return x @ kernel


def in_bfloat16(params: Params) -> Params:
    """The same layers with their kernels in bfloat16, so that products are, and the gradients of these."""

    def rounded(path, leaf):
        return leaf.astype(jnp.bfloat16) if path[-1] == jax.tree_util.DictKey("kernel") else leaf

    return jax.tree_util.tree_map_with_path(rounded, params)


def init_mlp(key: Array, sizes: tuple[int, ...], norm: bool = True, last_gain: float = 1.0) -> Params:
    """An MLP through `sizes`, ReLU between the layers, with a LayerNorm at the end if `norm`."""
    keys = jax.random.split(key, len(sizes) - 1)
    last = len(sizes) - 2
    params = {
        f"dense_{i}": init_dense(keys[i], sizes[i], sizes[i + 1], last_gain if i == last else 2.0)
        for i in range(len(sizes) - 1)
    }
    if norm:
        params["norm"] = {"scale": jnp.ones(sizes[-1]), "bias": jnp.zeros(sizes[-1])}
    return params


def mlp(params: Params, x: Array) -> Array:
    """The MLP of `init_mlp` on [N, inputs], or without a LayerNorm on [..., inputs]."""
    return _mlp_tail(params, dense(params["dense_0"], x))


def _mlp_tail(params: Params, first: Array) -> Array:
    """An MLP from the pre-activation of its first layer."""
    x, layers = first, sum(name.startswith("dense") for name in params)
    for i in range(1, layers):
        x = dense(params[f"dense_{i}"], nn.relu(x))
    if "norm" not in params:
        return x
    return _affine(jax.nn.standardize(x, epsilon=1e-5), params["norm"]["scale"], params["norm"]["bias"])


def _mlp_tail_in_chunks(params: Params, first: Array) -> Array:
    """`_mlp_tail`, some rows at a time, that keeps nothing but `first` for the backward pass."""
    count, width = first.shape
    chunks = -(-count // CHUNK)
    rows = -(-count // chunks)
    parts = jnp.pad(first, ((0, chunks * rows - count), (0, 0))).reshape(chunks, rows, width)
    done = jax.lax.map(jax.checkpoint(partial(_mlp_tail, params), prevent_cse=False), parts)
    return done.reshape(chunks * rows, -1)[:count]


@jax.custom_vjp
def _affine(x: Array, scale: Array, bias: Array) -> Array:
    """x [N, W] times scale [W] plus bias [W]. Its gradient sums rows by a product: XLA's own sum took an eighth of a
    training step on a CPU. A custom rule for the backward pass: there is no forward-mode derivative of it."""
    return x * scale[None] + bias[None]


def _affine_forward(x, scale, bias):
    return _affine(x, scale, bias), (x, scale)


def _affine_backward(kept, gradient):
    x, scale = kept

    def row_sum(rows):
        return jnp.matmul(jnp.ones((1, len(rows)), rows.dtype), rows, precision="highest")[0]

    return gradient * scale[None], row_sum(gradient * x), row_sum(gradient)


_affine.defvjp(_affine_forward, _affine_backward)


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
    tail = _mlp_tail_in_chunks if remat and jax.default_backend() == "cpu" else _mlp_tail
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
    own = _times(nodes, kernel[: nodes.shape[-1]]) + bias[None]
    return tail(params, own.at[rows].add(_times(arrived, kernel[-arrived.shape[-1] :])))


def _message(params, targets, sources, latent, target_index, source_index, tail):
    """MLP([target, source, edge]) with the node parts of its first layer multiplied before the gather."""
    width = latent.shape[-1]
    kernel, bias = params["dense_0"]["kernel"], params["dense_0"]["bias"]
    target, source = _times(targets, kernel[:width]), _times(sources, kernel[width : 2 * width])
    target = target if target_index is None else target[target_index]
    source = source if source_index is None else source[source_index]
    return tail(params, target + source + _times(latent, kernel[2 * width :]) + bias[None])
