"""How the joints of a recording are turned when its figure stands like a body: from where its joints are in the frames.

A file does not say which way is up, or that zero rotations are a T-pose. Both are read off its own positions.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from clothjax.body.plausibility import kinematics
from data_prep.recording import Capture
from data_prep.skeleton import SIDES, Parts, ancestors

AXES = {sign + axis: (1 - 2 * (sign == "-")) * np.eye(3)["xyz".index(axis)] for axis in "xyz" for sign in ("", "-")}
UPRIGHT = 0.6  # least cosine between the figure, on average over the frames, and the axis that is up
STRAIGHT = 40.0  # degrees, by which trunk and legs of a rest pose may be off the vertical
TWISTED, KNEES = 10.0, 25.0  # degrees, by which shoulders may be off the hips, and knees bent, in a rest pose
ALONG = 3.0  # degrees, by which a rest pose that faces along an axis may be off it
BENT = 0.15  # least sine of the angle of a knee or elbow that shows its hinge
LEVEL = 1 / 3  # of the height of a figure, by which its feet may be off the ground
SEEN = 0.05  # share of the frames in which knees are bent, that shows which way they do


class Figure(NamedTuple):
    """Positions [T, n, 3] and world rotations [T, n, 3, 3] of joints."""

    positions: np.ndarray
    rotations: np.ndarray

    def turned(self, turn: np.ndarray) -> "Figure":
        """Return the figure in other world axes, given as a rotation [3, 3]."""
        return Figure(self.positions @ turn.T, turn @ self.rotations)

    def bone(self, start: int, end: int) -> np.ndarray:
        """Return the directions [T, 3] from one joint to another."""
        return unit(self.positions[:, end] - self.positions[:, start])


def figure(capture: Capture, rotations: np.ndarray, path: np.ndarray) -> Figure:
    """Return where the joints of a recording are, with rotations [T, n, 3, 3] and a path [T, 3] of the root."""
    world, positions = kinematics(rotations, path, capture.offsets, capture.parents)
    return Figure(positions, world)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return the directions of vectors [..., 3]; zero for those without length."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), 0.0)


def upright(body: Figure, parts: Parts) -> np.ndarray:
    """Return the mean direction [3] from the feet to the head, at most of length 1."""
    feet = 0.5 * sum(body.positions[:, parts.limbs[f"{side} foot"]] for side in SIDES)
    return unit(body.positions[:, parts.chain[-1]] - feet).mean(axis=0)


def turn_upright(up: np.ndarray, forward: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation [3, 3] that makes an axis of the file +y, and another, if given, +z."""
    if forward is not None:
        return np.stack([np.cross(up, forward), up, forward])
    about = np.cross(up, [0.0, 1.0, 0.0])
    if np.linalg.norm(about) < 1e-9:
        return np.eye(3) if up[1] > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(0.5 * np.pi * about).as_matrix()


def up_axis(moving: Figure, parts: Parts, rest: str | None) -> str | None:
    """Return the axis of a file that points up, such as `z`; None if the frames do not say.

    A figure that crawls or lies is not upright; then the rest pose says it.

    Args:
        moving: all frames.
        parts: of the figure.
        rest: the axis that points up in its rest pose, of `is_rest_pose`.
    """
    mean = upright(moving, parts)
    name = max(AXES, key=lambda axis: float(mean @ AXES[axis]))
    if (rest is not None and mean @ AXES[rest] > 0.3) or mean @ AXES[name] < UPRIGHT:
        return rest
    return name


def may_lie(moving: Figure, parts: Parts, up: np.ndarray) -> bool:
    """Return whether a figure that is upright along a direction [3] does not stand at the zero of its file there."""
    head, feet = parts.chain[-1], [parts.limbs[f"{side} foot"] for side in SIDES]
    soles = (moving.positions[:, feet] @ up).min(axis=1)
    tall = np.median(np.abs(moving.positions[:, head] @ up - soles))
    return bool(np.median(np.abs(soles)) > LEVEL * tall)


def sides(moving: Figure, parts: Parts) -> str:
    """Say how left and right of a figure contradict its shape, as in a mirror or with swapped names; or nothing.

    Toes point to the front of a shin, knees bend to its back, and arms are on the side of their legs.
    """
    limbs, found = parts.limbs, []
    left = moving.bone(limbs["right thigh"], limbs["left thigh"])
    toes, knees = [], []
    for side in SIDES:
        thigh, shin, foot, toe = (limbs.get(f"{side} {part}") for part in ("thigh", "shin", "foot", "toe"))
        upper, lower = moving.bone(thigh, shin), moving.bone(shin, foot)
        knees.append(np.sum(np.cross(upper, lower) * left, axis=1))
        if toe is not None:
            toes.append(np.sum(np.cross(left, -lower) * moving.bone(foot, toe), axis=1))
    bent = np.abs(np.concatenate(knees)) > 2 * BENT
    if len(toes) and np.mean(toes) < 0:
        found.append("toes point backward")
    if bent.mean() > SEEN and np.concatenate(knees)[bent].mean() < 0:
        found.append("knees bend forward")
    arms = [limbs.get(f"{side} upper arm") for side in SIDES]
    if None not in arms and np.mean(np.sum(moving.bone(arms[1], arms[0]) * left, axis=1)) < 0:
        found.append("arms are on the other side than their legs")
    return " and ".join(found)


