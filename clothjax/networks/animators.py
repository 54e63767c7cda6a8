"""Phi, Psi and the baselines, each as a function that moves a garment by one frame."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import Config
from clothjax.networks import baselines, decoder, normalisation, phi
from clothjax.networks.mlp import Params
from clothjax.networks.normalisation import Normalizers
from clothjax.networks.psi import Psi, constant_inputs, window_inputs
from clothjax.simulation.characters import Character
from clothjax.simulation.rollout import Animator, StepInput, StepOutput
from clothjax.simulation.scene import Scene
from clothjax.types import Array

MakeAnimator = Callable[[dict, Scene, Character, Config], Animator]
"""An animator of `params` and `statistics`, for a character in a scene."""


def memory_size(scene: Scene, config: Config) -> int:
    """Numbers L that an animator carries from frame to frame: the code, or a baseline's memory."""
    if config.peer.network:
        return baselines.memory_size(config)
    left, channels = phi.latent_size(scene, config.model)
    return left * channels


def phi_animator(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
    """Phi, of `params` and `statistics`, as what moves a character's garment."""

    def step(inputs: StepInput) -> StepOutput:
        return phi.step(model, scene, character, inputs, config.model, config.material)

    return Animator(memory_size(scene, config), step)


def baseline_animator(kept: np.ndarray) -> MakeAnimator:
    """A baseline's network, of `params`, as what moves a character's garment: on the joints `kept`."""

    def make(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
        constants = constant_inputs(character.betas, character.material, config.material)
        free = phi.free(scene)

        network = baselines.network(config, len(free))

        def step(inputs: StepInput) -> StepOutput:
            seen = baselines.inputs(inputs.poses, character.joints, constants, scene.body.parents, kept, config)
            displaced, memory = network.apply({"params": model["params"]}, inputs.state.latent, **seen)
            moved = character.template, inputs.window.following.garment
            return StepOutput(decoder.vertices(displaced * free[:, None], *moved), memory)

        return Animator(memory_size(scene, config), step, recurrent=True)

    return make


class Preconditioners(NamedTuple):
    """What gradients are multiplied by where they enter Psi and where they leave it: a Kronecker-factored
    preconditioner (Martens and Grosse 2015) of its first layer's inputs and its last layer's outputs."""

    pose: Array  # [P, P] of normalised pose inputs
    code: Array | None  # [L, L] of normalised codes


@jax.custom_vjp
def precondition(matrix: Array, code: Array) -> Array:
    """The same code [L], whose gradient is multiplied by a symmetric matrix [L, L]."""
    return code


precondition.defvjp(lambda matrix, code: (code, matrix), lambda matrix, g: (jnp.zeros_like(matrix), matrix @ g))


def learning_from(params: Params, inputs: Array) -> Params:
    """The same predictor, whose first layer gets its gradient as if it had been given other inputs [N]."""
    first, still = params["dense_0"], jax.lax.stop_gradient
    outputs = still(inputs) @ first["kernel"]
    return params | {"dense_0": {"kernel": still(first["kernel"]), "bias": first["bias"] + (outputs - still(outputs))}}


def psi_animator(
    garment: dict, normalizers: Normalizers, kept: np.ndarray, gradients: Preconditioners | None = None
) -> MakeAnimator:
    """Psi, of `params`, as what moves a character's garment: with a frozen decoder, on the joints `kept`.

    Codes are brought into their range as in use; gradients pass as if none had been out of it.
    """

    def make(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
        constants = constant_inputs(character.betas, character.material, config.material)

        def step(inputs: StepInput) -> StepOutput:
            params = model["params"]
            pose = window_inputs(inputs.poses, character.joints, scene.body.parents, kept, config.fps)
            pose = normalisation.normalise(normalizers.pose, pose)
            now = normalisation.normalise(normalizers.latent, inputs.state.latent)
            if gradients is not None:
                params = learning_from(params, jnp.concatenate([now, gradients.pose @ pose, constants]))
            latent = Psi(config.stage2).apply({"params": params}, now, pose, constants)
            inside, _ = normalisation.bounded(latent, normalizers.latent.low, normalizers.latent.high)
            latent += jax.lax.stop_gradient(inside - latent)
            shown = latent
            if gradients is not None and gradients.code is not None:
                shown = precondition(gradients.code, latent)
            code, shown = (normalisation.denormalise(normalizers.latent, z) for z in (latent, shown))
            return StepOutput(phi.decode(garment, scene, character, shown, inputs.window, config.model), code)

        return Animator(memory_size(scene, config), step)

    return make
