"""Retargeting of a motion to a body with other bones and another canonical pose.

World rotations of the joints are copied by body part (`skeleton.py`), relative to how the joints are turned when the
figure stands like the body (`rest_pose.py`). Bones of arms and legs are aligned, so that an A-pose and a T-pose agree.
Where it is asked for, rotations are found from positions (`by_positions.py`). The root's path is scaled by the length
of a leg. At last the result is compared with the recording.
"""

from collections.abc import Callable, Collection
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from clothjax.body.plausibility import body_kinematics, joint_positions
from clothjax.types import Body, Motion
from data_prep import rest_pose, skeleton
from data_prep.by_positions import turns_from_t_pose
from data_prep.doubts import ground
from data_prep.recording import Capture, resample
from data_prep.rest_pose import AXES, Figure, figure, is_rest_pose, turn_upright, unit
from data_prep.skeleton import Parts, cmu_names

FROZEN = ("Hand", "Finger", "Thumb", "Toe")
MOST_APART = 20.0  # degrees, between a bone of the result and of the recording


class Axes(NamedTuple):
    """Axes of a file that point up and forward, such as `z` and `-y`; None to find out."""

    up: str | None = None
    forward: str | None = None


FOUND = Axes()


def retarget(
    capture: Capture,
    body: Body,
    names: tuple[str, ...],
    parts: Parts | None = None,
    *,
    fps: float = 30.0,
    abduct: float = 0.0,
    drop_clavicles: float = 0.0,
    freeze: bool = True,
    axes: Axes = FOUND,
    by_positions: bool = False,
    allow: bool = False,
    about: str = "the recording",
    tell: Callable[[str], object] = str,
) -> Motion:
    """Retarget a recording onto a body's joints, starting above the origin and standing on y = 0.

    Args:
        capture: the recording.
        body: to move.
        names: of its joints.
        parts: of the recording; None to find them by the names of its joints.
        fps: frames per second of the result; between two frames rotations follow a spline on the sphere.
        abduct: degrees by which the upper arms are taken outward.
        drop_clavicles: degrees by which the clavicles are lowered.
        freeze: keep hands, fingers and toes as in the canonical pose; captured ones are often noise.
        axes: of the recording.
        by_positions: go by where its joints are, and leave their rotations.
        allow: take a result that differs from the recording.
        about: name of the recording, for messages.
        tell: called with a line about each thing that had to be read off the frames, or is hardly meant.

    Raises:
        ValueError: if parts of the body are missing; if it is not seen which way is up, or another way than `axes` has
            it, or the axes do not go together; if left and right contradict the figure; if the result differs from the
            recording; if the recording is shorter than two frames.
    """
    if len(capture.translation) < 2:
        raise ValueError(
            f"{about}: a motion has two frames at least, not {len(capture.translation)}: take a longer one"
        )
    capture = resample(capture, fps)
    names = cmu_names(names)
    of_body = skeleton.find(names, body.parents, "the body")
    of_file = skeleton.find(capture.names, capture.parents, about) if parts is None else parts
    shown = figure(capture, capture.rotations, capture.translation)
    resting = figure(capture, np.tile(np.eye(3), (1, len(capture.names), 1, 1)), np.zeros((1, 3)))
    _refuse_lost_bones(capture, shown, of_file, about)
    wrong = "" if allow else rest_pose.sides(shown, of_file)
    if wrong:
        raise ValueError(
            f"{about}: {wrong}: left and right are exchanged in the names, or an axis is negated; "
            "export it again or rename the joints; --allow takes it all the same"
        )
    rest = is_rest_pose(resting, of_file)
    up = _up(shown, of_file, rest, axes, about, allow, tell)
    shown = shown.turned(turn_upright(AXES[up], None if axes.forward is None else AXES[axes.forward]))
    if by_positions:
        if len(of_file.chain) < 2:
            raise ValueError(f"{about}: it has neither spine nor neck, so its trunk is not seen: no --by-positions")
        turned = turns_from_t_pose(shown.positions, of_file, body.joints, body.parents, names, of_body)
        leg = leg_length(shown.positions[0], of_file)
    else:
        if rest is None:
            if not allow and any(end.endswith(" hand") for end in _absent_ends(of_file)):
                raise ValueError(
                    f"{about}: it has no hands, and its rest pose is no T-pose, so its forearms are not seen: export "
                    "it with hands or in a T-pose; --allow takes it all the same"
                )
            frame = rest_pose.straightest(shown, of_file)
            reference = rest_pose.standing(shown, resting, capture.parents, of_file, frame)
            tell(
                "its rest pose is no T-pose; trunk and shoulders are taken to be straight in frame "
                f"{frame} of the result"
            )
        else:
            reference = np.tile(rest_pose.rest_turn(resting, of_file, rest), (len(capture.names), 1, 1))
        posed = figure(capture, relative(reference[None], capture.parents), np.zeros((1, 3))).positions[0]
        frozen = _beyond(body.parents, of_body) if freeze else set()
        aligned = _aligned(body, of_body, posed, of_file)
        turned = {
            j: (aligned.get(j, np.eye(3)), shown.rotations[:, own] @ reference[own].T)
            for j, own in _pairs(of_file, capture.names, of_body, names).items()
            if j not in frozen
        }
        leg = leg_length(posed, of_file)

    corrections, part_of = _corrections(abduct, drop_clavicles), {joint: part for part, joint in of_body.limbs.items()}
    world = np.zeros((len(shown.positions), len(names), 3, 3))
    for j, parent in enumerate(body.parents):
        if j in turned:
            to_t_pose, from_there = turned[j]
            world[:, j] = from_there @ corrections.get(part_of.get(j, ""), np.eye(3)) @ to_t_pose
        else:
            world[:, j] = world[:, parent] if parent >= 0 else np.eye(3)
    _fill(world, of_body, turned)

    scale = leg_length(body.joints, of_body) / leg
    path = shown.positions[:, of_file.hips]
    path = (path - path[0] * [1, 0, 1]) * scale - body.joints[0]
    motion = stand(Motion(relative(world, body.parents).astype(np.float32), path, float(fps)), body)
    for line in ground(float(path[0, 1] - motion.translation[0, 1])):
        tell(line)
    if not allow:
        remedy = "" if by_positions else "--by-positions leaves the recording's rotations; "
        compare(motion, body, of_body, shown, of_file, about, abduct + drop_clavicles, remedy)
    return motion


