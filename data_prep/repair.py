"""Treatment of frames with a movement that no body can make: they are named, and repaired or left out if asked."""

from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from clothjax.body.plausibility import bad_frames
from clothjax.types import Body, Motion

Bad = Literal["keep", "repair", "drop"]
REPAIR_ROUNDS = 6  # each widens the repaired stretch by a frame on either side
MAX_REPAIRED = 0.2  # share of the frames


def mend(motion: Motion, body: Body, how: Bad) -> tuple[Motion, str]:
    """Treat the implausible frames of a motion.

    Args:
        motion: to treat.
        body: that it moves.
        how: `keep` them (training leaves out the windows around them), `repair` them by interpolation between the
            frames around them, or `drop` all but the longest stretch without any.

    Returns:
        The motion, and a report in words.

    Raises:
        ValueError: if too many frames are bad to repair or drop them.
    """
    bad = bad_frames(motion, body)
    if len(bad) == 0:
        return motion, "no implausible frames"
    report = f"implausible frames {bad.tolist()}"
    if how == "repair":
        return repaired(motion, body), f"{report}, repaired"
    if how == "drop":
        start, end = longest(bad, len(motion.translation))
        part = Motion(motion.rotations[start:end], motion.translation[start:end], motion.fps)
        return part, f"{report}; kept: {start} to {end - 1}"
    return motion, f"{report}: --bad repair interpolates them, --bad drop leaves them out"


def repaired(motion: Motion, body: Body) -> Motion:
    """Interpolate the bad frames from the good ones around them, widening the stretch as far as needed.

    Raises:
        ValueError: if too many frames are bad, or the good ones are too far apart.
    """
    count, bad = len(motion.translation), bad_frames(motion, body)
    replaced, mended = np.zeros(count, bool), motion
    for _ in range(REPAIR_ROUNDS):
        replaced[bad] = True
        if mended is not motion:
            replaced |= np.r_[replaced[1:], False] | np.r_[False, replaced[:-1]]
        good = np.flatnonzero(~replaced)
        if len(good) < (1 - MAX_REPAIRED) * count:
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
        mended = Motion(
            np.where(replaced[:, None, None, None], rotations, motion.rotations).astype(np.float32),
            np.where(replaced[:, None], path, motion.translation),
            motion.fps,
        )
        bad = bad_frames(mended, body)
        if len(bad) == 0:
            return mended
    raise ValueError(
        f"frames {bad_frames(motion, body).tolist()} are implausible, and the frames before and after them are too far "
        "apart to be joined: drop them"
    )


def longest(bad: np.ndarray, count: int) -> tuple[int, int]:
    """Return the first frame of the longest stretch without a bad frame, and the one after its last.

    Raises:
        ValueError: if the stretch has fewer than three frames.
    """
    ends = np.concatenate([[-1], bad, [count]])
    widest = int(np.diff(ends).argmax())
    start, end = int(ends[widest]) + 1, int(ends[widest + 1])
    if end - start < 3:
        raise ValueError(f"{len(bad)} of {count} frames are implausible: no three good ones are left in a row")
    return start, end
