"""Retargeting of a motion to a body with other bones and another canonical pose.

World rotations of the joints are copied by name. Bones of arms and legs are first aligned with the source's rest pose,
so that an A-pose and a T-pose agree. The root's path is scaled by the length of a leg.
"""

from collections.abc import Iterator
from gzip import open as open_gzip
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from clothjax.body.plausibility import joint_positions
from clothjax.types import Body, Motion

CMU_FROM_SMPL = {
    "pelvis": "Hips",
    "spine1": "LowerBack",
    "spine2": "Spine",
    "spine3": "Spine1",
    "neck": "Neck",
    "head": "Head",
    "left_collar": "LeftShoulder",
    "left_shoulder": "LeftArm",
    "left_elbow": "LeftForeArm",
    "left_wrist": "LeftHand",
    "left_hip": "LeftUpLeg",
    "left_knee": "LeftLeg",
    "left_ankle": "LeftFoot",
    "left_foot": "LeftToeBase",
    "right_collar": "RightShoulder",
    "right_shoulder": "RightArm",
    "right_elbow": "RightForeArm",
    "right_wrist": "RightHand",
    "right_hip": "RightUpLeg",
    "right_knee": "RightLeg",
    "right_ankle": "RightFoot",
    "right_foot": "RightToeBase",
}
_LIMBS = (("UpLeg", "Leg"), ("Leg", "Foot"), ("Foot", "ToeBase"), ("Arm", "ForeArm"), ("ForeArm", "Hand"))
ALIGNED = {f"{side}{a}": f"{side}{b}" for side in ("Left", "Right") for a, b in _LIMBS}  # joint: end of its bone
FROZEN = ("Hand", "Finger", "Thumb", "Toe")


class Capture(NamedTuple):
    """A recorded motion of a skeleton in any unit of length."""

    names: tuple[str, ...]  # CMU's for joints that CMU has
    parents: np.ndarray  # [n] root first with -1, parents before children
    offsets: np.ndarray  # [n, 3] from the parent, in the rest pose
    rotations: np.ndarray  # [T, n, 3, 3] local to the parent, identity in the rest pose
    translation: np.ndarray  # [T, 3] of the root
    fps: float