def _absent_ends(parts: Parts) -> list[str]:
    """Return the parts at which limbs should end, that are not there."""
    return [end for part in parts.limbs if (end := skeleton.end_of(part)) and end not in parts.limbs]


def _refuse_lost_bones(capture: Capture, shown: Figure, parts: Parts, about: str) -> None:
    """Refuse a figure whose hips or legs have no length, for the rest is then not where it should be either."""
    ends = [(parts.limbs["left thigh"], parts.limbs["right thigh"])]
    for side in skeleton.SIDES:
        thigh, shin, foot = (parts.limbs[f"{side} {part}"] for part in ("thigh", "shin", "foot"))
        ends += [(thigh, shin), (shin, foot)]
    for start, end in ends:
        if not shown.bone(start, end)[0].any():
            raise ValueError(
                f"{about}: {capture.names[start]} and {capture.names[end]} are at one place: export it with the "
                "offsets of its joints"
            )


def _aligned(body: Body, of_body: Parts, posed: np.ndarray, of_file: Parts) -> dict[int, np.ndarray]:
    """Return by joint of a body the rotation [3, 3] of its bone to that of a recording in a T-pose [n, 3]."""
    found = {}
    for part, joint in of_body.limbs.items():
        end = skeleton.end_of(part)
        if part in of_file.limbs and end in of_file.limbs and end in of_body.limbs:
            bone = body.joints[of_body.limbs[end]] - body.joints[joint]
            found[joint] = _between(bone, posed[of_file.limbs[end]] - posed[of_file.limbs[part]])
    return found


