"""Phi, Psi and the baselines as animators: each takes one time step of a garment."""

from collections.abc import Callable
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import skinning
from clothjax.config import Config
from clothjax.networks import baselines, decoder, forces, mlp, normalisation, phi
from clothjax.networks.message_passing import Block
from clothjax.networks.mlp import Params
from clothjax.networks.normalisation import ForceScales, Normalizers
from clothjax.networks.psi import Psi, constant_inputs, next_code, window_inputs
from clothjax.physics import incremental_potential
from clothjax.physics.incremental_potential import TimeStep
from clothjax.simulation import characters
from clothjax.simulation.characters import Character, Window
from clothjax.simulation.rollout import Animator, StepInput, StepOutput
from clothjax.simulation.scene import Scene
from clothjax.types import Array, ClothState

MakeAnimator = Callable[[dict, Scene, Character, Config], Animator]
"""A function from a network's variables (`params`, `statistics`), scene, character and settings to an animator."""


def memory_size(scene: Scene, config: Config) -> int:
    """Return how many numbers L an animator carries from frame to frame, as a code or a baseline's memory."""
    if config.peer.network:
        return baselines.memory_size(config)
    left, channels = phi.latent_size(scene, config.model)
    return left * channels


def phi_animator(
    model: dict, scene: Scene, character: Character, config: Config, block: type[nn.Module] = Block
) -> Animator:
    """Return Phi as the animator of a character's garment.

    Args:
        model: Phi's `params` and `statistics`.
        block: message-passing block; `partial(phi_animator, block=Mine)` makes an animator of another one.
    """

    def step(inputs: StepInput) -> StepOutput:
        return phi.step(model, scene, character, inputs, config.model, config.material, block)

    return Animator(memory_size(scene, config), step)


