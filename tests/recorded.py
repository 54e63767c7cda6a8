"""Recordings of the embedded body, what else they could have been written as, and their files."""

import warnings
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse
from scipy.spatial.transform import Rotation

from clothjax.body.joint_names import CMU_FROM_SMPL
from clothjax.body.plausibility import body_kinematics, kinematics
from clothjax.files import storage
from clothjax.types import Motion
from data_prep import procedural, skeleton
from data_prep.smpl import BODY

FINE = 600  # Hz, of which every usual rate is a part
SECONDS = 2.0
X_NEGATED = np.diag([-1.0, 1.0, 1.0])
TRUNK = ("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Head")
LIMBS = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
KEPT = (*TRUNK, *(side + limb for side in ("Left", "Right") for limb in LIMBS))


def _scheme(trunk: str, limbs: str, sided: str = "{side}{part}", middle: str = "{part}") -> dict[str, str]:
    """Return the names of a scheme by those of CMU."""
    names = {mine: middle.format(part=part) for mine, part in zip(TRUNK, trunk.split(","))}
    for side in ("Left", "Right"):
        forms = {"side": side, "s": side[0], "l": side[0].lower(), "low": side.lower()}
        names |= {side + mine: sided.format(part=part, **forms) for mine, part in zip(LIMBS, limbs.split(","))}
    return names


UNREAL = "clavicle,upperarm,lowerarm,hand,thigh,calf,foot,ball"
UNITY = "Shoulder,UpperArm,LowerArm,Hand,UpperLeg,LowerLeg,Foot,Toes"
SMPL = "collar,shoulder,elbow,wrist,hip,knee,ankle,foot"
SCHEMES = {
    "CMU": {},
    "Mixamo": _scheme("Hips,Spine,Spine1,Spine2,Neck,Head", ",".join(LIMBS), "mixamorig:{side}{part}",
                      "mixamorig:{part}"),
    "LaFAN1": _scheme("Hips,Spine,Spine1,Spine2,Neck,Head", "Shoulder,Arm,ForeArm,Hand,UpLeg,Leg,Foot,Toe"),
    "Rokoko": _scheme("Hips,Spine,Spine2,Spine4,Neck,Head", "Shoulder,Arm,ForeArm,Hand,Thigh,Shin,Foot,Toe"),
    "Xsens": _scheme("Hips,Chest,Chest2,Chest3,Neck,Head", "Collar,Shoulder,Elbow,Wrist,Hip,Knee,Ankle,Toe"),
    "Unreal": _scheme("pelvis,spine_01,spine_02,spine_03,neck_01,head", UNREAL, "{part}_{l}"),
    "VRoid": _scheme("Hips,Spine,Chest,UpperChest,Neck,Head", UNITY.replace("Toes", "ToeBase"), "J_Bip_{s}_{part}",
                     "J_Bip_C_{part}"),
    "VRM": _scheme("hips,spine,chest,upperChest,neck,head", UNITY, "{low}{part}"),
    "Bandai-Namco": _scheme("Hips,Spine,Chest,UpperChest,Neck,Head", UNITY, "{part}_{s}"),
    "Rigify": _scheme("spine,spine.001,spine.002,spine.003,spine.005,spine.006",
                      "shoulder,upper_arm,forearm,hand,thigh,shin,foot,toe", "DEF-{part}.{s}", "DEF-{part}"),
    "SMPL": _scheme("pelvis,spine1,spine2,spine3,neck,head", SMPL, "{low}_{part}"),
    "SMPL of Maya": _scheme("Pelvis,Spine1,Spine2,Spine3,Neck,Head", SMPL.title(), "{s}_{part}"),
    "Biped": _scheme("Pelvis,Spine,Spine1,Spine2,Neck,Head", "Clavicle,UpperArm,Forearm,Hand,Thigh,Calf,Foot,Toe0",
                     "Bip01 {s} {part}", "Bip01 {part}"),
    "Daz": _scheme("hip,abdomen,abdomen2,chest,neck,head", "Collar,Shldr,ForeArm,Hand,Thigh,Shin,Foot,Toe",
                   "{l}{part}"),
}  # fmt: skip