def is_rest_pose(resting: Figure, parts: Parts) -> str | None:
    """Return the axis that points up in a pose [1, n] in which a figure stands, arms apart, as in a T-pose, or None."""
    at = resting.positions[0]
    trunk = unit(at[parts.chain[-1]] - at[parts.hips])
    name = max(AXES, key=lambda axis: float(trunk @ AXES[axis]))
    up, limit = AXES[name], np.cos(np.radians(STRAIGHT))
    across = unit(at[parts.limbs["left thigh"]] - at[parts.limbs["right thigh"]])
    good = [trunk @ up > limit, abs(across @ up) < 0.3]
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        thigh, shin, foot = (at[parts.limbs[f"{side} {part}"]] for part in ("thigh", "shin", "foot"))
        good += [-unit(foot - thigh) @ up > limit, unit(shin - thigh) @ unit(foot - shin) > np.cos(np.radians(KNEES))]
        if f"{side} forearm" in parts.limbs:
            arm = unit(at[parts.limbs[f"{side} forearm"]] - at[parts.limbs[f"{side} upper arm"]])
            good += [sign * (arm @ across) > 0.15, abs(arm @ np.cross(across, up)) < 0.7]
    arms = [parts.limbs.get(f"{side} upper arm") for side in SIDES]
    if None not in arms:
        good.append(unit(at[arms[0]] - at[arms[1]]) @ across > np.cos(np.radians(TWISTED)))
    return name if all(good) else None


def rest_turn(resting: Figure, parts: Parts, up: str) -> np.ndarray:
    """Return the rotation [3, 3] that lets a rest pose stand along +y and face +z; if nearly so, that of the axes."""
    turn = turn_upright(AXES[up])
    across = turn @ resting.bone(parts.limbs["right thigh"], parts.limbs["left thigh"])[0]
    heading = np.degrees(np.arctan2(across[2], across[0]))
    return turn if abs(heading) < ALONG else Rotation.from_euler("y", heading, degrees=True).as_matrix() @ turn


def straightest(shown: Figure, parts: Parts) -> int:
    """Return the frame in which a figure with +y up stands most like a body at rest: trunk and legs straight."""
    limbs = parts.limbs
    left = shown.bone(limbs["right thigh"], limbs["left thigh"])
    bones = [shown.bone(parts.hips, parts.chain[-1])[:, 1]]
    for side in SIDES:
        thigh, shin, foot = (limbs[f"{side} {part}"] for part in ("thigh", "shin", "foot"))
        bones += [-shown.bone(thigh, shin)[:, 1], -shown.bone(shin, foot)[:, 1]]
        if f"{side} forearm" in limbs:
            bones.append(-0.2 * shown.bone(limbs[f"{side} upper arm"], limbs[f"{side} forearm"])[:, 1])
    if "left upper arm" in limbs and "right upper arm" in limbs:
        bones.append(np.sum(left * shown.bone(limbs["right upper arm"], limbs["left upper arm"]), axis=1))
    return int(np.sum(bones, axis=0).argmax())


def standing(shown: Figure, resting: Figure, parents: np.ndarray, parts: Parts, frame: int) -> np.ndarray:
    """Return world rotations [n, 3, 3] of the joints of a figure in a T-pose, facing +z, from its frames.

    The trunk is straight: where its joints are not turned, or if it is not so then, in a frame. Arms point sideways,
    legs down. Knees and elbows say how they are turned about that: they bend one way only. Any other joint is turned on
    its parent as in that frame.

    Args:
        shown: all frames, +y up.
        resting: the pose without any rotation, of which the offsets between joints are used.
        parents: [n].
        parts: of the figure.
        frame: in which it stands straight.
    """
    then = Figure(shown.positions[[frame]], shown.rotations[[frame]])
    limbs, turned = parts.limbs, _trunk(then, resting, parts)
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        arm = [limbs.get(f"{side} {part}") for part in ("upper arm", "forearm", "hand")]
        turned |= _limb(shown, arm, np.array([sign, 0, 0]), np.array([0, -sign, 0]))
        leg = [limbs.get(f"{side} {part}") for part in ("thigh", "shin", "foot")]
        turned |= _limb(shown, leg, np.array([0, -1.0, 0]), np.array([1.0, 0, 0]))
    result = np.tile(np.eye(3), (len(parents), 1, 1))
    for j, parent in enumerate(parents):
        if j in turned:
            result[j] = turned[j]
        elif parent >= 0:
            result[j] = result[parent] @ then.rotations[0, parent].T @ then.rotations[0, j]
    return result