def baseline_animator(input_joints: np.ndarray) -> MakeAnimator:
    """Return the function that makes an animator of a baseline's network; it reads `params` alone.

    Args:
        input_joints: [Jk] indices of the joints that are inputs.
    """

    def make(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
        constants = constant_inputs(character.betas, character.material, config.material)
        free = phi.free(scene.garment)
        network = baselines.network(config, len(free))

        def step(inputs: StepInput) -> StepOutput:
            seen = baselines.inputs(inputs.poses, character.joints, constants, scene.body.parents, input_joints, config)
            displaced, memory = mlp.apply(network, model["params"], inputs.state.latent, **seen)
            transforms = inputs.window.following.garment
            return StepOutput(decoder.vertices(displaced * free[:, None], character.template, transforms), memory)

        return Animator(memory_size(scene, config), step, recurrent=True)

    return make


class Preconditioners(NamedTuple):
    """Matrices that multiply the gradients of Psi's first and last layer in fine-tuning.

    Together they are a Kronecker-factored preconditioner (Martens and Grosse 2015) of the first layer's inputs and the
    last layer's outputs.
    """

    pose: Array  # [P, P] for the first layer, over normalised pose inputs
    code: Array | None  # [L, L] for the last layer, over normalised codes; None: not preconditioned


@jax.custom_vjp
def precondition(matrix: Array, code: Array) -> Array:
    """Return `code` [L] unchanged; in the backward pass its gradient is multiplied by `matrix` [L, L], symmetric."""
    del matrix  # of the gradient alone
    return code


precondition.defvjp(lambda matrix, code: (code, matrix), lambda matrix, g: (jnp.zeros_like(matrix), matrix @ g))


def learning_from(params: Params, inputs: Array) -> Params:
    """Return parameters of the latent predictor that give the same outputs, but another gradient of the first kernel.

    The gradient of the kernel of `dense_0` is that of a layer which had read `inputs`, such as preconditioned ones, in
    place of its own inputs.

    Args:
        params: of the latent predictor.
        inputs: [N], as many as the layer has.
    """
    first, stop = params["dense_0"], jax.lax.stop_gradient
    outputs = stop(inputs) @ first["kernel"]
    return params | {"dense_0": {"kernel": stop(first["kernel"]), "bias": first["bias"] + (outputs - stop(outputs))}}


def psi_animator(
    garment: dict, normalizers: Normalizers, input_joints: np.ndarray, gradients: Preconditioners | None = None
) -> MakeAnimator:
    """Return the function that makes an animator of Psi: its `params` are trained, the decoder is frozen.

    Codes are clipped to their range as at run time; gradients pass as if none had been out of it.

    Args:
        garment: parameters of the decoder with its blend shapes.
        normalizers: scales of codes [L] and pose inputs [P].
        input_joints: [Jk] indices of the joints that are inputs.
        gradients: preconditioners of the gradients, if any.
    """

    def make(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
        constants = constant_inputs(character.betas, character.material, config.material)

        def step(inputs: StepInput) -> StepOutput:
            params = model["params"]
            pose = window_inputs(inputs.poses, character.joints, scene.body.parents, input_joints, config.fps)
            pose = normalisation.normalise(normalizers.pose, pose)
            now = normalisation.normalise(normalizers.latent, inputs.state.latent)
            if gradients is not None:
                params = learning_from(params, jnp.concatenate([now, gradients.pose @ pose, constants]))
            latent = mlp.apply(Psi(config.stage2), params, now, pose, constants)
            inside, _ = normalisation.bounded(latent, normalizers.latent.low, normalizers.latent.high)
            latent += jax.lax.stop_gradient(inside - latent)
            shown = latent
            if gradients is not None and gradients.code is not None:
                shown = precondition(gradients.code, latent)
            code, shown = (normalisation.denormalise(normalizers.latent, z) for z in (latent, shown))
            return StepOutput(phi.decode(garment, scene, character, shown, inputs.window, config.model), code)

        return Animator(memory_size(scene, config), step)

    return make


def forces_on_code(
    garment: Params,
    scene: Scene,
    character: Character,
    state: ClothState,
    window: Window,
    config: Config,
    external: Array | None = None,
) -> Array:
    """Return the forces of `forces.reduced`, [3, L] in J, on the code of a state.

    Where `model.felt` is another garment than the one of the state, it is felt where the codes of two frames put it.

    Args:
        garment: parameters of the decoder.
        state: of the garment at the current frame.
        external: [3] m/s^2, an acceleration of the cloth beside gravity.
    """
    if scene.felt is None:
        position, velocity = state.position, state.velocity
        now, following = window.current.garment, window.following.garment
        rest, mass, mesh, clusters = character.rest, character.mass, scene.mesh, scene.clusters
    else:
        assert character.felt is not None
        position, before = (
            phi.felt(garment, scene, character, code, frame, config.model)
            for code, frame in ((state.latent, window.current), (state.latent - state.change, window.previous))
        )
        velocity = position - before
        now, following = window.current.felt, window.following.felt
        (_, rest, mass), mesh, clusters = character.felt, scene.felt.mesh, scene.felt.clusters
    assert now is not None and following is not None
    held = skinning.carry(now, following, position)
    timestep = 1.0 / config.fps
    step = TimeStep(
        position=position,
        velocity=incremental_potential.pushed(velocity, timestep, external),
        mass=mass,
        rest=rest,
        material=character.material,
        contact=None,
        touching=None,
        timestep=jnp.asarray(timestep, position.dtype),
    )

    def skinned(code: Array) -> Array:
        displaced = phi.displacement(garment, scene, code, config.model)
        return phi.skinned(displaced, scene, character, window.following)

    surface = characters.surface(scene, window.following)
    return forces.reduced(skinned, state.latent, held, step, surface, clusters, mesh, config.physics)


def force_psi_animator(garment: dict, scales: ForceScales) -> MakeAnimator:
    """Return a function that makes a Psi with forces, of `params`, the animator of a garment, with a frozen decoder.

    Codes are clipped to their range; gradients pass as if none had been out of it. The inputs are constants.

    Args:
        garment: parameters of the decoder.
    """

    def make(model: dict, scene: Scene, character: Character, config: Config) -> Animator:
        constants = constant_inputs(character.betas, character.material, config.material)

        def step(inputs: StepInput) -> StepOutput:
            state = jax.lax.stop_gradient(inputs.state)
            pulls = forces_on_code(garment, scene, character, state, inputs.window, config)
            pulls = jax.lax.stop_gradient(pulls)
            code = next_code(model["params"], scales, state.latent, state.change, pulls, constants, config.stage2)
            code += jax.lax.stop_gradient(jnp.clip(code, scales.low, scales.high) - code)
            return StepOutput(phi.decode(garment, scene, character, code, inputs.window, config.model), code)

        return Animator(memory_size(scene, config), step)

    return make
