"""Frames of a recording in which no body could have moved so: named, and repaired or left out if asked."""

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from clothjax.body.plausibility import bad_frames
from clothjax.types import Body, Motion

Bad = Literal["keep", "repair", "drop"]
ROUNDS = 6  # of repairing, each a frame wider
MOST = 0.2  # of the frames may be repaired


def mend(motion: Motion, body: Body, how: Bad) -> tuple[Motion, str]:
    """The motion, and what there was to say of its bad frames.

    Args:
        how: `keep` them (training leaves out what is around them), `repair` them by interpolation between the frames
            around them, or `drop` all but the longest stretch without any.

    Raises:
        ValueError: if so many are bad that neither can be done.
    """
    bad = bad_frames(motion, body)
    if len(bad) == 0:
        return motion, "no implausible frames"
    named = f"implausible frames {bad.tolist()}"
    if how == "repair":
        return repaired(motion, body), f"{named}, repaired"
    if how == "drop":
        start, end = longest(bad, len(motion.translation))
        part = Motion(motion.rotations[start:end], motion.translation[start:end], motion.fps)
        return part, f"{named}; kept: {start} to {end - 1}"
    return motion, f"{named}: --bad repair interpolates them, --bad drop leaves them out"


def repaired(motion: Motion, body: Body) -> Motion:
    """The bad frames interpolated between those around them, as many more of these as it takes."""
    count, bad = len(motion.translation), bad_frames(motion, body)
    wrong, mended = np.zeros(count, bool), motion
    for _ in range(ROUNDS):
        wrong[bad] = True
        if mended is not motion:
            wrong |= np.r_[wrong[1:], False] | np.r_[False, wrong[:-1]]
        good = np.flatnonzero(~wrong)
        if len(good) < (1 - MOST) * count:
            raise ValueError(
                f"{len(bad_frames(motion, body))} of {count} frames are implausible, too many to repair: drop them"
            )
        times = np.clip(np.arange(count), good[0], good[-1])
        rotations = np.stack(
            [
                Slerp(good, Rotation.from_matrix(motion.rotations[good, joint]))(times).as_matrix()
                for joint in range(motion.rotations.shape[1])
            ],
            axis=1,
        )
        path = np.stack([np.interp(times, good, x) for x in np.asarray(motion.translation)[good].T], axis=1)
        keep = ~wrong
        mended = Motion(
            np.where(keep[:, None, None, None], motion.rotations, rotations).astype(np.float32),
            np.where(keep[:, None], motion.translation, path),
            motion.fps,
        )
        bad = bad_frames(mended, body)
        if len(bad) == 0:
            return mended
    raise ValueError(
        f"frames {bad_frames(motion, body).tolist()} are implausible, and what is before and after them too far apart "
        "to be joined: drop them"
    )


def longest(bad: np.ndarray, count: int) -> tuple[int, int]:
    """Where the longest stretch without a bad frame begins and ends.

    Raises:
        ValueError: if it has fewer than three frames.
    """
    ends = np.concatenate([[-1], bad, [count]])
    widest = int(np.diff(ends).argmax())
    start, end = int(ends[widest]) + 1, int(ends[widest + 1])
    if end - start < 3:
        raise ValueError(f"{len(bad)} of {count} frames are implausible: no three good ones are left in a row")
    return start, end