def _up(
    shown: Figure, parts: Parts, rest: str | None, axes: Axes, about: str, allow: bool, tell: Callable[[str], object]
) -> str:
    """Return the axis of a file that points up, as asked or as its frames show it; `retarget` has the arguments."""
    seen = rest_pose.up_axis(shown, parts, rest)
    up = axes.up or seen
    if up is None:
        raise ValueError(f"{about}: it does not show which way is up: give --up y or --up z")
    if axes.forward is not None and axes.forward[-1] == up[-1]:
        raise ValueError(f"{about}: {up} is up, so --forward {axes.forward} cannot be forward")
    lies = None not in (rest, seen) and rest != seen and rest_pose.may_lie(shown, parts, AXES[seen])
    if lies and axes.up is None:
        raise ValueError(
            f"{about}: its figure is upright along {seen}, but its rest pose has {rest} up: give --up {rest} if it "
            f"lies or crawls, --up {seen} if it stands"
        )
    if seen not in (None, up) and not (allow or (lies and up == rest)):
        raise ValueError(f"{about}: --up {up}, but its figure stands along {seen}; --allow takes it all the same")
    if axes.up is None and up != "y":
        tell(f"{up} is up, for the figure stands along it; --up says otherwise")
    return up


def relative(world: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Return rotations [T, J, 3, 3] local to the parents, of world rotations [T, J, 3, 3]."""
    rotations = world.copy()
    rotations[:, 1:] = np.swapaxes(world[:, parents[1:]], -1, -2) @ world[:, 1:]
    return rotations


def _pairs(of_file: Parts, file_names: tuple[str, ...], of_body: Parts, names: tuple[str, ...]) -> dict[int, int]:
    """Return by joint of a body the joint of a file that moves it: by name where both have it, else by part."""
    number = {name: i for i, name in reversed(list(enumerate(file_names)))}
    known = {*of_file.chain, *of_file.limbs.values()}
    pairs = {j: number[name] for j, name in enumerate(names) if name in number and number[name] not in known}
    pairs |= {of_body.limbs[part]: joint for part, joint in of_file.limbs.items() if part in of_body.limbs}
    for mine, other in ((of_body.spine, of_file.spine), (of_body.neck, of_file.neck)):
        for k, joint in enumerate(other, 1):  # the last moves the last; of more than there are, the last of each share
            if mine:
                pairs[mine[max(k * len(mine) // len(other), 1) - 1]] = joint
    return pairs | {of_body.hips: of_file.hips}


def _beyond(parents: np.ndarray, parts: Parts) -> set[int]:
    """Return hands and toes, and the joints that hang on them."""
    ends = {joint for part, joint in parts.limbs.items() if part.endswith((" hand", " toe"))}
    return {j for j in range(len(parents)) if ends & set(skeleton.ancestors(j, parents))}


def _fill(world: np.ndarray, parts: Parts, turned: Collection[int]) -> None:
    """Turn the joints of a trunk that the file does not have in equal shares between those around them."""
    chain = parts.chain
    moved = [k for k, joint in enumerate(chain) if joint in turned]
    for before, after in zip(moved, moved[1:], strict=False):
        start, end = (Rotation.from_matrix(world[:, chain[k]]) for k in (before, after))
        whole = (start.inv() * end).as_rotvec()
        for k in range(before + 1, after):
            share = (k - before) / (after - before)
            world[:, chain[k]] = (start * Rotation.from_rotvec(share * whole)).as_matrix()


def compare(
    motion: Motion,
    body: Body,
    of_body: Parts,
    shown: Figure,
    of_file: Parts,
    about: str,
    allowance: float,
    remedy: str = "",
) -> None:
    """Refuse a motion whose bones do not point where those of its recording do.

    Args:
        motion: of the body.
        of_body, of_file: parts of the body and of the recording.
        shown: the recording, +y up.
        allowance: degrees by which arms and shoulders may differ further, because that was asked for.
        remedy: what else may help.

    Raises:
        ValueError: naming the part that differs most, with both directions.
    """
    positions = joint_positions(motion, body)

    def directions(positions: np.ndarray, parts: Parts) -> dict[str, np.ndarray]:
        limbs = parts.limbs
        ends = {"trunk": (parts.hips, parts.chain[-1]), "hips": (limbs["right thigh"], limbs["left thigh"])}
        if "left upper arm" in limbs and "right upper arm" in limbs:
            ends["shoulders"] = (limbs["right upper arm"], limbs["left upper arm"])
        for part, joint in limbs.items():
            end = skeleton.end_of(part)
            if end in limbs and not end.endswith("toe"):
                ends[part] = (joint, limbs[end])
        return {part: unit(positions[:, end] - positions[:, start]) for part, (start, end) in ends.items()}

    found, recorded = directions(positions, of_body), directions(shown.positions, of_file)
    apart = {
        part: np.degrees(np.arccos(np.clip(np.sum(found[part] * recorded[part], axis=1), -1.0, 1.0)))
        - (allowance if part.endswith(("arm", "shoulders")) else 0.0)
        for part in found.keys() & recorded.keys()
    }
    medians = {part: float(np.median(angles)) for part, angles in apart.items()}
    worst = max(medians, key=lambda part: medians[part])
    if medians[worst] > MOST_APART:
        frame = int(np.argsort(apart[worst])[len(apart[worst]) // 2])
        raise ValueError(
            f"{about}: the {worst} would be {medians[worst]:.0f} degrees off: in frame {frame} it points to "
            f"{np.round(recorded[worst][frame], 2).tolist()} in the recording, to "
            f"{np.round(found[worst][frame], 2).tolist()} in the result (x left, y up, z forward). "
            f"Check --up and --joints; {remedy}--allow takes it all the same"
        )


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
    return relative(turned @ to_t_pose, body.parents)


def stand(motion: Motion, body: Body) -> Motion:
    """Move a motion up or down, so that the body (betas 0) reaches below y = 0 in 2 % of the frames."""
    turned, positions = body_kinematics(motion, body)
    shift = positions - np.einsum("tjab,jb->tja", turned, body.joints)
    rows = np.concatenate([turned[:, :, 1], shift[:, :, 1:2]], axis=-1)  # the row of each transform that gives y
    points = np.concatenate([body.vertices, np.ones((len(body.vertices), 1))], axis=1)
    weights = np.asarray(body.weights, np.float64)
    lowest = [np.einsum("vk,vk->v", weights @ row, points).min() for row in rows]
    # rounded to float32: the digits beyond are noise that a file could not compress
    path = np.float32(motion.translation - np.array([0, np.percentile(lowest, 2), 0]))
    return motion._replace(translation=path.astype(np.float64))


def _corrections(abduct: float, drop_clavicles: float) -> dict[str, np.ndarray]:
    """Return rotations [3, 3] by part that take the upper arms outward and lower the clavicles, in degrees."""

    def about_z(degrees: float) -> np.ndarray:
        return Rotation.from_euler("z", degrees, degrees=True).as_matrix()

    return {
        "left upper arm": about_z(abduct),
        "right upper arm": about_z(-abduct),
        "left clavicle": about_z(-drop_clavicles),
        "right clavicle": about_z(drop_clavicles),
    }


def _between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortest rotation [3, 3] from one direction to another; identity if one has no length."""
    if np.linalg.norm(start) < 1e-9 or np.linalg.norm(end) < 1e-9:
        return np.eye(3)
    return Rotation.align_vectors(end[None], start[None])[0].as_matrix()


def leg_length(positions: np.ndarray, parts: Parts) -> float:
    """Return the length of the left leg, from hip to ankle, of joint positions [n, 3]."""
    hip, knee, ankle = (positions[parts.limbs[f"left {part}"]] for part in ("thigh", "shin", "foot"))
    return float(np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle))
