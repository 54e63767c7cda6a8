"""A character goes where it is told, smoothly, and does what is asked."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clothjax.body import motion_matching
from clothjax.files import storage
from clothjax.types import Motion

NAMES = [f"{family}_{i}" for family in ("walk", "run", "arms", "jump") for i in range(2)]
WANDER = ("walk", "run", "arms")


@pytest.fixture(scope="module")
def clips():
    body, names = storage.load_rig("body")
    motions = {name: storage.load_motion(name, names) for name in NAMES}
    return motion_matching.library(motions, np.asarray(body.joints), body.parents, names)


def played(player, wishes, family=None):
    poses = [player.step(wish, family=family) for wish in wishes]
    return np.stack([p.rotations for p in poses]), np.stack([p.translation for p in poses])


def turning(after, before):
    """Angles [..., ] rad between rotation matrices."""
    matrices = np.swapaxes(before, -1, -2) @ after
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).magnitude().reshape(matrices.shape[:-2])


@pytest.mark.parametrize("angle", [0.0, 1.2, 3.0, -2.0])
@pytest.mark.parametrize("speed, least, most", [(1.3, 1.1, 1.5), (2.8, 2.4, 3.2)])
def test_it_goes_where_it_is_told(clips, angle, speed, least, most):
    player = motion_matching.Player(clips, WANDER)
    wish = speed * np.array([np.sin(angle), np.cos(angle)])
    _, places = played(player, [wish] * 150)
    moved = (places[-1] - places[-31])[[0, 2]]
    assert least < np.linalg.norm(moved) < most
    assert moved @ wish > np.cos(np.radians(8)) * np.linalg.norm(moved) * speed
    _, places = played(player, [np.zeros(2)] * 90)
    assert np.linalg.norm(places[-1] - places[-31]) < 0.1


def test_no_joint_turns_much_faster_than_in_the_clips_however_it_is_steered(clips):
    player, random = motion_matching.Player(clips, WANDER), np.random.default_rng(0)
    wishes, families = [], []
    while len(wishes) < 1800:
        speed, angle = random.choice([0.0, 1.3, 2.8]), random.uniform(-np.pi, np.pi)
        held = int(random.integers(3, 60))
        wishes += [speed * np.array([np.sin(angle), np.cos(angle)])] * held
        families += [random.choice([None, None, None, "jump"])] * held
    poses = [player.step(wish, family=family) for wish, family in zip(wishes, families)]
    rotations = np.stack([p.rotations for p in poses])
    places = np.stack([p.translation for p in poses])
    assert np.isfinite(rotations).all() and np.isfinite(places).all()
    products = rotations @ np.swapaxes(rotations, -1, -2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-5)
    speeds = clips.fps * turning(rotations[1:, 1:], rotations[:-1, 1:])
    assert (speeds <= motion_matching.TURN_RATE_FACTOR * clips.fastest[1:] + 1e-2).all()
    heading = clips.fps * turning(rotations[1:, 0], rotations[:-1, 0])
    most = motion_matching.STEER + motion_matching.TURN_RATE_FACTOR * clips.fastest[0] + np.abs(clips.turn).max()
    assert heading.max() < most + 1e-2
    assert clips.fps * np.abs(np.diff(places, axis=0)).max() < 6.0
    assert places[:, 1].min() > clips.root[:, 1].min() - 0.1 and places[:, 1].max() < clips.root[:, 1].max() + 0.1


def test_it_turns_on_the_spot(clips):
    player = motion_matching.Player(clips, WANDER)
    for _ in range(120):
        pose = player.step(np.zeros(2), 2.0)
    # with a step or two
    assert abs(player.heading - 2.0) < 0.1 and np.linalg.norm(pose.translation[[0, 2]]) < 0.7
    facing = pose.rotations[0] @ [0.0, 0.0, 1.0]
    assert abs(np.arctan2(facing[0], facing[2]) - 2.0) < 0.3


def test_it_jumps_when_asked_and_only_then(clips):
    player = motion_matching.Player(clips, WANDER)
    _, before = played(player, [np.zeros(2)] * 60)
    _, during = played(player, [np.zeros(2)] * 120, "jump")
    _, after = played(player, [np.zeros(2)] * 90)
    assert during[:, 1].max() - before[:, 1].max() > 0.2
    assert after[30:, 1].max() - before[:, 1].max() < 0.05
    with pytest.raises(ValueError, match="no clips called 'swim': there are walk, run, arms, jump"):
        player.step(np.zeros(2), family="swim")


@pytest.mark.parametrize("root", [(0.0, 0.0, 0.0), (0.2, -0.1, 0.3)])
def test_it_does_the_same_elsewhere(root):
    """Nothing depends on where it is, which way it faces, or where a body has its root joint."""
    body, names = storage.load_rig("body")
    motions = {name: storage.load_motion(name, names) for name in ("walk_0", "arms_0")}
    joints = np.asarray(body.joints) + np.array(root)
    clips = motion_matching.library(motions, joints, body.parents, names)
    one, other = (motion_matching.Player(clips) for _ in range(2))
    other.heading, other.place = 1.0, np.array([5.0, -3.0])
    turn = Rotation.from_rotvec([0, 1.0, 0]).as_matrix()
    wishes = np.array([[0.0, 1.3]] * 40 + [[1.3, 0.0]] * 40 + [[0.0, 0.0]] * 40)
    here, places = played(one, wishes)
    there, elsewhere = played(other, (np.stack([wishes[:, 0], 0 * wishes[:, 0], wishes[:, 1]], 1) @ turn.T)[:, [0, 2]])
    np.testing.assert_allclose(turn @ here[:, 0], there[:, 0], atol=1e-4)
    np.testing.assert_allclose(here[:, 1:], there[:, 1:], atol=1e-4)
    hips, other_hips = places + joints[0], elsewhere + joints[0]
    np.testing.assert_allclose(hips @ turn.T + [5.0, 0.0, -3.0], other_hips, atol=1e-3)


def test_clips_that_do_not_belong_together_are_refused():
    body, names = storage.load_rig("body")
    walk = storage.load_motion("walk_0", names)
    given = (np.asarray(body.joints), body.parents)
    with pytest.raises(ValueError, match="at least one clip"):
        motion_matching.library({}, *given, names)
    short = Motion(walk.rotations[:10], walk.translation[:10], walk.fps)
    with pytest.raises(ValueError, match=r"short has 10 frames at 30\.0 a second"):
        motion_matching.library({"walk": walk, "short": short}, *given, names)
    with pytest.raises(ValueError, match="no feet among the joints"):
        motion_matching.library({"walk": walk}, *given, [f"joint_{i}" for i in range(len(names))])
