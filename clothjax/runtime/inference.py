"""Psi in use (METHOD.md, Psi): latent predictor -> decoder -> blend shapes -> skinning, one jitted step a frame.

A network is reliable only where it was trained. Inputs of the pose, the character's constants and the code are
therefore clipped to their range in training. The last pose replaces one that is not finite. The garment stays finite
whatever comes in, and within a second or two of ordinary input the code forgets the rest. `State.ok` is True for a
frame that needed none of this; else `State.outside` tells which of `models.CAUSES` it was.
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
from clothjax.runtime import drape
from clothjax.runtime.models import Layer, Model, PosePredictor, State, Wearer
from clothjax.types import Array, Motion, Pose

FARTHEST = 1e6  # m from the origin, where float32 has steps of 6 cm
NOT_FELT = "this model feels no external acceleration: it was trained without stage2.forces"
SETTLING = 60  # frames that a garment with forces settles for before the first
T = TypeVar("T")


@jax.jit
def initial_state(model: Model, pose: Pose) -> State:
    """Return the state before the first frame, of a character that has been standing in `pose`.

    The code is zero; that of a Psi with forces has settled for `SETTLING` frames. The canonical pose replaces one that
    is not finite.
    """
    pose = Pose(jnp.asarray(pose.rotations, jnp.float32), jnp.asarray(pose.translation, jnp.float32))
    still = Pose(jnp.broadcast_to(jnp.eye(3, dtype=jnp.float32)[None], pose.rotations.shape), jnp.zeros(3, jnp.float32))
    pose, ok = _sound_or(pose, still)
    rotation, places = skinning.forward_kinematics(pose.rotations, model.wearer.joints, np.array(model.parents))
    rotations, positions, translation = (jnp.stack([x, x]) for x in (pose.rotations, places, pose.translation))
    outside = _outside(ok, True, True, True)
    state = State(model.network.first, rotations, positions, translation, outside)
    if isinstance(model.network.predictor, PosePredictor):
        return state
    state = state._replace(drape=drape.begin(model, state.latent, _transforms(model, rotation, places)))
    settled = jax.lax.fori_loop(0, SETTLING, lambda _, state: _advanced(model, state, pose, None, False)[0], state)
    return settled._replace(outside=outside)


def _outside(*inside: Array | bool) -> Array:
    """Return `State.outside` [4] from whether each of `CAUSES` was within its range."""
    return ~jnp.stack([jnp.asarray(each) for each in inside])


def _sound_or(pose: Pose, other: Pose) -> tuple[Pose, Array]:
    # NaN is not less than anything
    sound = jnp.all(jnp.abs(pose.rotations) < 2.0) & jnp.all(jnp.abs(pose.translation) < FARTHEST)
    return jax.tree.map(lambda x, y: jnp.where(sound, x, y), pose, other), sound


@partial(jax.jit, static_argnames="vertices")
def step(
    model: Model, state: State, pose: Pose, vertices: bool = True, external: Array | None = None
) -> tuple[State, Array | None]:
    """Compute the next frame: a new state, and the garment's vertices [V, 3] m in the world.

    Args:
        pose: of the frame to come, local rotations [J, 3, 3] and root translation [3] m.
        vertices: False for a garment that nobody sees: only the state goes on, and the vertices are None.
        external: [3] m/s^2, an acceleration of the cloth beside gravity, such as wind; only of a Psi with forces. One
            that is not finite does not push.

    Raises:
        ValueError: for an external acceleration of a Psi without forces.
    """
    return _advanced(model, state, pose, external, vertices)


def _advanced(
    model: Model, state: State, pose: Pose, external: Array | None, vertices: bool
) -> tuple[State, Array | None]:
    """Compute the next frame as `step` does, which is compiled apart."""
    network, wearer, parents = model.network, model.wearer, np.array(model.parents)
    pose = Pose(jnp.asarray(pose.rotations, jnp.float32), jnp.asarray(pose.translation, jnp.float32))
    pose, sound = _sound_or(pose, Pose(state.rotations[0], state.translation[0]))
    if external is not None:
        external = jnp.asarray(external, jnp.float32)
        pushed = jnp.all(jnp.isfinite(external))
        external, sound = jnp.where(pushed, external, 0.0), sound & pushed
    global_rotations, joints = skinning.forward_kinematics(pose.rotations, wearer.joints, parents)
    rotations, positions, translation = (
        jnp.concatenate([new[None], old])
        for new, old in zip((pose.rotations, joints, pose.translation), state[1:4], strict=True)
    )
    advance = translation[:2] - translation[1:]
    transforms = _transforms(model, global_rotations, joints)
    hung, touched = state.drape, None
    if isinstance(network.predictor, PosePredictor):
        if external is not None:
            raise ValueError(NOT_FELT)
        inputs = psi.pose_inputs(rotations, positions, advance, np.array(model.input_joints), model.config.fps)
        inputs, ordinary = normalisation.bounded(inputs - network.predictor.pose_mean, *network.predictor.pose_bounds)
        latent = predict(network.predictor, state.latent, inputs, wearer.bias, model.config)
    else:
        assert hung is not None
        ordinary = True
        hung = drape.stood(hung, rotations[:2], advance[0], external)
        latent, touched = drape.predict(model, state.latent, hung, transforms, pose, advance[0], external)
    latent, inside = normalisation.bounded(latent, *network.code_bounds)
    if hung is not None:
        hung = drape.follow(model, latent, state.latent, hung, transforms, advance[0])
    outside = _outside(sound, ordinary, wearer.known, inside)
    following = State(latent, rotations[:2], positions[:2], translation[:2], outside, hung)
    if not vertices:
        return following, None
    if hung is None or touched is None:
        shown = drape.shown(model, latent, transforms)
    else:
        shown = drape.shown_outside(model, latent, hung, touched, transforms)
    return following, shown + pose.translation[None]


def _transforms(model: Model, rotation: Array, places: Array) -> Array:
    """Return the transforms [J', 3, 4] of the joints `Model.moving`, from `skinning.forward_kinematics`."""
    return skinning.bound_transforms(rotation, places, model.wearer.joints)[np.array(model.moving)]


def predict(predictor: PosePredictor, latent: Array, inputs: Array, bias: Array, config: Config) -> Array:
    """Return the next code [C] from the current one, pose inputs [P] and the character's part [H] of the bias."""
    code = predictor.code
    x = latent @ code.kernel if isinstance(code, Layer) else latent[: len(bias)]
    x = inputs @ predictor.pose + x + code.bias + bias
    for layer in predictor.hidden:
        x = jax.nn.relu(x) @ layer.kernel + layer.bias
    return (1.0 - config.stage2.latent_decay) * latent + x


@jax.jit
def resting(before: State, after: State, tolerance: float = 2.5e-4) -> Array:
    """Return whether a time step changed nothing (a bool): until pose or acceleration change, none is needed.

    Args:
        before, after: the states around the step.
        tolerance: of the code, in standard deviations; a tenth of it, in rad and m, of the poses and, with forces, of
            how far the cloth has still to go, in place of the code.
    """
    moved = [x[0] - x[1] for x in (after.rotations, after.translation)]
    if after.drape is None:
        moved.append(0.1 * (after.latent - before.latent))
    else:  # its code is not in standard deviations
        moved.append(after.drape.velocity / (1.0 - drape.SLOWING))
    return jnp.all(jnp.stack([jnp.max(jnp.abs(x)) < 0.1 * tolerance for x in moved]))


@jax.jit
def step_crowd(model: Model, states: State, poses: Pose, external: Array | None = None) -> tuple[State, Array]:
    """Compute the next frame of every character of a crowd, as `step` does for one.

    Args:
        model: of `crowd`, for N characters.
        states, poses: with a leading axis [N].
        external: [N, 3] m/s^2, as of `step`.

    Returns:
        The new states, and vertices [N, V, 3] m in the world.
    """

    def one(wearer: Wearer, state: State, pose: Pose, external: Array | None) -> tuple[State, Array]:
        state, vertices = step(dataclasses.replace(model, wearer=wearer), state, pose, True, external)
        assert vertices is not None
        return state, vertices

    return jax.vmap(one)(model.wearer, states, poses, external)


def animate(model: Model, motion: Motion, external: Array | None = None) -> tuple[Array, Array]:
    """Animate a whole motion: vertices [T, V, 3] m in the world, and `State.ok` [T] of each frame.

    The first frame is the garment settled on the standing first pose.

    Args:
        external: [T, 3] m/s^2, as of `step` for each frame.

    Raises:
        ValueError: if the number of joints or frames a second of the motion is not the model's; as `step`.
    """
    if motion.rotations.shape[1] != len(model.names):
        raise ValueError(f"the motion has {motion.rotations.shape[1]} joints, the garment's body {len(model.names)}")
    if abs(motion.fps - model.config.fps) > 1e-3:
        raise ValueError(
            f"the motion has {motion.fps:g} frames a second, the garment was trained for {model.config.fps:g}: "
            "resample the motion"
        )
    return _animate(model, motion, external)


@jax.jit
def _animate(model: Model, motion: Motion, external: Array | None) -> tuple[Array, Array]:
    return rollout(model, motion, lambda state, vertices: (vertices, state.ok), external=external)


def rollout(
    model: Model,
    motion: Motion,
    kept: Callable[[State, Any], T],
    vertices: bool = True,
    external: Array | None = None,
) -> T:
    """Take a step for every frame of a motion, and return what `kept` keeps of each, stacked; for use within jit."""
    poses = Pose(jnp.asarray(motion.rotations, jnp.float32), jnp.asarray(motion.translation, jnp.float32))
    first = jax.tree.map(lambda x: x[0], poses)

    def frame(state, inputs):
        pose, pushed = inputs
        state, shown = step(model, state, pose, vertices, pushed)
        return state, kept(state, shown)

    return jax.lax.scan(frame, initial_state(model, first), (poses, external))[1]
