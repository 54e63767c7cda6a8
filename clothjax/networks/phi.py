"""Phi (METHOD.md, Phi): encode, process, convolve, decode. From a garment's state to the code of its next frame."""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from clothjax.body import skinning
from clothjax.config import MaterialConfig, ModelConfig
from clothjax.networks import decoder, graph_features, mesh_convolution, message_passing, normalisation
from clothjax.networks.graph_features import Features, WorldFeatures
from clothjax.networks.mlp import Params, apply_mlp, dense, init_dense, init_mlp
from clothjax.networks.normalisation import Statistics
from clothjax.physics.descent import descend, warm_start
from clothjax.simulation.characters import Character, Window
from clothjax.simulation.rollout import StepInput, StepOutput
from clothjax.simulation.scene import Scene
from clothjax.types import Array

TYPE_EMBEDDING, LEVEL_EMBEDDING = 9, 4
DESCENT_BOUND = 0.3  # of a step of the descent, in Z


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
        "processor": message_passing.init_processor(
            keys[6], config.processor, width, config.mlp_layers, body=example.world is not None
        ),
        "convolution": convolution,
        "garment": decoder.init(jax.random.fold_in(key, 9), left * per_vertex, basis, config),
    }


def init_statistics(example: Features) -> dict[str, Statistics]:
    """Empty statistics for features like `example`."""
    return {name: normalisation.empty_statistics(rows[0].shape[-1]) for name, rows in _columns(example).items()}


def observe(statistics: dict[str, Statistics], seen: Features) -> dict[str, Statistics]:
    """Statistics that have also seen a batch of features with leading axes [...]; body nodes count as nodes."""
    return {
        name: normalisation.observe(
            statistics[name], jnp.concatenate([part.reshape(-1, part.shape[-1]) for part in parts])
        )
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
    encoder = params["encoder"]
    pinned = scene.garment.pinned.astype(jnp.int32)
    kinds = params["type_embedding"]

    def nodes(rows, kind, level):
        embedded = jnp.concatenate([kinds[kind], params["level_embedding"][level]], axis=-1)
        return apply_mlp(encoder["nodes"], jnp.concatenate([rows, embedded], axis=-1))

    garment = nodes(normalisation.standardise(statistics["nodes"], seen.nodes), 3 * pinned, jnp.asarray(scene.level))
    edges = {
        name: apply_mlp(encoder[name], normalisation.standardise(statistics["mesh"], e))
        for name, e in seen.edges.items()
    }
    return message_passing.process(
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
    rows = normalisation.standardise(statistics["nodes"], seen.nodes)
    ones = jnp.ones(len(rows), jnp.int32)
    directions = {"to_garment": seen.to_garment}
    if config.body_nodes == "updated":
        directions["to_body"] = seen.to_body
    pairs = {
        name: apply_mlp(encoder["world"], normalisation.standardise(statistics["world"], x))
        for name, x in directions.items()
    }
    return message_passing.World(nodes(rows, ones, 0 * ones), seen.slots, seen.active, pairs)


def convolve(params: Params, scene: Scene, processed: Array, config: ModelConfig) -> Array:
    """Convolve: a latent code [L] from node latents [V, W]."""
    for block, table in zip(params["convolution"], scene.tables):
        processed = mesh_convolution.apply(
            block,
            processed,
            table.ids,
            table.mask,
            activation=jax.nn.relu,
        )
    if "latent" in params:
        processed = dense(params["latent"], processed)
    return processed.reshape(-1)


def step(
    params: Params,
    statistics: dict[str, Statistics],
    scene: Scene,
    character: Character,
    inputs: StepInput,
    model: ModelConfig,
    material: MaterialConfig,
) -> StepOutput:
    """One step of Phi: the next positions, their latent code, and the features it saw."""
    state, window, potential = inputs.state, inputs.window, inputs.potential
    if "inverse_hessian" in params:
        fixed, now, change = jax.lax.stop_gradient((params, state.latent, state.change))

        def garment(latent):
            return decode(fixed, scene, character, latent, window, model)

        def precondition(gradient):
            # the Hessian in the space of codes hardly changes but for contact
            return jnp.matmul(fixed["inverse_hessian"], gradient, precision="highest")

        start = warm_start(now, change, garment, potential)
        guess = descend(precondition, start, garment, potential, model.descent_steps, DESCENT_BOUND)
        guessed = garment(guess)
    else:
        guess = 0.0
        guessed = skinning.apply(window.following.garment, skinning.unapply(window.current.garment, state.position))
    force = -jax.grad(potential)(guessed)
    seen = graph_features.compute(
        scene, character, state, window, inputs.time_step.contact, inputs.time_step.timestep, guessed, force,
        model, material,
    )  # fmt: skip
    seen = jax.lax.stop_gradient(seen)
    latent = guess + convolve(params, scene, pass_messages(params, statistics, scene, seen, model), model)
    return StepOutput(decode(params, scene, character, latent, window, model), latent, seen)


def decode(params: Params, scene: Scene, character: Character, latent: Array, window: Window, model: ModelConfig):
    """The next frame's vertices [V, 3] m of a latent code [L]."""
    free = 1.0 - jnp.asarray(scene.garment.pinned).astype(latent.dtype)
    displaced = decoder.displacement(params["garment"], latent, free, model)
    return decoder.vertices(displaced, character.template, window.following.garment)