class Take(NamedTuple):
    """A recording in m, +y up."""

    names: tuple[str, ...]
    parents: np.ndarray  # [n] root first with -1, depth first
    places: np.ndarray  # [T, n, 3] on the parents
    rotations: np.ndarray  # [T, n, 3, 3] on the parents
    moving: np.ndarray  # [n] bool, which have channels of position

    def only(self, frames) -> "Take":
        """Some of the frames."""
        return self._replace(places=self.places[frames], rotations=self.rotations[frames])


@cache
def clip(kind: str, seed: int) -> Motion:
    """A generated motion at FINE Hz."""
    return procedural.generate(kind, seed, SECONDS, FINE)


@cache
def joints(kind: str, seed: int, fps: int, mirrored: bool = False) -> np.ndarray:
    """Positions [T, J, 3] m of the body's joints in that motion, or in the motion in a mirror."""
    rig, motion = storage.load_rig("body"), clip(kind, seed)
    every = slice(None, None, FINE // fps)
    found = body_kinematics(Motion(motion.rotations[every], motion.translation[every], fps), rig.body)[1]
    return (found @ X_NEGATED)[:, [rig.names.index(other_side(name)) for name in rig.names]] if mirrored else found


def take(kind: str, seed: int, fps: int) -> Take:
    """That motion at another rate."""
    rig, motion = storage.load_rig("body"), clip(kind, seed)
    rest = np.asarray(rig.body.joints, np.float64)
    parents = np.asarray(rig.body.parents)
    every = slice(None, None, FINE // fps)
    rotations = np.asarray(motion.rotations[every], np.float64)
    places = np.tile(rest - rest[np.maximum(parents, 0)], (len(rotations), 1, 1))
    places[:, 0] = rest[0] + motion.translation[every]
    return Take(rig.names, parents, places, rotations, parents < 0)


# The same in other words


def other_side(name: str) -> str:
    """The name of the joint on the other side; CMU's names."""
    for one, other in (("Left", "Right"), ("Right", "Left"), ("L", "R"), ("R", "L")):
        if name.startswith(one) and name[len(one) :][:1].isupper():
            return other + name.removeprefix(one)
    return name


def named(taken: Take, scheme: dict[str, str]) -> Take:
    """With the names of a scheme, and only the joints that it has; what is left out does not turn."""
    if not scheme:
        return taken
    kept = [j for j, name in enumerate(taken.names) if name in KEPT]
    parents, places = taken.parents.copy(), taken.places.copy()
    for j in range(1, len(parents)):
        while parents[j] not in (*kept, -1):
            places[:, j] += places[:, parents[j]]
            parents[j] = parents[parents[j]]
    names = tuple(scheme[taken.names[j]] for j in kept)
    above = np.array([-1 if parents[j] < 0 else kept.index(parents[j]) for j in kept])
    return Take(names, above, places[:, kept], taken.rotations[:, kept], taken.moving[kept])


def turned(taken: Take, turn: np.ndarray) -> Take:
    """In other axes of the world, given as a rotation [3, 3]; the rest pose stays as it is."""
    rotations, places = taken.rotations.copy(), taken.places.copy()
    rotations[:, 0], places[:, 0] = turn @ rotations[:, 0], places[:, 0] @ turn.T
    return taken._replace(rotations=rotations, places=places)


def with_axes(taken: Take, own: np.ndarray) -> Take:
    """With other axes of each joint, given as rotations [n, 3, 3]."""
    before = np.where((taken.parents < 0)[:, None, None], np.eye(3), own[np.maximum(taken.parents, 0)])
    back = np.swapaxes(before, -1, -2)
    return taken._replace(rotations=back @ taken.rotations @ own, places=np.einsum("nab,tnb->tna", back, taken.places))


def in_mirror(taken: Take) -> Take:
    """With x negated: joints change the side, but not their names."""
    return taken._replace(rotations=X_NEGATED @ taken.rotations @ X_NEGATED, places=taken.places @ X_NEGATED)


def below(taken: Take, name: str, how: str) -> Take:
    """With a joint above the root: `still`, or with the `path` on the ground, or with `all` of the root's motion."""
    count = len(taken.places)
    rotations, places = taken.rotations, taken.places
    above, at = np.tile(np.eye(3), (count, 1, 1, 1)), np.zeros((count, 1, 3))
    moving = [True, True]
    if how == "still":
        above[:] = Rotation.from_euler("xz", [90, 180], degrees=True).as_matrix()
    elif how == "path":
        at[:, 0, [0, 2]] = places[:, 0, [0, 2]]
        heading = np.arctan2(rotations[:, 0, 0, 2], rotations[:, 0, 2, 2])
        above[:, 0] = Rotation.from_euler("y", heading[:, None]).as_matrix()
    else:
        above, at, moving = rotations[:, :1], places[:, :1], [True, False]
    back = np.swapaxes(above[:, 0], -1, -2)
    first = np.einsum("tab,tb->ta", back, places[:, 0] - at[:, 0])
    rotations = np.concatenate([above, (back @ rotations[:, 0])[:, None], rotations[:, 1:]], axis=1)
    places = np.concatenate([at, first[:, None], places[:, 1:]], axis=1)
    parents = np.concatenate([[-1], taken.parents + 1])
    return Take((name, *taken.names), parents, places, rotations, np.array([*moving, *taken.moving[1:]]))


def reordered(taken: Take, random: np.random.Generator) -> Take:
    """With the children of every joint in another order."""
    order, waiting = [], [0]
    while waiting:
        order.append(waiting.pop())
        waiting.extend(random.permutation(np.flatnonzero(taken.parents == order[-1])).tolist())
    parents = np.array([-1 if taken.parents[j] < 0 else order.index(taken.parents[j]) for j in order])
    names = tuple(taken.names[j] for j in order)
    return Take(names, parents, taken.places[:, order], taken.rotations[:, order], taken.moving[order])


def after_a_t_pose(taken: Take) -> Take:
    """After a frame without rotations at the start of the path, as some programs put before a take."""
    first = np.tile(np.eye(3), (1, len(taken.names), 1, 1))
    places = np.concatenate([taken.places[:1], taken.places])
    return taken._replace(rotations=np.concatenate([first, taken.rotations]), places=places)


# SMPL's joints

OF_SMPL = tuple(CMU_FROM_SMPL[name] for name in BODY)
CROSSED = {name: name.replace("left", "@").replace("right", "left").replace("@", "right") for name in BODY}


def smpl_joints() -> tuple[tuple[str, ...], np.ndarray]:
    """CMU's names of SMPL's joints, and their parents."""
    short = named(take("arms", 0, 30), {name: name for name in OF_SMPL})
    return short.names, short.parents


def smpl_poses(kind: str, seed: int, fps: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotations [T, 22, 3, 3] from a T-pose and a path [T, 3] m of that motion, +y up."""
    taken = take(kind, seed, fps)
    world = kinematics(taken.rotations, taken.places[:, 0], taken.places[0], taken.parents)[0]
    turned_from = world @ np.swapaxes(storage.canonical_rotation("body"), -1, -2)
    short = named(taken, {name: name for name in OF_SMPL})
    at = [taken.names.index(name) for name in short.names]
    turned_from = turned_from[:, at]
    local = turned_from.copy()
    local[:, 1:] = np.swapaxes(turned_from[:, short.parents[1:]], -1, -2) @ turned_from[:, 1:]
    return local[:, [short.names.index(name) for name in OF_SMPL]], taken.places[:, 0]


def amass_arrays(kind: str, seed: int, fps: int = 120) -> dict:
    """That motion as the arrays of a file of AMASS in SMPL-H's layout, up in z."""
    turns, path = smpl_poses(kind, seed, fps)
    up = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # +y becomes +z
    turns[:, 0] = up @ turns[:, 0]
    poses = np.zeros((len(path), 52, 3))
    poses[:, : len(BODY)] = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(len(path), -1, 3)
    return {
        "poses": poses.reshape(len(path), -1),
        "trans": path @ up.T,
        "betas": np.zeros(16),
        "gender": np.array("female"),
        "mocap_framerate": np.array(float(fps)),
    }


def smpl_model() -> dict:
    """The embedded body in a T-pose as the arrays of a model of SMPL."""
    body, names = storage.load_rig("body")
    parents, turned_from = np.asarray(body.parents), storage.canonical_rotation("body")
    local = turned_from.copy()
    local[1:] = np.swapaxes(turned_from[parents[1:]], -1, -2) @ turned_from[1:]
    motion = Motion(local[None], np.zeros((1, 3)), 30.0)
    joints = body_kinematics(motion, body)[1][0]
    moved = joints - np.einsum("jab,jb->ja", turned_from, body.joints)
    blended = np.einsum("vj,jab->vab", body.weights, turned_from)
    vertices = np.einsum("vab,vb->va", blended, body.vertices) + body.weights @ moved
    kept = [names.index(name) for name in (*OF_SMPL, "LeftFingerBase", "RightFingerBase")]
    nearest = [next(above for above in skeleton.ancestors(j, parents) if above in kept) for j in range(len(names))]
    weights = np.zeros((len(vertices), len(kept)))
    for joint, above in enumerate(nearest):
        weights[:, kept.index(above)] += body.weights[:, joint]
    regressor = np.zeros((len(kept), len(vertices)))
    for row, joint in zip(regressor, joints[kept]):
        near = np.argsort(np.linalg.norm(vertices - joint, axis=1))[:60]
        row[near] = np.linalg.lstsq(np.c_[vertices[near], np.ones(60)].T, np.r_[joint, 1.0])[0]
    table = np.array([[0, *(kept.index(nearest[parents[j]]) for j in kept[1:])], range(len(kept))])
    table[0, 0] = 2**32 - 1
    return {
        "v_template": vertices,
        "f": np.asarray(body.faces, np.uint32),
        "weights": weights,
        "shapedirs": np.einsum("vab,vbs->vas", blended, body.shapedirs),
        "posedirs": np.zeros((len(vertices), 3, 9 * (len(kept) - 1))),
        "J_regressor": scipy.sparse.csc_matrix(regressor),
        "kintree_table": table,
    }


# Files


def write_bvh(path: Path, taken: Take, frame_time: str, orders: list[str], last: bool = False, end: str = "\n") -> None:
    """Write a BVH file.

    Args:
        path: of the file.
        taken: the recording.
        frame_time: s.
        orders: of the angles of each joint, such as `zxy`.
        last: whether channels of position come after those of rotation.
        end: of a line.
    """
    lines, columns = ["HIERARCHY"], []

    def joint(j: int, depth: int) -> None:
        pad, turning = "  " * depth, [f"{axis.upper()}rotation" for axis in orders[j]]
        lines.append(f"{pad}{'ROOT' if taken.parents[j] < 0 else 'JOINT'} {taken.names[j]}")
        offset = np.zeros(3) if taken.moving[j] else taken.places[0, j]
        lines.extend([f"{pad}{{", f"{pad}  OFFSET {' '.join(f'{x:.6f}' for x in offset)}"])
        moving = ["Xposition", "Yposition", "Zposition"] if taken.moving[j] else []
        own = [turning, moving][:: 1 if last else -1]
        lines.append(f"{pad}  CHANNELS {len(turning) + len(moving)} {' '.join(own[0] + own[1])}")
        with warnings.catch_warnings(action="ignore"):  # at a gimbal lock any of the angles is right
            angles = Rotation.from_matrix(taken.rotations[:, j]).as_euler(orders[j].upper(), degrees=True)
        columns.extend([angles, *([taken.places[:, j]] if taken.moving[j] else [])][:: 1 if last else -1])
        children = np.flatnonzero(taken.parents == j)
        for child in children:
            joint(child, depth + 1)
        if not len(children):
            lines.extend([f"{pad}  End Site", f"{pad}  {{", f"{pad}    OFFSET 0 0 0", f"{pad}  }}"])
        lines.append(f"{pad}}}")

    joint(0, 0)
    rows = np.concatenate(columns, axis=1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {frame_time}"]
    lines += [" ".join(f"{x:.6f}" for x in row) for row in rows]
    path.write_bytes((end.join(lines) + end).encode())
