"""Phi: Encode, Process, Convolve, Decode (18). From a garment's state to the latent code of its next frame."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from clothjax import features as feature
from clothjax import garment_model, graph_network, mesh_convolution, skinning
from clothjax.character import Character, Window
from clothjax.config import MaterialConfig, ModelConfig
from clothjax.features import Features, Statistics, WorldFeatures
from clothjax.graph_network import Params, dense, init_dense, init_mlp, mlp
from clothjax.scene import Scene
from clothjax.types import Array, ClothState, Contact

TYPE_EMBEDDING, LEVEL_EMBEDDING = 9, 4
COLUMNS = 32  # of a Hessian, computed together
MAX_LENGTH = 4.0  # of the step, where 1 is the configured cloth's at rest: others are softer or lighter


def latent_size(scene: Scene, config: ModelConfig) -> tuple[int, int]:
    """Vertices left by the convolution and channels of each, so that their product L is nearest to config.latent."""
    left = scene.tables[-1].ids.shape[0] if scene.tables else scene.garment.vertices.shape[0]
    return left, max(1, round(config.latent / left))


def init(key: Array, scene: Scene, example: Features, basis: Array, config: ModelConfig) -> Params:
    """Parameters of Phi for features like `example`; `basis` [K, V, 3] m starts the blend shapes."""
    keys = jax.random.split(key, 8)
    width = config.width
    hidden = (width,) * config.mlp_layers
    embedding = TYPE_EMBEDDING + LEVEL_EMBEDDING
    encoder = {"nodes": init_mlp(keys[0], (example.nodes.shape[-1] + embedding, *hidden))}
    if example.world is not None:
        encoder["world"] = init_mlp(keys[1], (example.world.to_garment.shape[-1], *hidden))
    for index, name in enumerate(sorted(example.edges)):
        encoder[name] = init_mlp(jax.random.fold_in(keys[2], index), (example.edges[name].shape[-1], *hidden))
    left, per_vertex = latent_size(scene, config)
    convolution, channels = [], width
    for index, (level, table) in enumerate(zip(config.convolution, scene.tables)):
        subkey = jax.random.fold_in(keys[3], index)
        convolution.append(
            mesh_convolution.init(
                subkey,
                table,
                channels,
                level.features or per_vertex,
                config.convolution_bases,
                config.residual_rate,
            )
        )
        channels = level.features
    size = left * per_vertex
    params = {}
    if config.latent_update == "descent":
        params["inverse_hessian"] = jnp.zeros((size, size))
    if channels is not None:
        # a change of the code starts small, a code starts at unit size
        params["latent"] = init_dense(keys[7], channels, per_vertex, gain=1e-4 if params else 1.0)
    return params | {
        "type_embedding": jax.random.normal(keys[4], (4, TYPE_EMBEDDING)),
        "level_embedding": jax.random.normal(keys[5], (8, LEVEL_EMBEDDING)),
        "encoder": encoder,
        "processor": graph_network.init_processor(
            keys[6], config.processor, width, config.mlp_layers, body=example.world is not None
        ),
        "convolution": convolution,
        "garment": garment_model.init(jax.random.fold_in(key, 9), left * per_vertex, basis, config),
    }


def init_statistics(example: Features) -> dict[str, Statistics]:
    """Empty statistics for features like `example`."""
    return {name: feature.empty_statistics(rows[0].shape[-1]) for name, rows in _columns(example).items()}


def observe(statistics: dict[str, Statistics], seen: Features) -> dict[str, Statistics]:
    """Statistics that have also seen a batch of features with leading axes [...]; body nodes count as nodes."""
    return {
        name: feature.observe(statistics[name], jnp.concatenate([part.reshape(-1, part.shape[-1]) for part in parts]))
        for name, parts in _columns(seen).items()
    }


def _columns(seen: Features) -> dict[str, list[Array]]:
    """The features that share columns, and so statistics."""
    world = seen.world
    if world is None:
        return {"nodes": [seen.nodes], "mesh": list(seen.edges.values())}
    return {
        "nodes": [seen.nodes, world.nodes],
        "mesh": list(seen.edges.values()),
        "world": [world.to_garment, world.to_body],
    }


def pass_messages(
    params: Params,
    statistics: dict[str, Statistics],
    scene: Scene,
    seen: Features,
    config: ModelConfig,
) -> Array:
    """Encode and Process: node latents [V, W] of the garment from features."""
    if config.bfloat16:
        params = graph_network.in_bfloat16(params)
    encoder = params["encoder"]
    pinned = scene.garment.pinned.astype(jnp.int32)
    kinds = params["type_embedding"]

    def nodes(rows, kind, level):
        embedded = jnp.concatenate([kinds[kind], params["level_embedding"][level]], axis=-1)
        return mlp(encoder["nodes"], jnp.concatenate([rows, embedded], axis=-1))

    garment = nodes(feature.normalise(statistics["nodes"], seen.nodes), 3 * pinned, jnp.asarray(scene.level))
    edges = {name: mlp(encoder[name], feature.normalise(statistics["mesh"], e)) for name, e in seen.edges.items()}
    return graph_network.process(
        params["processor"],
        config.processor,
        garment,
        edges,
        _world(encoder, nodes, statistics, seen.world, config),
        scene.graph,
        scene.level,
        remat=config.remat,
    )


def _world(encoder: Params, nodes: Callable, statistics: dict[str, Statistics], seen: WorldFeatures | None, config):
    """The body and its pairs with the garment, encoded."""
    if seen is None:
        return None
    rows = feature.normalise(statistics["nodes"], seen.nodes)
    ones = jnp.ones(len(rows), jnp.int32)
    directions = {"to_garment": seen.to_garment}
    if config.body_nodes == "updated":
        directions["to_body"] = seen.to_body
    pairs = {name: mlp(encoder["world"], feature.normalise(statistics["world"], x)) for name, x in directions.items()}
    return graph_network.World(nodes(rows, ones, 0 * ones), seen.slots, seen.active, pairs)


def convolve(params: Params, scene: Scene, processed: Array, config: ModelConfig) -> Array:
    """Convolve: a latent code [L] from node latents [V, W]."""
    for block, table in zip(params["convolution"], scene.tables):
        processed = mesh_convolution.apply(
            block,
            processed,
            table.ids,
            table.mask,
            residual_rate=config.residual_rate,
            activation=jax.nn.relu,
        )
    if "latent" in params:
        processed = dense(params["latent"], processed)
    return processed.reshape(-1)


def descend(
    precondition: Callable[[Array], Array],
    latent: Array,
    garment: Callable[[Array], Array],
    potential: Callable[[Array], Array],
    steps: int,
    bound: float,
) -> Array:
    """The code [L] after some conjugate-gradient steps (Polak-Ribiere) on the potential of its garment.

    The length of a step is that of Newton's method along it, by the curvature that the potential has there: cloth
    that rests on the body is stiffer than any at rest, and would be thrown off it.

    Args:
        precondition: an approximate inverse Hessian times a gradient [L].
        garment: of a code, vertices [V, 3] m; potential: of these, J.
        bound: length that no step exceeds.
    """

    def step(carry, _):
        latent, direction, gradient, steepest = carry
        held, pullback = jax.vjp(garment, latent)
        force, hessian = jax.linearize(jax.grad(potential), held)
        new = pullback(force)[0]
        down = -precondition(new)
        kept = jnp.sum(new * (steepest - down)) / jnp.maximum(-jnp.sum(gradient * steepest), 1e-12)
        direction = down + jnp.maximum(kept, 0.0) * direction
        direction = jnp.where(jnp.sum(new * direction) < 0, direction, down)
        _, moved = jax.jvp(garment, (latent,), (direction,))
        slope, curvature = jnp.maximum(-jnp.sum(moved * force), 0.0), jnp.sum(moved * hessian(moved))
        convex = curvature > 0
        length = jnp.where(convex, jnp.minimum(slope / jnp.where(convex, curvature, 1.0), MAX_LENGTH), 1.0)
        push = jnp.where(slope > 0, length, 0.0) * direction
        # deep collisions push thousands of times harder than the rest
        push = push / jnp.sqrt(1.0 + jnp.sum(push * push) / bound**2)
        return (latent + push, direction, new, down), None

    zero = jnp.zeros_like(latent)
    (latent, *_), _ = jax.lax.scan(step, (latent, zero, zero, zero), None, length=steps)
    return latent


def onward(
    latent: Array, change: Array, garment: Callable[[Array], Array], potential: Callable[[Array], Array]
) -> Array:
    """Where the steps of `descend` begin: the last code [L], plus its last change if the potential is lower there.

    From the last code alone, what a few steps leave undone is like a drag on the cloth. The sum is far off where the
    motion changes at once.
    """
    here, there = latent, latent + change
    return jnp.where(potential(garment(there)) < potential(garment(here)), there, here)


def hessian(energy: Callable[[Array], Array], latent: Array) -> Array:
    """The Hessian [L, L] in J of an energy of codes, at a code [L]."""

    def column(direction):
        return jax.jvp(jax.grad(energy), (latent,), (direction,))[1]

    # some at a time: of a large garment all together would not fit into memory
    return jax.lax.map(column, jnp.eye(len(latent)), batch_size=COLUMNS)


def convex(matrix: Array) -> Array:
    """A symmetric matrix [L, L] without its negative eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    return jnp.matmul(vectors * jnp.maximum(values, 0.0)[None], vectors.T, precision="highest")


