"""Phi (METHOD.md, Phi), from a garment's state to the code of its next frame: encode, process, convolve, decode."""

from dataclasses import field
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import MaterialConfig, ModelConfig
from clothjax.networks import decoder, graph_features, message_passing, mlp, normalisation
from clothjax.networks.graph_features import Features
from clothjax.networks.mesh_convolution import Convolution
from clothjax.networks.message_passing import MessagePassing
from clothjax.networks.mlp import Dense, Params
from clothjax.networks.normalisation import Statistics
from clothjax.physics import relaxation
from clothjax.physics.descent import descend, warm_start
from clothjax.simulation import characters
from clothjax.simulation.characters import Character, Frame, Window
from clothjax.simulation.rollout import StepInput, StepOutput
from clothjax.simulation.scene import Scene
from clothjax.types import Array, Garment, Material, Mesh, Rest

DESCENT_BOUND = 0.3  # length of a descent step, in units of the code


def latent_size(scene: Scene, config: ModelConfig) -> tuple[int, int]:
    """Return the number of vertices that the convolution leaves, and of channels for each.

    Their product is L, the size of the code; the channels are chosen so that it is nearest to `config.latent`.
    """
    left = scene.tables[-1].ids.shape[0] if scene.tables else scene.garment.vertices.shape[0]
    return left, max(1, round(config.latent / left))


class Phi(nn.Module):
    """Phi's network for one garment: from features of its state to the code of its next frame.

    Variables are `params` and the running `statistics` of the features. Blend shapes and the inverse Hessian are zero
    at first: training measures their initial values.
    """

    config: ModelConfig
    scene: Scene = field(repr=False)
    block: type[nn.Module] = message_passing.Block

    def setup(self):
        config, scene = self.config, self.scene
        left, channels = latent_size(scene, config)
        pinned = np.asarray(scene.garment.pinned)
        self.message_passing = MessagePassing(config, scene.graph, np.asarray(scene.level), pinned, self.block)
        nn.share_scope(self, self.message_passing)  # its parameters are beside the others, as in older models
        features = tuple(level.features or channels for level in config.convolution)
        self.convolution = Convolution(features, config.convolution_bases)
        if config.convolution[-1].features is not None:
            # a change of the code starts small, a code starts at unit size
            self.latent = Dense(features[-1], channels, 1e-4 if config.latent_update == "descent" else 1.0)
        self.garment = decoder.Decoder(config, left * channels, len(pinned))

    @nn.compact
    def __call__(self, seen: Features, guess: Array | float = 0.0) -> tuple[Array, Array]:
        """Return the next code [L] and its canonical displacement [V, 3] m.

        Args:
            seen: features of the time step.
            guess: [L], to which the network's output is added; 0 makes the output the code itself.
        """
        if self.config.latent_update == "descent":
            self.param("inverse_hessian", nn.initializers.zeros, (self.garment.latent,) * 2)
        latent = guess + self.convolve(self.message_passing(seen))
        return latent, self.garment(latent, free(self.scene.garment))

    def convolve(self, processed: Array) -> Array:
        """Convolve node latents [V, W] to a latent code [L]."""
        x = self.convolution(processed, self.scene.tables)
        if self.config.convolution[-1].features is not None:
            x = self.latent(x)
        return x.reshape(-1)


def free(garment: Garment) -> Array:
    """Return [V]: 1 for a vertex that moves, 0 for one that is pinned."""
    return jnp.where(jnp.asarray(garment.pinned), 0.0, 1.0)


def observe(statistics: dict[str, Statistics], seen: Features) -> dict[str, Statistics]:
    """Return running statistics that have also seen features with any leading axes; body nodes count as nodes."""
    return {
        name: normalisation.observe(
            statistics[name], jnp.concatenate([part.reshape(-1, part.shape[-1]) for part in parts])
        )
        for name, parts in seen.columns().items()
    }


