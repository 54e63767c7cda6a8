"""Which frames are called implausible, and where joints are."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clothjax.body import plausibility
from clothjax.types import Body, Motion

JOINTS = np.array([[0, 0, 0], [0, 0.5, 0], [0, 1, 0]], np.float32)
BODY = Body(
    vertices=JOINTS,
    faces=np.array([[0, 1, 2]], np.int32),
    joints=JOINTS,
    parents=np.array([-1, 0, 1], np.int32),
    weights=np.eye(3, dtype=np.float32),
    shapedirs=np.zeros((3, 3, 2), np.float32),
    joint_shapedirs=np.zeros((3, 3, 2), np.float32),
)


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_bad_frames_are_those_of_a_jump_in_place(fps):
    """Free fall at 9.81 m/s^2 is fine at any rate; a 20 cm jump is seen at the two frames beside it."""
    time = np.arange(40) / fps
    translation = np.stack([0 * time, 1 - 0.5 * 9.81 * time**2, 0 * time], axis=1)
    still = Motion(np.tile(np.eye(3, dtype=np.float32), (40, 3, 1, 1)), translation, fps)
    assert plausibility.bad_frames(still, BODY).size == 0
    jumped = still._replace(translation=translation + 0.2 * (np.arange(40) >= 17)[:, None])
    np.testing.assert_array_equal(plausibility.bad_frames(jumped, BODY), [16, 17])


def test_joint_positions_turn_about_their_parents():
    rotations = np.tile(np.eye(3), (1, 3, 1, 1))
    rotations[0, 0] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    rotations[0, 1] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    motion = Motion(rotations, np.array([[1.0, 2.0, 3.0]]), 30.0)
    expected = [[1, 2, 3], [1, 2, 3.5], [0.5, 2, 3.5]]  # the second turns about the root's z, which points down
    np.testing.assert_allclose(plausibility.joint_positions(motion, BODY)[0], expected, atol=1e-12)
