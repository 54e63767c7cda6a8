"""Doubts about a motion, in words: it shows something that is hardly meant, and the user is told."""

import numpy as np

from clothjax.body.plausibility import joint_positions
from clothjax.types import Body, Motion
from data_prep import skeleton
from data_prep.rest_pose import unit

FASTEST = 15.0  # m/s of a joint
AFLOAT, LONGEST_LEAP = 0.3, 1.0  # m above the ground of the lowest joint, for so many s
LYING = 0.5  # cosine between trunk and vertical, below which it lies or crawls
GROUND = 0.35  # m, by which the ground of a recording may be off its zero


def doubts(motion: Motion, body: Body, names: tuple[str, ...]) -> list[str]:
    """Return a line for each doubt about a motion that stands on y = 0: too fast, afloat, or never upright.

    Args:
        motion: of the body.
        body: that moves.
        names: of its joints, as CMU's or SMPL's.
    """
    positions, told = joint_positions(motion, body), []
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=-1) * motion.fps
    fast = np.flatnonzero(speed.max(axis=1) > FASTEST)
    if len(fast):
        joint = names[int(speed.max(axis=0).argmax())]
        told.append(f"{joint} moves at up to {speed.max():.0f} m/s, over {FASTEST:.0f} in frames {_stretches(fast)}")
    afloat = np.flatnonzero(positions[:, :, 1].min(axis=1) > AFLOAT)
    long = [stretch for stretch in _runs(afloat) if len(stretch) > LONGEST_LEAP * motion.fps]
    if long:
        frames = _stretches(np.concatenate(long))
        told.append(f"no foot is within {AFLOAT} m of the ground in frames {frames}: is the path in the same axes?")
    chain = skeleton.find(skeleton.cmu_names(names), body.parents, "the body").chain
    upright = unit(positions[:, chain[-1]] - positions[:, chain[0]])[:, 1]
    if (upright < LYING).mean() > 0.9:
        told.append(f"the figure lies or crawls from frame 0 to {len(upright) - 1}: is --up right?")
    return told


def ground(height: float) -> list[str]:
    """Return a doubt about a recording whose ground is at a height of the file, in m of the body."""
    if abs(height) < GROUND:
        return []
    return [
        f"the feet are {abs(height):.2f} m {'above' if height > 0 else 'below'} the zero of the file: is its path in "
        "the same unit and axes as its skeleton?"
    ]


def _runs(frames: np.ndarray) -> list[np.ndarray]:
    """Return the runs of consecutive numbers among ascending ones."""
    return np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1) if len(frames) else []


def _stretches(frames: np.ndarray) -> str:
    """Return ascending numbers in words, such as `3 to 9, 12`."""
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in _runs(frames))
