"""Psi in use (METHOD.md, Psi): latent predictor -> decoder -> blend shapes -> skinning, one jitted step a frame.

A network is reliable only where it was trained. Pose inputs, the character's constants and the code are therefore
clipped to their range in training. The last pose replaces one that is not finite. The garment stays finite whatever
comes in, and within a second or two of ordinary input the code forgets the rest. `State.ok` is True for a frame that
needed none of this.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import skinning
from clothjax.config import Config
from clothjax.networks import normalisation, psi
from clothjax.runtime.models import Layer, Model, Network, State, Wearer
from clothjax.types import Array, Motion, Pose

FARTHEST = 1e6  # m from the origin, where float32 has steps of 6 cm
T = TypeVar("T")
HIGHEST = jax.lax.Precision.HIGHEST


@jax.jit
def initial_state(model: Model, pose: Pose) -> State:
    """Return the state before the first frame: a code of zero, and a character that has been standing in `pose`.

    The canonical pose replaces one that is not finite.
    """
    pose = Pose(jnp.asarray(pose.rotations, jnp.float32), jnp.asarray(pose.translation, jnp.float32))
    still = Pose(jnp.broadcast_to(jnp.eye(3)[None], pose.rotations.shape), jnp.zeros(3))
    pose, ok = _sound_or(pose, still)
    _, positions = skinning.forward_kinematics(pose.rotations, model.wearer.joints, np.array(model.parents))
    rotations, positions, translation = (jnp.stack([x, x]) for x in (pose.rotations, positions, pose.translation))
    return State(model.network.first, rotations, positions, translation, ok)


def _sound_or(pose: Pose, other: Pose) -> tuple[Pose, Array]:
    # NaN is not less than anything
    sound = jnp.all(jnp.abs(pose.rotations) < 2.0) & jnp.all(jnp.abs(pose.translation) < FARTHEST)
    return jax.tree.map(lambda x, y: jnp.where(sound, x, y), pose, other), sound


@partial(jax.jit, static_argnames="vertices")
def step(model: Model, state: State, pose: Pose, vertices: bool = True) -> tuple[State, Array | None]:
    """Compute the next frame: a new state, and the garment's vertices [V, 3] m in the world.

    Args:
        pose: of the frame to come, local rotations [J, 3, 3] and root translation [3] m.
        vertices: False for a garment that nobody sees: only the state goes on, and the vertices are None.
    """
    network, wearer, parents = model.network, model.wearer, np.array(model.parents)
    pose, sound = _sound_or(pose, Pose(state.rotations[0], state.translation[0]))
    global_rotations, joints = skinning.forward_kinematics(pose.rotations, wearer.joints, parents)
    rotations, positions, translation = (
        jnp.concatenate([new[None], old])
        for new, old in zip((pose.rotations, joints, pose.translation), state[1:4], strict=True)
    )
    advance = translation[:2] - translation[1:]
    inputs = psi.pose_inputs(rotations, positions, advance, np.array(model.input_joints), model.config.fps)
    inputs, ordinary = normalisation.bounded(inputs - network.pose_mean, *network.pose_bounds)
    latent, inside = normalisation.bounded(
        predict(network, state.latent, inputs, wearer.bias, model.config), *network.code_bounds
    )
    ok = sound & ordinary & wearer.known & inside
    following = State(latent, rotations[:2], positions[:2], translation[:2], ok)
    if not vertices:
        return following, None
    displaced = jnp.matmul(blend_weights(network, latent, model.config), network.shapes, precision=HIGHEST)
    transforms = skinning.bound_transforms(global_rotations, joints, wearer.joints)
    garment = wearer.template + displaced.reshape(3, -1)
    return following, _skin(garment, network.weights, transforms[np.array(model.moving)], pose.translation)


def predict(network: Network, latent: Array, inputs: Array, bias: Array, config: Config) -> Array:
    """Return the next code [C] from the current one, pose inputs [P] and the character's part [H] of the bias."""
    code = network.code
    x = latent @ code.kernel if isinstance(code, Layer) else latent[: len(bias)]
    x = inputs @ network.pose + x + code.bias + bias
    for layer in network.hidden:
        x = jax.nn.relu(x) @ layer.kernel + layer.bias
    return (1.0 - config.stage2.latent_decay) * latent + x