def step(
    model: dict,
    scene: Scene,
    character: Character,
    inputs: StepInput,
    config: ModelConfig,
    material: MaterialConfig,
    block: type[nn.Module] = message_passing.Block,
) -> StepOutput:
    """Take one time step by Phi: descent to a guess, then the network (METHOD.md, Phi).

    Args:
        model: `params` and `statistics`.
        block: message-passing block, as of `Phi`.

    Returns:
        Next positions [V, 3] m, their code [L], and the features.
    """
    params = model["params"]
    state, window, potential = inputs.state, inputs.window, inputs.potential
    if "inverse_hessian" in params:
        fixed, now, change = jax.lax.stop_gradient((params, state.latent, state.change))

        def garment(latent):
            return decode(fixed["garment"], scene, character, latent, window, config)

        def precondition(gradient):
            # the Hessian in the space of codes hardly changes but for contact
            return jnp.matmul(fixed["inverse_hessian"], gradient, precision="highest")

        start = warm_start(now, change, garment, potential)
        guess = descend(precondition, start, garment, potential, config.descent_steps, DESCENT_BOUND)
        guessed = garment(guess)
    else:
        guess = 0.0
        guessed = characters.carried(state.position, window)
    force = -jax.grad(potential)(guessed)
    seen = graph_features.compute(
        scene, character, state, window, inputs.time_step.contact, inputs.time_step.timestep, guessed, force,
        config, material,
    )  # fmt: skip
    seen = jax.lax.stop_gradient(seen)
    output: Any = Phi(config, scene, block).apply(model, seen, guess)
    latent, displaced = output
    return StepOutput(shown(displaced, scene, character, window, config), latent, seen)


def decode(
    garment: Params, scene: Scene, character: Character, latent: Array, window: Window, config: ModelConfig
) -> Array:
    """Decode a code [L] to the vertices [V, 3] m of the following frame.

    Args:
        garment: parameters of the decoder with its blend shapes.
    """
    return shown(displacement(garment, scene, latent, config), scene, character, window, config)


def felt(
    garment: Params, scene: Scene, character: Character, latent: Array, frame: Frame, config: ModelConfig
) -> Array:
    """Decode a code [L] to the garment of `model.felt`, [Vf, 3] m at a frame; arguments of `decode`."""
    assert scene.felt is not None and character.felt is not None
    unrelaxed = skinned(displacement(garment, scene, latent, config), scene, character, frame)
    cloth, mesh = scene.felt.garment, scene.felt.mesh
    return relaxed(unrelaxed, cloth, mesh, character.felt.rest, character.material, config)


def displacement(garment: Params, scene: Scene, latent: Array, config: ModelConfig) -> Array:
    """Decode a code [L] to the canonical displacement [V, 3] m."""
    return mlp.apply(decoder.of(garment, config), garment, latent, free(scene.garment))


def skinned(displaced: Array, scene: Scene, character: Character, frame: Frame) -> Array:
    """Return the garment that feels, [Vf, 3] m at a frame, before relaxation, of a displacement [V, 3] m."""
    if scene.felt is None:
        return decoder.vertices(displaced, character.template, frame.garment)
    assert character.felt is not None and frame.felt is not None
    return decoder.vertices(scene.felt.on_garment.interpolated(displaced), character.felt.template, frame.felt)


def relaxed(
    position: Array, garment: Garment, mesh: Mesh, rest: Rest, material: Material, config: ModelConfig
) -> Array:
    """Return a garment [V, 3] m after `model.relaxation` steps."""
    if config.relaxation == 0:
        return position
    mobility = relaxation.mobility(rest, material, mesh, free(garment))
    steps = config.relaxation, config.relaxation_momentum
    return relaxation.relaxed(position, mobility, rest, material, mesh, *steps)


def shown(displaced: Array, scene: Scene, character: Character, window: Window, config: ModelConfig) -> Array:
    """Return the vertices [V, 3] m of the following frame, skinned and relaxed, of a displacement [V, 3] m."""
    position = decoder.vertices(displaced, character.template, window.following.garment)
    return relaxed(position, scene.garment, scene.mesh, character.rest, character.material, config)