def _trunk(shown: Figure, resting: Figure, parts: Parts) -> dict[int, np.ndarray]:
    """Return the world rotations of the joints from the hips to the head in a T-pose."""
    chain, limbs = parts.chain, parts.limbs
    ends = [limbs.get(f"{side} clavicle", limbs.get(f"{side} upper arm")) for side in SIDES]
    upright_pose = basis(np.array([0.0, 1, 0]), np.array([1.0, 0, 0]))
    line = resting.bone(parts.hips, chain[-1])[0]
    across = resting.bone(limbs["right thigh"], limbs["left thigh"])[0]
    bones = [resting.bone(a, b)[0] for a, b in zip(chain, chain[1:], strict=False)]
    straight = all(bone @ line > np.cos(np.radians(STRAIGHT)) for bone in bones) and abs(line @ across) < 0.3
    if straight and None not in ends:
        straight = resting.bone(ends[1], ends[0])[0] @ across > np.cos(np.radians(TWISTED))
    if straight:
        return dict.fromkeys(chain, upright_pose @ basis(line, across).T)
    hips = shown.bone(limbs["right thigh"], limbs["left thigh"])
    shoulders = hips if None in ends else shown.bone(ends[1], ends[0])
    lines, turned = shown.bone(parts.hips, chain[-1]), {}
    for k, joint in enumerate(chain):
        share = min(k / max(len(parts.spine), 1), 1.0)
        own = np.swapaxes(shown.rotations[:, joint], -1, -2)
        local = [np.einsum("tab,tb->a", own, x) for x in (lines, (1 - share) * hips + share * shoulders)]
        turned[joint] = upright_pose @ basis(*local).T
    return turned


def _limb(shown: Figure, joints: list[int | None], along: np.ndarray, hinge: np.ndarray) -> dict[int, np.ndarray]:
    """Return the world rotations of a limb's first two joints in a T-pose, if its hinge is seen.

    Args:
        joints: where it begins, its knee or elbow, and where it ends.
        along, hinge: [3] of the limb in a T-pose; it bends about the hinge.
    """
    if None in joints:
        return {}
    start, middle, end = (joint for joint in joints if joint is not None)
    bones = {start: shown.bone(start, middle), middle: shown.bone(middle, end)}
    axis = np.cross(bones[start], bones[middle])
    if np.linalg.norm(axis, axis=1).max() < BENT:
        return {}
    turned = {}
    for joint, bone in bones.items():
        own = np.swapaxes(shown.rotations[:, joint], -1, -2)
        local = [np.einsum("tab,tb->a", own, vectors) for vectors in (bone, axis)]
        turned[joint] = basis(along, hinge) @ basis(*local).T
    return turned


def basis(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] whose columns are a direction, the part of another across it, and both's product."""
    along = unit(along)
    across = unit(across - (across @ along) * along)
    return np.stack([along, across, np.cross(along, across)], axis=1)


def to_t_pose(joints: np.ndarray, parents: np.ndarray, known: dict[str, int]) -> np.ndarray:
    """Return rotations [J, 3, 3] to a T-pose: arms to the sides, legs down, what hangs on a hand as its forearm.

    Args:
        joints: [J, 3] m, of a body that faces +z, as it stands.
        parents: [J].
        known: of `skeleton.landmarks`.
    """
    turns = np.tile(np.eye(3), (len(joints), 1, 1))
    for side, out in (("Left", [1.0, 0, 0]), ("Right", [-1.0, 0, 0])):
        for bone, end, goal in (
            ("Arm", "ForeArm", out),
            ("ForeArm", "Hand", out),
            ("UpLeg", "Leg", [0, -1.0, 0]),
            ("Leg", "Foot", [0, -1.0, 0]),
        ):
            if side + end in known:
                along = joints[known[side + end]] - joints[known[side + bone]]
                turns[known[side + bone]] = Rotation.align_vectors([goal], along[None])[0].as_matrix()
        hand = known.get(f"{side}Hand")
        for joint in range(len(joints)) if hand is not None else ():
            if hand in ancestors(joint, parents):
                turns[joint] = turns[known[f"{side}ForeArm"]]
    return turns