def inverted(matrix: Array, damping: float) -> Array:
    """The inverse of a convex Hessian [L, L] in J, with `damping` J added to its eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    inverse = 1.0 / (jnp.maximum(values, 0.0) + damping)
    return jnp.matmul(vectors * inverse[None], vectors.T, precision="highest")


def step(
    params: Params,
    statistics: dict[str, Statistics],
    scene: Scene,
    character: Character,
    state: ClothState,
    window: Window,
    contact: Contact | None,
    timestep: Array,
    potential: Callable[[Array], Array],
    model: ModelConfig,
    material: MaterialConfig,
) -> tuple[Array, Array, Features]:
    """One step of Phi: the next positions [V, 3] m (relative to the current root), its latent code [L], its inputs.

    Args:
        potential: of next positions [V, 3] m in J.
    """

    if "inverse_hessian" in params:
        fixed, now, change = jax.lax.stop_gradient((params, state.latent, state.change))

        def garment(latent):
            return decode(fixed, scene, character, latent, window, model)

        def precondition(gradient):
            # the Hessian in the space of codes hardly changes but for contact
            return jnp.matmul(fixed["inverse_hessian"], gradient, precision="highest")

        start = onward(now, change, garment, potential)
        guess = descend(precondition, start, garment, potential, model.descent_steps, model.descent_bound)
        guessed = garment(guess)
    else:
        guess = 0.0
        guessed = skinning.apply(window.following.garment, skinning.unapply(window.current.garment, state.position))
    force = -jax.grad(potential)(guessed)
    seen = feature.features(scene, character, state, window, contact, timestep, guessed, force, model, material)
    seen = jax.lax.stop_gradient(seen)
    latent = guess + convolve(params, scene, pass_messages(params, statistics, scene, seen, model), model)
    return decode(params, scene, character, latent, window, model), latent, seen


def decode(params: Params, scene: Scene, character: Character, latent: Array, window: Window, model: ModelConfig):
    """The next frame's vertices [V, 3] m of a latent code [L]."""
    free = 1.0 - jnp.asarray(scene.garment.pinned).astype(latent.dtype)
    displaced = garment_model.displacement(params["garment"], latent, free, model)
    return garment_model.vertices(displaced, character.template, window.following.garment)
