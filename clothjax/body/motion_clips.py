"""Motion clips laid end to end on the device, and the windows of poses that training and evaluation read."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.types import Array, Motion, Pose


class Clips(NamedTuple):
    """Clips laid end to end, N frames in all. Of the root only steps are stored: a scene has no place in the world."""

    rotations: Array  # [N, J, 3, 3] local to the parent
    advance: Array  # [N, 3] m, translation of the next frame minus this one's; zero at a clip's end
    remaining: Array  # [N] int32, how many frames in a row, from this one on, have a usable window
    passed: Array  # [N] int32, the same backwards, up to this one
    chance: Array  # [N] cumulative probability of starting at a frame


def concatenate(motions: Sequence[Motion], families: Sequence[str], bad: Sequence[np.ndarray], shortest: int) -> Clips:
    """Lay motions end to end, and compute at which frames a simulation may start and how likely.

    Args:
        motions: with the same joints and rate.
        families: one name a motion; every family gets equally many starts, however long its clips are.
        bad: for each motion the indices of frames that no window may contain.
        shortest: frames with a usable window that must follow in a row, the start included.

    Raises:
        ValueError: if no frame can be a start.
    """
    rotations, advance, remaining, passed = [], [], [], []
    for motion, wrong in zip(motions, bad, strict=True):
        frames = len(motion.translation)
        usable = np.ones(frames, bool)
        usable[np.asarray(wrong, int)] = False
        inside = np.zeros(frames, bool)
        inside[1:-1] = usable[:-2] & usable[1:-1] & usable[2:]
        left, behind = np.zeros(frames + 1, np.int32), np.zeros(frames + 1, np.int32)
        for t in range(frames):
            behind[t] = behind[t - 1] + 1 if inside[t] else 0
        for t in range(frames - 1, -1, -1):
            left[t] = left[t + 1] + 1 if inside[t] else 0
        rotations.append(np.asarray(motion.rotations, np.float32))
        step = np.zeros((frames, 3))
        step[:-1] = np.diff(np.asarray(motion.translation, np.float64), axis=0)
        advance.append(step.astype(np.float32))
        remaining.append(left[:frames])
        passed.append(behind[:frames])
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
        passed=np.concatenate(passed),
        chance=(chance / chance[-1]).astype(np.float32),
    )


def draw(clips: Clips, uniform: Array) -> Array:
    """Return the start frame (int32, of N) that a uniform random number in [0, 1) selects by `clips.chance`."""
    last = clips.chance.shape[0] - 1
    return jnp.minimum(jnp.searchsorted(clips.chance, uniform, side="right"), last).astype(jnp.int32)


def poses(clips: Clips, frame: Array | int) -> Pose:
    """Return the window of a frame: the previous, the current and the following pose.

    Args:
        frame: of the N in `clips`.

    Returns:
        Local rotations [3, J, 3, 3], and translations [3, 3] m relative to that of the current frame.
    """
    before = clips.advance[frame - 1]
    translation = jnp.stack([-before, jnp.zeros_like(before), clips.advance[frame]])
    return Pose(clips.rotations[frame + jnp.arange(-1, 2)], translation)


def there_and_back(clips: Clips, frame: Array | int, count: int) -> Pose:
    """Return the windows of `count` frames in a row, from a frame on; where its clip ends, the motion runs backwards.

    Args:
        frame: of the N in `clips`, the first of them.

    Returns:
        Rotations [count, 3, J, 3, 3] and translations [count, 3, 3] m, each window as `poses` gives it.
    """
    # from the frame before the first that has a window to the one after the last
    first, period = frame - clips.passed[frame], clips.passed[frame] + clips.remaining[frame]
    along = jnp.abs((frame - first + jnp.arange(-1, count + 1)) % (2 * period) - period)
    frames = first + period - along

    def window(index):
        before, now, after = frames[index], frames[index + 1], frames[index + 2]
        back = _advance(clips, now, before)
        translation = jnp.stack([back, jnp.zeros_like(back), _advance(clips, now, after)])
        return Pose(clips.rotations[jnp.stack([before, now, after])], translation)

    return jax.vmap(window)(jnp.arange(count))


def _advance(clips: Clips, start: Array, end: Array) -> Array:
    """The root's step [3] m between neighbouring frames."""
    return jnp.where(end > start, clips.advance[start], -clips.advance[end])


def standing(poses: Pose) -> Pose:
    """Return a window (leading axis 3) that has the current pose of another three times: a body that holds still."""
    return Pose(jnp.broadcast_to(poses.rotations[1:2], poses.rotations.shape), jnp.zeros_like(poses.translation))
