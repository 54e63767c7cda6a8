"""Encoder MLPs and message-passing blocks on several edge sets (HOOD; Pfaff et al. 2021)."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import jraph

from clothjax.config import Stack
from clothjax.types import Array, EdgeSet

Params = dict


# --- multilayer perceptrons ---------------------------------------------------------------------------------------


def init_dense(key: Array, inputs: int, outputs: int, gain: float = 2.0) -> Params:
    """A dense layer with kernel variance gain / inputs and zero bias; the gain 2 suits a ReLU behind it."""
    kernel = nn.initializers.variance_scaling(gain, "fan_in", "truncated_normal")
    return nn.Dense(outputs, kernel_init=kernel).init(key, jnp.zeros((1, inputs)))["params"]


def dense(params: Params, x: Array) -> Array:
    """A dense layer on [..., inputs]."""
    return nn.Dense(params["kernel"].shape[-1]).apply({"params": params}, x)


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


def init_processor(key: Array, stacks: tuple[Stack, ...], width: int, layers: int) -> list[Params]:
    """Parameters of each stack of blocks, stacked along a leading axis so that depth is a scan."""
    hidden = (width,) * layers

    def block(key: Array, edges: tuple[str, ...]) -> Params:
        names = sorted((*edges, "world"))
        keys = jax.random.split(key, len(names) + 1)
        params = {f"edge_{name}": init_mlp(k, (3 * width, *hidden)) for name, k in zip(names, keys[1:])}
        params["node"] = init_mlp(keys[0], ((1 + len(names)) * width, *hidden))
        return params

    keys = jax.random.split(key, len(stacks))
    return [
        jax.vmap(lambda k, s=stack: block(k, s.edges))(jax.random.split(key, stack.blocks))
        for stack, key in zip(stacks, keys)
    ]


def process(
    params: list[Params],
    stacks: tuple[Stack, ...],
    nodes: Array,
    body: Array,
    edges: dict[str, Array],
    world: dict[str, Array],
    graph: dict[str, EdgeSet],
    slots: Array,
    active: dict[str, Array],
    *,
    update_body: bool,
    remat: bool,
) -> Array:
    """Garment node latents [V, W] after all message-passing blocks.

    Args:
        params: of `init_processor`.
        nodes: [V, W] garment, body: [V, W] latents of body nodes, one slot each.
        edges: latents [E, W] by edge set, on `graph`.
        world: latents [V, W] of the pairs (garment vertex i, body slot slots[i]): `to_garment`, and `to_body` if
            body nodes are updated.
        active: [V] bool by stack (its index as a string): the pairs that pass messages in it.
    """
    for index, (stack, stacked) in enumerate(zip(stacks, params)):
        mask = active[str(index)]

        def block(carry, p, stack=stack, mask=mask):
            nodes, body, edges, world = carry
            nodes, body, updated, world = _block(
                p, nodes, body, {k: edges[k] for k in stack.edges}, world, graph, slots, mask, update_body
            )
            return (nodes, body, edges | updated, world), None

        if remat:
            block = jax.checkpoint(block, prevent_cse=False)
        (nodes, body, edges, world), _ = jax.lax.scan(block, (nodes, body, edges, world), stacked)
    return nodes


def _block(params, nodes, body, edges, world, graph, slots, mask, update_body):
    """One residual block. The first layer of each message MLP is applied to nodes before they are gathered."""
    count, width = nodes.shape
    received = {}
    updated = {}
    for name, latent in edges.items():
        senders, receivers = graph[name]
        message = _message(params[f"edge_{name}"], nodes, nodes, latent, receivers, senders)
        received[name] = jraph.segment_sum(message, receivers, count, indices_are_sorted=True)
        updated[name] = latent + message
    pairs = params["edge_world"]
    keep = mask[:, None]
    message = _message(pairs, nodes, body, world["to_garment"], None, slots)
    received["world"] = jnp.where(keep, message, 0.0)
    new_world = {"to_garment": jnp.where(keep, world["to_garment"] + message, world["to_garment"])}
    new_body = body
    if update_body:
        back = _message(pairs, body, nodes, world["to_body"], slots, None)
        at_body = jraph.segment_sum(jnp.where(keep, back, 0.0), slots, count)
        new_world["to_body"] = jnp.where(keep, world["to_body"] + back, world["to_body"])
        empty = jnp.zeros((count, width * len(updated)), nodes.dtype)
        new_body = body + mlp(params["node"], jnp.concatenate([body, empty, at_body], axis=-1))
    arrived = [received[name] for name in sorted(received)]
    new_nodes = nodes + mlp(params["node"], jnp.concatenate([nodes, *arrived], axis=-1))
    return new_nodes, new_body, updated, new_world


def _message(params, targets, sources, latent, target_index, source_index):
    """MLP([target, source, edge]) with the node parts of its first layer multiplied before the gather."""
    width = latent.shape[-1]
    kernel, bias = params["dense_0"]["kernel"], params["dense_0"]["bias"]
    target, source = targets @ kernel[:width], sources @ kernel[width : 2 * width]
    target = target if target_index is None else target[target_index]
    source = source if source_index is None else source[source_index]
    return _mlp_tail(params, target + source + latent @ kernel[2 * width :] + bias[None])
