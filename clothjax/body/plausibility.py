"""Checks of motion clips: the paths of the joints, and the frames at which a joint jumps."""

import numpy as np

from clothjax.types import Body, Motion


def kinematics(
    rotations: np.ndarray, path: np.ndarray, offsets: np.ndarray, parents: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return world rotations [T, J, 3, 3] and positions [T, J, 3] of joints, in float64.

    Args:
        rotations: [T, J, 3, 3] local.
        path: [T, 3] of the root.
        offsets: [J, 3] from the parents; that of the root is not used.
        parents: [J], -1 for the root; parents come first.
    """
    world, positions = np.array(rotations, np.float64), np.empty(rotations.shape[:3])
    for j, parent in enumerate(parents):
        if parent < 0:
            positions[:, j] = path
        else:
            world[:, j] = world[:, parent] @ world[:, j]
            positions[:, j] = positions[:, parent] + world[:, parent] @ offsets[j]
    return world, positions


def body_kinematics(motion: Motion, body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Return what `kinematics` does, of a body (betas 0) through a clip, in metres."""
    joints, parents = np.asarray(body.joints, np.float64), np.asarray(body.parents)
    path = joints[0] + np.asarray(motion.translation, np.float64)
    return kinematics(np.asarray(motion.rotations), path, joints - joints[np.maximum(parents, 0)], parents)


def joint_positions(motion: Motion, body: Body) -> np.ndarray:
    """Return world positions [T, J, 3] in metres of the body's joints (betas 0) through a clip."""
    return body_kinematics(motion, body)[1]


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
