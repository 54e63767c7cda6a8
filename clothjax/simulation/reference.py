"""The reference solver frame by frame: the motion of the cloth by the same energies that train the networks."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import Config
from clothjax.physics import solver
from clothjax.physics.incremental_potential import TimeStep
from clothjax.physics.solver import SolverInfo
from clothjax.simulation import characters, time_step
from clothjax.simulation.characters import Character, Window
from clothjax.simulation.scene import Scene
from clothjax.types import Array, ClothState, Pose


class Problem(NamedTuple):
    """One time step to solve. Positions are relative to the root at the current frame."""

    step: TimeStep
    skinned: Array  # [V, 3] m, plain skinning at the next frame
    hold: Array  # [V, 3] m, persistence: the canonical displacement of the current frame at the next
    advance: Array  # [3] m, of the root


def problem(scene: Scene, config: Config) -> Callable[[Character, Array, Array, Pose, Array | None], Problem]:
    """Return a jitted function from a garment's last two frames to the `Problem` that the solver then solves.

    Its arguments are the character, the garment [V, 3] m at the previous and at the current frame, the window of poses
    (leading axis 3), and an external acceleration [3] m/s^2 or None. Each garment is relative to the root of its frame.
    """

    @jax.jit
    def state(character: Character, before: Array, now: Array, poses: Pose, external: Array | None = None) -> Problem:
        window = characters.window(scene, character, poses)
        velocity = now - (before + poses.translation[0][None])
        cloth = ClothState(now, velocity, jnp.zeros_like(now), *[jnp.zeros(0, now.dtype)] * 2)
        step = time_step.time_step(scene, character, cloth, window, 1.0 / config.fps, config, external)
        hold = characters.carried(now, window)
        lbs = characters.skinned(character, window.following)
        hold = jnp.where(scene.garment.pinned[:, None], lbs, hold)
        return Problem(step, lbs, hold, poses.translation[2])

    return state


def simulate(
    scene: Scene,
    character: Character,
    poses: Pose,
    config: Config,
    *,
    start: tuple[Array, Array] | None = None,
    external: Array | None = None,
    max_iterations: int = 500,
    progress: Callable[[int], None] = lambda _: None,
) -> tuple[np.ndarray, list[SolverInfo]]:
    """Simulate a garment over a motion with the reference solver, frame by frame.

    If the solve of a frame does not converge, its `SolverInfo` says so, and the next frame continues from its result.

    Args:
        poses: windows [T, 3, ...] of `motion_clips.poses`, one a frame.
        start: the garment [V, 3] m at the frame before the first and at the first, each relative to its root. By
            default it starts like Phi: skinned, then one long quasi-static step, whose info comes first.
        external: [T + 1, 3] m/s^2, an acceleration beside gravity in the step to each frame; the first is not used.
        max_iterations: most Newton iterations in a frame.
        progress: called with the number of finished frames.

    Returns:
        The garment [T + 1, V, 3] m relative to the root at every frame, and the outcome of each solve.
    """
    garment, infos = scene.garment, []
    state = problem(scene, config)

    def solve(guess: Array, step: TimeStep) -> np.ndarray:
        new, info = solver.solve_step(
            guess, step, scene.mesh, garment.pinned, config.physics, max_iterations=max_iterations
        )
        infos.append(info)
        return np.asarray(new, np.float32)

    if start is None:
        lbs, velocity, long_step = _quasi_static(scene, character, _at(poses, 0), config)
        now = solve(lbs, long_step)
        before = now - np.asarray(velocity) - np.asarray(poses.translation[0, 0])[None]
    else:
        before, now = (np.asarray(x, np.float32) for x in start)
    trajectory = [now]
    for frame in range(poses.translation.shape[0]):
        pushed = None if external is None else external[frame + 1]
        step, _, hold, advance = state(character, before, now, _at(poses, frame), pushed)
        before, now = now, solve(hold, step) - np.asarray(advance)[None]
        trajectory.append(now)
        progress(len(trajectory))
    return np.stack(trajectory), infos


def _quasi_static(scene: Scene, character: Character, poses: Pose, config: Config) -> tuple[Array, Array, TimeStep]:
    """Return a garment as skinned on the standing body, its velocity after the first step, and that long step."""

    @jax.jit
    def state(poses: Pose):
        window = characters.window(scene, character, poses)
        cloth = time_step.start(character, window, 0)
        still = Window(window.current, window.current, window.current)
        resting = cloth._replace(velocity=jnp.zeros_like(cloth.velocity))
        timestep = config.stage1.start_timestep or 1.0 / config.fps
        return cloth.position, cloth.velocity, time_step.time_step(scene, character, resting, still, timestep, config)

    return state(poses)


def _at(poses: Pose, frame: int) -> Pose:
    """Return the window of a frame."""
    return Pose(poses.rotations[frame], poses.translation[frame])