def blend_weights(network: Network, latent: Array, config: Config) -> Array:
    """Return the weights [K] of the blend shapes `Network.shapes` for a code [C]."""
    read = network.read
    product = latent @ read.kernel if isinstance(read, Layer) else latent[-len(read.bias) :]
    x, skip = jnp.split(read.bias + product, [network.width])
    for layer in network.decoder:
        x = jax.nn.relu(x) @ layer.kernel + layer.bias
    weights = x + skip if config.model.decoder_skip else x
    weights = jax.nn.relu(weights) if config.model.blendshape_relu else weights
    return weights if network.mix is None else weights @ network.mix.kernel + network.mix.bias


def _skin(garment: Array, weights: Array, transforms: Array, translation: Array) -> Array:
    """Skin a garment [3, V] by the transforms [J', 3, 4] of joints with weights [J', V]; return vertices [V, 3] m.

    It works coordinate by coordinate, because processors are fast at long rows.
    """
    flat = transforms.reshape(-1, 12).T
    rows = jnp.matmul(flat, weights, precision=HIGHEST).reshape(3, 4, -1)
    x, y, z = (rows[:, i] * garment[None, i] for i in range(3))
    return (x + y + z + rows[:, 3] + translation[:, None]).T


@jax.jit
def resting(before: State, after: State, tolerance: float = 2.5e-4) -> Array:
    """Return whether a time step changed nothing (a bool): until the pose changes, no further step is needed.

    Args:
        before, after: the states around the step.
        tolerance: of the code, in standard deviations; a tenth of it, in rad and m, of the poses.
    """
    still = [jnp.max(jnp.abs(x[0] - x[1])) < 0.1 * tolerance for x in (after.rotations, after.translation)]
    return still[0] & still[1] & (jnp.max(jnp.abs(after.latent - before.latent)) < tolerance)


@jax.jit
def step_crowd(model: Model, states: State, poses: Pose) -> tuple[State, Array]:
    """Compute the next frame of every character of a crowd, as `step` does for one.

    Args:
        model: of `crowd`, for N characters.
        states, poses: with a leading axis [N].

    Returns:
        The new states, and vertices [N, V, 3] m in the world.
    """

    def one(wearer: Wearer, state: State, pose: Pose) -> tuple[State, Array]:
        state, vertices = step(dataclasses.replace(model, wearer=wearer), state, pose, vertices=True)
        assert vertices is not None
        return state, vertices

    return jax.vmap(one)(model.wearer, states, poses)


def animate(model: Model, motion: Motion) -> tuple[Array, Array]:
    """Animate a whole motion: vertices [T, V, 3] m in the world, and `State.ok` [T] of each frame.

    The first frame is the garment settled on the standing first pose.

    Raises:
        ValueError: if the number of joints or frames a second of the motion is not the model's.
    """
    if motion.rotations.shape[1] != len(model.names):
        raise ValueError(f"the motion has {motion.rotations.shape[1]} joints, the garment's body {len(model.names)}")
    if abs(motion.fps - model.config.fps) > 1e-3:
        raise ValueError(
            f"the motion has {motion.fps:g} frames a second, the garment was trained for {model.config.fps:g}: "
            "resample the motion"
        )
    return _animate(model, motion)


@jax.jit
def _animate(model: Model, motion: Motion) -> tuple[Array, Array]:
    return rollout(model, motion, lambda state, vertices: (vertices, state.ok))


def rollout(model: Model, motion: Motion, kept: Callable[[State, Any], T], vertices: bool = True) -> T:
    """Take a step for every frame of a motion, and return what `kept` keeps of each, stacked; for use within jit."""
    poses = Pose(jnp.asarray(motion.rotations, jnp.float32), jnp.asarray(motion.translation, jnp.float32))
    first = jax.tree.map(lambda x: x[0], poses)

    def frame(state, pose):
        state, shown = step(model, state, pose, vertices)
        return state, kept(state, shown)

    return jax.lax.scan(frame, initial_state(model, first), poses)[1]
