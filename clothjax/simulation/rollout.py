"""Time steps of a garment by an animator, and rollouts of many, with the losses of training."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from clothjax.body import motion_clips
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.physics import incremental_potential
from clothjax.physics.incremental_potential import TimeStep
from clothjax.simulation import characters
from clothjax.simulation.characters import Character, Window
from clothjax.simulation.scene import Scene
from clothjax.simulation.time_step import start, time_step
from clothjax.types import Array, ClothState, Pose, Scalar


class StepInput(NamedTuple):
    """The inputs of an animator for one time step."""

    state: ClothState
    poses: Pose  # previous, current and following, leading axis 3
    window: Window  # the character at these poses
    time_step: TimeStep
    potential: Callable[[Array], Array]  # of next positions [V, 3] m, in J


class StepOutput(NamedTuple):
    """The outputs of an animator for one time step."""

    position: Array  # [V, 3] m, relative to the root at the current frame
    code: Array  # [L] code or memory that the animator carries to the next frame
    seen: Any = None  # pytree of features, for Phi's running statistics


class Animator(NamedTuple):
    """Moves one character's garment, a time step at a time: a network, or the physics itself."""

    memory_size: int  # L, numbers carried from frame to frame
    step: Callable[[StepInput], StepOutput]
    recurrent: bool = False  # True if gradients of the code reach back over all frames of a rollout


class Taken(NamedTuple):
    """A time step that was taken, and the constants of its potential."""

    position: Array  # [V, 3] m, relative to the root at the current frame
    time_step: TimeStep
    seen: Any


class Track(NamedTuple):
    """Record by `play` of a rollout of T frames."""

    position: Array  # [T, V, 3] m after each step, relative to the root before it
    states: ClothState  # before each step, every leaf with a leading axis T
    codes: Array  # [T, L] after each step


def take(
    animator: Animator,
    scene: Scene,
    character: Character,
    state: ClothState,
    poses: Pose,
    timestep: Scalar,
    config: Config,
) -> tuple[ClothState, Taken]:
    """Take one time step; the returned state is still relative to the root at the current frame.

    Args:
        poses: window, leading axis 3.
        timestep: s, the duration.
    """
    window = characters.window(scene, character, poses)
    step = time_step(scene, character, state, window, timestep, config)

    def potential(position: Array) -> Array:
        return incremental_potential.potential(position, step, scene.mesh, config.physics)

    position, code, seen = animator.step(StepInput(state, poses, window, step, potential))
    velocity = position - state.position
    taken = ClothState(position, velocity, velocity - state.velocity, code, code - state.latent)
    return taken, Taken(position, step, seen)


def follow(state: ClothState, advance: Array) -> ClothState:
    """Express a state relative to the root of the next frame, which is `advance` [3] m from the current one."""
    return state._replace(position=state.position - advance[None])


def advance(
    animator: Animator, scene: Scene, character: Character, state: ClothState, poses: Pose, config: Config
) -> tuple[ClothState, Array]:
    """Take one time step of 1 / fps s along a motion.

    Returns:
        The state, relative to the root of the next frame, and the positions [V, 3] m, relative to the current root.
    """
    taken, (position, _, _) = take(animator, scene, character, state, poses, 1.0 / config.fps, config)
    return follow(taken, poses.translation[2]), position


def settle(animator: Animator, scene: Scene, character: Character, poses: Pose, config: Config) -> ClothState:
    """Return the first state of a motion: skinned, then (HOOD) one long quasi-static step on the standing body.

    Without `stage1.start_timestep` it is as skinned.

    Args:
        poses: window of the first frame, leading axis 3.
    """
    state = start(character, characters.window(scene, character, poses), animator.memory_size)
    if config.stage1.start_timestep == 0:
        return state
    resting = state._replace(velocity=jnp.zeros_like(state.velocity))
    standing = motion_clips.standing(poses)
    settled, _ = take(animator, scene, character, resting, standing, config.stage1.start_timestep, config)
    return settled._replace(velocity=state.velocity, acceleration=state.acceleration, change=state.change)


def training_rollout(
    animator: Animator,
    scene: Scene,
    character: Character,
    state: ClothState,
    clips: Clips,
    frame: Array,
    fresh: Array,
    frames: int,
    config: Config,
    weigh: Callable[[dict[str, Array]], tuple[Array, dict[str, Array]]],
) -> tuple[Array, tuple[ClothState, dict, Any]]:
    """Roll out `frames` frames from a state and average their losses.

    A `fresh` state takes the quasi-static step first: the body stands, the step is long, and the state gets its first
    velocity back after it. Gradients reach back over `config.stage1.gradient_frames` frames.

    Args:
        weigh: from the energies of a step in J to the loss, and the energies to report.

    Returns:
        The mean loss; the last state, mean energies in J, and the animator's features of every frame.
    """

    def body(carry, index):
        state, frame, fresh = carry
        memory = state.latent
        state = _cut(state, index, config.stage1.gradient_frames)
        if animator.recurrent:
            state = state._replace(latent=memory)
        poses = motion_clips.poses(clips, frame)
        still = motion_clips.standing(poses)
        chosen = jax.tree.map(lambda a, b: jnp.where(fresh, a, b), still, poses)
        velocity = jnp.where(fresh, 0.0, state.velocity)
        timestep = jnp.where(fresh, config.stage1.start_timestep, 1.0 / config.fps)
        taken, (position, step, seen) = take(
            animator, scene, character, state._replace(velocity=velocity), chosen, timestep, config
        )
        loss, terms = weigh(incremental_potential.energies(position, step, scene.mesh, config.physics))
        taken = taken._replace(
            velocity=jnp.where(fresh, state.velocity, taken.velocity),
            acceleration=jnp.where(fresh, 0.0, taken.acceleration),
            change=jnp.where(fresh, 0.0, taken.change),
        )
        taken = follow(taken, chosen.translation[2])
        frame = jnp.where(fresh, frame, frame + 1)
        return (taken, frame, jnp.zeros_like(fresh)), (loss, terms, seen)

    (state, frame, fresh), (loss, terms, seen) = jax.lax.scan(body, (state, frame, fresh), jnp.arange(frames))
    terms = {name: jnp.mean(value) for name, value in terms.items()}
    return jnp.mean(loss), (jax.lax.stop_gradient(state), terms, jax.lax.stop_gradient(seen))


def _cut(state: ClothState, index: Array, frames: int) -> ClothState:
    """Return a state at a frame of a rollout, constant for gradients where `frames` of them have passed."""
    constant = jax.lax.stop_gradient(state)
    if frames == 1:  # known when traced: then nothing is differentiated only to be multiplied by zero
        return constant
    return jax.tree.map(lambda a, b: jnp.where(index % frames == 0, a, b), constant, state)


def play(animator: Animator, scene: Scene, character: Character, poses: Pose, config: Config) -> Track:
    """Roll out an animator autoregressively over a motion, from `settle` on.

    Args:
        poses: windows [T, 3, ...] of `motion_clips.poses`.
    """
    first = jax.tree.map(lambda x: x[0], poses)
    state = settle(animator, scene, character, first, config)

    def body(state, poses):
        following, position = advance(animator, scene, character, state, poses, config)
        return following, Track(position, state, following.latent)

    return jax.lax.scan(body, state, poses)[1]
