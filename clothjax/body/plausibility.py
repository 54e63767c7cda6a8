"""Checks of motion clips: the paths of the joints, and the frames at which a joint jumps."""

import numpy as np

from clothjax.types import Body, Motion


def joint_positions(motion: Motion, body: Body) -> np.ndarray:
    """Return world positions [T, J, 3] in metres of the body's joints (betas 0) through a clip."""
    local = np.asarray(motion.rotations, np.float64)
    joints, parents = np.asarray(body.joints, np.float64), np.asarray(body.parents)
    rotations, positions = np.empty_like(local), np.empty(local.shape[:3])
    for j, parent in enumerate(parents):
        if parent < 0:
            rotations[:, j] = local[:, j]
            positions[:, j] = joints[j] + np.asarray(motion.translation, np.float64)
        else:
            rotations[:, j] = rotations[:, parent] @ local[:, j]
            positions[:, j] = positions[:, parent] + rotations[:, parent] @ (joints[j] - joints[parent])
    return positions


def bad_frames(motion: Motion, body: Body, limit: float = 0.12) -> np.ndarray:
    """Find frames through which no body could have moved: a joint's position has too large a second difference.

    Args:
        limit: m per frame^2 at 30 fps; scaled by (30 / fps)^2 for another rate. 0.12 is 11 g.

    Returns:
        Indices of the middle frames, ascending. Training leaves out windows that contain one.
    """
    second = np.diff(joint_positions(motion, body), n=2, axis=0)
    largest = np.linalg.norm(second, axis=-1).max(axis=-1)
    return np.flatnonzero(largest > limit * (30.0 / motion.fps) ** 2) + 1
