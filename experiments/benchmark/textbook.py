"""The processor and the mesh convolution in the form of their papers: messages from concatenated rows, kernels built.

The library's own are compared with them in result, time and memory. Both use the library's MLP.
"""

import jax
import jax.numpy as jnp

from clothjax.networks import normalisation
from clothjax.networks.mlp import MLP, Params
from clothjax.types import Array


def mlp(params: Params, x: Array) -> Array:
    """Apply the library's MLP with a LayerNorm to [N, inputs]."""
    kernels = [layer["kernel"] for name, layer in params.items() if name.startswith("dense")]
    return MLP((x.shape[-1], *(kernel.shape[1] for kernel in kernels))).apply({"params": params}, x)


def process(params, statistics, scene, seen, config) -> Array:
    """Return node latents [V, W] of the garment.

    Every message comes from concatenated, gathered rows, summed by `segment_sum`, with a body node for every slot and
    every pair in every block."""
    encoder = params["encoder"]
    pinned = scene.garment.pinned.astype(jnp.int32)
    count = len(pinned)

    def nodes(rows, kind, level):
        embedded = jnp.concatenate([params["type_embedding"][kind], params["level_embedding"][level]], axis=-1)
        return mlp(
            encoder["nodes"], jnp.concatenate([normalisation.standardise(statistics["nodes"], rows), embedded], axis=-1)
        )

    garment = nodes(seen.nodes, 3 * pinned, jnp.asarray(scene.level))
    ones = jnp.ones(len(seen.world.nodes), jnp.int32)
    body = nodes(seen.world.nodes, ones, 0 * ones)
    every = jnp.concatenate([garment, body])
    graph = {name: (jnp.asarray(e.senders), jnp.asarray(e.receivers)) for name, e in scene.graph.items()}
    edges = {
        name: mlp(encoder[name], normalisation.standardise(statistics["mesh"], seen.edges[name])) for name in seen.edges
    }
    vertex = jnp.arange(count, dtype=seen.world.slots.dtype)
    slot = count + seen.world.slots
    graph["world"] = (jnp.concatenate([slot, vertex]), jnp.concatenate([vertex, slot]))
    pairs = jnp.concatenate([seen.world.to_garment, seen.world.to_body])
    edges["world"] = mlp(encoder["world"], normalisation.standardise(statistics["world"], pairs))
    for stack, stacked in zip(config.processor, params["processor"].values(), strict=True):
        active = seen.world.active & jnp.asarray(scene.level >= stack.lowest_level)
        keep = jnp.concatenate([active, active])[:, None]
        for index in range(stack.blocks):
            block = jax.tree.map(lambda x, i=index: x[i], stacked)
            arrived, latents = [], {}
            for name in sorted((*stack.edges, "world")):
                senders, receivers = graph[name]
                rows = jnp.concatenate([every[receivers], every[senders], edges[name]], axis=-1)
                message = mlp(block[f"edge_{name}"], rows)
                if name == "world":
                    message = jnp.where(keep, message, 0.0)
                arrived.append(jax.ops.segment_sum(message, receivers, len(every)))
                latents[name] = edges[name] + message
            every = every + mlp(block["node"], jnp.concatenate([every, *arrived], axis=-1))
            edges = edges | latents
    return every[:count]


def convolve(params, x: Array, ids: Array, mask: Array) -> Array:
    """Apply the mesh convolution [P, O], building the kernel [I, O] of every vertex and neighbour."""
    coefficients = params["coefficients"] * jnp.asarray(mask, x.dtype)[..., None]
    kernels = jnp.einsum("pkm,imo->pkio", coefficients, params["basis"])
    gathered = x[jnp.where(mask, ids, 0)]
    return jax.nn.relu(jnp.einsum("pki,pkio->po", gathered, kernels) + params["bias"][None])
