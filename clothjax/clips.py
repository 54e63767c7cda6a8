"""Motion clips laid end to end on the device, and the windows of poses that training and evaluation read."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from clothjax.types import Array, Motion, Pose


class Clips(NamedTuple):
    """Clips of N frames in all. Only steps of the root are kept: the scene has no place in the world."""

    rotations: Array  # [N, J, 3, 3]
    advance: Array  # [N, 3] m, translation of the next frame minus this one's; zero at a clip's end
    remaining: Array  # [N] int32, steps that can be taken from a frame before an unusable one
    chance: Array  # [N] cumulative probability of starting at a frame


def concatenate(motions: Sequence[Motion], families: Sequence[str], bad: Sequence[np.ndarray], shortest: int) -> Clips:
    """Clips for training.

    Args:
        motions: with the same joints and rate.
        families: one name a motion; every family is started from equally often, however long its clips are.
        bad: frames of each motion that must not be in any window.
        shortest: steps that must remain at a start.

    Raises:
        ValueError: if no frame can be started from.
    """
    rotations, advance, remaining = [], [], []
    for motion, wrong in zip(motions, bad):
        frames = len(motion.translation)
        usable = np.ones(frames, bool)
        usable[np.asarray(wrong, int)] = False
        inside = np.zeros(frames, bool)
        inside[1:-1] = usable[:-2] & usable[1:-1] & usable[2:]
        left = np.zeros(frames + 1, np.int32)
        for t in range(frames - 1, -1, -1):
            left[t] = left[t + 1] + 1 if inside[t] else 0
        rotations.append(np.asarray(motion.rotations, np.float32))
        step = np.zeros((frames, 3))
        step[:-1] = np.diff(np.asarray(motion.translation, np.float64), axis=0)
        advance.append(step.astype(np.float32))
        remaining.append(left[:frames])
    weight = [(left >= shortest).astype(np.float64) for left in remaining]
    for family in set(families):
        members = [i for i, name in enumerate(families) if name == family]
        total = sum(weight[i].sum() for i in members)
        for i in members:
            weight[i] = weight[i] / max(total, 1)
    chance = np.cumsum(np.concatenate(weight)) if weight else np.zeros(1)
    if chance[-1] <= 0:
        raise ValueError(
            f"no motion has {shortest + 2} usable frames in a row: give longer clips, or repair the bad frames"
        )
    return Clips(
        rotations=np.concatenate(rotations),
        advance=np.concatenate(advance),
        remaining=np.concatenate(remaining),
        chance=(chance / chance[-1]).astype(np.float32),
    )


def draw(clips: Clips, uniform: Array) -> Array:
    """A start frame for a number in [0, 1)."""
    last = clips.chance.shape[0] - 1
    return jnp.minimum(jnp.searchsorted(clips.chance, uniform, side="right"), last).astype(jnp.int32)


def poses(clips: Clips, frame: Array) -> Pose:
    """Previous, current and following pose of a frame (leading axis 3), translations relative to the current's."""
    before = clips.advance[frame - 1]
    translation = jnp.stack([-before, jnp.zeros_like(before), clips.advance[frame]])
    return Pose(clips.rotations[frame + jnp.arange(-1, 2)], translation)


def standing(poses: Pose) -> Pose:
    """The current pose of a window three times: the body holds still."""
    return Pose(jnp.broadcast_to(poses.rotations[1:2], poses.rotations.shape), jnp.zeros_like(poses.translation))