def cmu_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return joint names with SMPL's replaced by CMU's."""
    return tuple(CMU_FROM_SMPL.get(n, n) for n in names)


def retarget(
    capture: Capture,
    body: Body,
    names: tuple[str, ...],
    *,
    fps: float = 30.0,
    abduct: float = 0.0,
    drop_clavicles: float = 0.0,
    freeze: bool = True,
) -> Motion:
    """Retarget a recording onto a body's joints, starting above the origin and standing on y = 0.

    Args:
        capture: the recording.
        body: to move.
        names: of its joints, CMU's or SMPL's.
        fps: frames per second of the result; rotations between two frames are interpolated on the sphere.
        abduct: degrees by which the upper arms are taken outward.
        drop_clavicles: degrees by which the clavicles are lowered.
        freeze: keep hands, fingers and toes as in the canonical pose; captured ones are often noise.

    Raises:
        ValueError: if the recording has no joints for the root and a leg, or is shorter than two frames.
    """
    capture = resample(capture, fps)
    names = cmu_names(names)
    source = {name: i for i, name in reversed(list(enumerate(capture.names)))}
    for needed in ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot"):
        if needed not in source:
            raise ValueError(f"the recording has no joint {needed!r}, only {', '.join(capture.names)}: rename them")
        if needed not in names:
            raise ValueError(f"the body has no joint {needed!r}, only {', '.join(names)}: rename them")
    rest = np.zeros_like(capture.offsets)
    turned = capture.rotations.copy()
    for i, parent in enumerate(capture.parents):
        if parent >= 0:
            rest[i] = rest[parent] + capture.offsets[i]
            turned[:, i] = turned[:, parent] @ turned[:, i]

    corrections = _corrections(abduct, drop_clavicles)
    world = np.zeros((len(turned), len(names), 3, 3))
    for j, name in enumerate(names):
        parent = body.parents[j]
        if (freeze and any(part in name for part in FROZEN)) or name not in source:
            world[:, j] = world[:, parent] if parent >= 0 else np.eye(3)
            continue
        align = np.eye(3)
        end = ALIGNED.get(name)
        if end in source and end in names:
            target_bone = body.joints[names.index(end)] - body.joints[j]
            align = _between(target_bone, rest[source[end]] - rest[source[name]])
        world[:, j] = turned[:, source[name]] @ corrections.get(name, np.eye(3)) @ align
    rotations = world.copy()
    rotations[:, 1:] = np.swapaxes(world[:, body.parents[1:]], -1, -2) @ world[:, 1:]

    leg = {name: body.joints[names.index(name)] for name in ("LeftUpLeg", "LeftLeg", "LeftFoot")}
    scale = leg_length(leg) / leg_length({name: rest[source[name]] for name in leg})
    path = (capture.translation - capture.translation[0] * [1, 0, 1]) * scale - body.joints[0]
    return stand(Motion(rotations.astype(np.float32), path, float(fps)), body)


def from_t_pose(local: dict[str, np.ndarray], body: Body, names: tuple[str, ...], to_t_pose: np.ndarray) -> np.ndarray:
    """Convert rotations relative to a T-pose to rotations relative to a body's canonical pose.

    Args:
        local: [T, 3, 3] by joint name, relative to the parent; joints without an entry follow their parents.
        body: to move.
        names: of the body's joints.
        to_t_pose: [J, 3, 3], from `storage.canonical_rotation`.

    Returns:
        Rotations [T, J, 3, 3], local to the parent.
    """
    frames = len(next(iter(local.values())))
    turned = np.zeros((frames, len(names), 3, 3))
    for j, (name, parent) in enumerate(zip(names, body.parents)):
        turned[:, j] = turned[:, parent] if parent >= 0 else np.eye(3)
        if name in local:
            turned[:, j] = turned[:, j] @ local[name]
    turned = turned @ to_t_pose
    rotations = turned.copy()
    rotations[:, 1:] = np.swapaxes(turned[:, body.parents[1:]], -1, -2) @ turned[:, 1:]
    return rotations


def resample(capture: Capture, fps: float) -> Capture:
    """Resample a recording: take every k-th frame, or interpolate if the rates are not multiples.

    Raises:
        ValueError: for a rate that is not > 0, or a recording of fewer than two frames.
    """
    frames = len(capture.translation)
    if not fps > 0:
        raise ValueError(f"fps must be > 0, got {fps}")
    if frames < 2:
        raise ValueError(f"the recording has {frames} frames: it needs two at least")
    ratio = capture.fps / fps
    if abs(ratio - round(ratio)) < 1e-3 * ratio and round(ratio) >= 1:
        every = slice(None, None, round(ratio))
        return capture._replace(rotations=capture.rotations[every], translation=capture.translation[every], fps=fps)
    old = np.arange(frames) / capture.fps
    new = np.arange(int(np.floor(old[-1] * fps + 1e-6)) + 1) / fps
    new = np.minimum(new, old[-1])
    rotations = np.empty((len(new), *capture.rotations.shape[1:]))
    for j in range(rotations.shape[1]):
        rotations[:, j] = Slerp(old, Rotation.from_matrix(capture.rotations[:, j]))(new).as_matrix()
    translation = np.stack([np.interp(new, old, x) for x in capture.translation.T], axis=1)
    return capture._replace(rotations=rotations, translation=translation, fps=fps)


def stand(motion: Motion, body: Body) -> Motion:
    """Move a motion up or down, so that the body (betas 0) reaches below y = 0 in 2 % of the frames."""
    turned = np.array(motion.rotations, np.float64)
    for j, parent in enumerate(body.parents):
        if parent >= 0:
            turned[:, j] = turned[:, parent] @ turned[:, j]
    shift = joint_positions(motion, body) - np.einsum("tjab,jb->tja", turned, body.joints)
    rows = np.concatenate([turned[:, :, 1], shift[:, :, 1:2]], axis=-1)  # the row of each transform that gives y
    points = np.concatenate([body.vertices, np.ones((len(body.vertices), 1))], axis=1)
    weights = np.asarray(body.weights, np.float64)
    lowest = [np.einsum("vk,vk->v", weights @ row, points).min() for row in rows]
    # rounded to float32: the digits beyond are noise that a file could not compress
    path = np.float32(motion.translation - np.array([0, np.percentile(lowest, 2), 0]))
    return motion._replace(translation=path.astype(np.float64))


def read_lines(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Yield number and words of each line that is not blank, of a text file or its .gz.

    Raises:
        ValueError: if the file cannot be read.
    """
    try:
        with (open_gzip if str(path).endswith(".gz") else open)(path, "rt", errors="replace") as file:
            for number, line in enumerate(file, 1):
                words = line.split()
                if words:
                    yield number, words
    except (OSError, EOFError) as error:  # EOFError: a .gz cut short
        raise ValueError(f"{path}: cannot be read ({error})") from error


def numbers(path: str | Path, line: int, words: list[str], count: int | None = None) -> list[float]:
    """Convert words to finite numbers.

    Raises:
        ValueError: naming file and line, if a word is not a number or there are not `count` of them.
    """
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"{path}, line {line}: {error}; expected numbers") from error
    if count is not None and len(values) != count:
        raise ValueError(f"{path}, line {line}: {len(values)} numbers, expected {count}")
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{path}, line {line}: {' '.join(words)!r} has a number that is not finite")
    return values


def _corrections(abduct: float, drop_clavicles: float) -> dict[str, np.ndarray]:
    """Return rotations [3, 3] by joint that take the upper arms outward and lower the clavicles, in degrees."""

    def about_z(degrees: float) -> np.ndarray:
        return Rotation.from_euler("z", degrees, degrees=True).as_matrix()

    return {
        "LeftArm": about_z(abduct),
        "RightArm": about_z(-abduct),
        "LeftShoulder": about_z(-drop_clavicles),
        "RightShoulder": about_z(drop_clavicles),
    }


def _between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortest rotation [3, 3] from one direction to another; identity if one has no length."""
    if np.linalg.norm(start) < 1e-9 or np.linalg.norm(end) < 1e-9:
        return np.eye(3)
    return Rotation.align_vectors(end[None], start[None])[0].as_matrix()


def leg_length(positions: dict[str, np.ndarray]) -> float:
    """Return the length of the left leg, from hip to ankle, of joint positions by CMU's names."""
    hip, knee, ankle = (positions[joint] for joint in ("LeftUpLeg", "LeftLeg", "LeftFoot"))
    return float(np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle))
