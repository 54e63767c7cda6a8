"""Motion capture in Acclaim's ASF (skeleton) and AMC (motion) files, such as CMU's.

    python -m data_prep.asf_amc 02.asf 02_01.amc out.h5 --body body.h5 --fps 30

Plain or .gz. Each joint sits where its bone begins. CMU's data (mocap.cs.cmu.edu, created with funding from
NSF EIA-0196217) is free to use with credit, and not to be resold.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from clothjax.files.storage import load_rig
from data_prep.program import SkeletonOptions, retarget_as_asked, run, write_motion
from data_prep.recording import LEAST_RATE, MOST_RATE, Capture, numbers, read_lines

CMU_NAMES = {
    "root": "Hips",
    "lowerback": "LowerBack",
    "upperback": "Spine",
    "thorax": "Spine1",
    "lowerneck": "Neck",
    "upperneck": "Neck1",
    "head": "Head",
}
_SIDED = {
    "hipjoint": "HipJoint",
    "femur": "UpLeg",
    "tibia": "Leg",
    "foot": "Foot",
    "toes": "ToeBase",
    "clavicle": "Shoulder",
    "humerus": "Arm",
    "radius": "ForeArm",
    "wrist": "Hand",
    "hand": "FingerBase",
    "fingers": "HandFinger1",
    "thumb": "Thumb",
}
for _letter, _side in (("l", "Left"), ("r", "Right")):
    for _bone, _joint in _SIDED.items():
        _prefix = _side[0] if _joint in ("HipJoint", "Thumb") else _side
        CMU_NAMES[_letter + _bone] = _prefix + _joint


class Bone(NamedTuple):
    """One bone of an ASF file."""

    vector: np.ndarray  # [3] from its joint to its end, in the file's unit
    frame: Rotation  # of the axes of its angles
    freedoms: str  # some of "xyz", in the order of application


class Skeleton(NamedTuple):
    """The skeleton of an ASF file."""

    bones: dict[str, Bone]
    parents: dict[str, str]  # of every bone, parents before children
    degrees: bool
    root_order: tuple[str, ...]  # of the root's six channels, "tx" ... "rz"


def read_asf(path: str | Path) -> Skeleton:
    """Read the skeleton in an ASF file.

    Raises:
        ValueError: naming file and line.
    """
    bones, parents, degrees, order = {}, {}, True, ("tx", "ty", "tz", "rx", "ry", "rz")
    section, entry, line = "", {}, 0
    for line, words in read_lines(path):
        key = words[0].lower()
        if key.startswith("#"):
            continue
        if key.startswith(":"):
            section = key
        elif section == ":units" and key == "angle":
            degrees = words[-1].lower().startswith("deg")
        elif section == ":root" and key == "order":
            order = tuple(word.lower() for word in words[1:])
            if sorted(order) != ["rx", "ry", "rz", "tx", "ty", "tz"]:
                raise ValueError(f"{path}, line {line}: root order {' '.join(words[1:])}, expected TX to RZ")
        elif section == ":bonedata":
            if key == "begin":
                entry = {}
            elif key == "end":
                name, bone = _bone(path, line, entry, degrees)
                bones[name] = bone
            else:
                entry[key] = (line, words[1:])
        elif section == ":hierarchy" and key not in ("begin", "end"):
            parent = "root" if key == "root" else words[0]
            for child in words[1:]:
                if child not in bones or (parent != "root" and parent not in parents):
                    raise ValueError(f"{path}, line {line}: {parent} or {child} is not a bone defined before")
                parents[child] = parent
    if not bones or set(parents) != set(bones):
        orphans = f"bones without parent: {sorted(set(bones) - set(parents))}" if bones else "no bones: no ASF file"
        raise ValueError(f"{path}, line {line}: no complete :hierarchy ({orphans}); cut short, or AMC before ASF?")
    return Skeleton(bones, parents, degrees, order)


def read_amc(path: str | Path, skeleton: Skeleton, fps: float = 120.0) -> Capture:
    """Read the motion in an AMC file, in the units of its ASF file.

    Args:
        path: of the AMC file.
        skeleton: of its ASF file.
        fps: frames per second of the recording; the file does not say (CMU: 120).

    Raises:
        ValueError: naming file and line.
    """
    if not LEAST_RATE <= fps <= MOST_RATE:
        raise ValueError(
            f"{path}: --source-fps {fps:g}: give its frames a second, from {LEAST_RATE:g} to {MOST_RATE:g}"
        )
    names = ["root", *skeleton.parents]
    width = {name: len(bone.freedoms) for name, bone in skeleton.bones.items() if bone.freedoms} | {"root": 6}
    values: dict[str, list[list[float]]] = {name: [] for name in width}
    frames = line = 0
    for line, words in read_lines(path):
        if words[0][:4].lower() == (":rad" if skeleton.degrees else ":deg"):
            unit = "degrees" if skeleton.degrees else "radians"
            raise ValueError(f"{path}, line {line}: {words[0]}, but its skeleton is in {unit}: correct one of them")
        if words[0][0] in "#:":
            continue
        name = "root" if words[0].lower() == "root" else words[0]
        if len(words) == 1 and name.isdigit():
            _check_frame(path, line, values, frames)
            frames += 1
        elif name not in width:
            raise ValueError(f"{path}, line {line}: no moving bone {name!r} in the skeleton")
        elif len(values[name]) != frames - 1:
            raise ValueError(f"{path}, line {line}: {name} outside of a frame, or twice in one")
        else:
            values[name].append(numbers(path, line, words[1:], width[name]))
    _check_frame(path, line, values, frames)
    if not frames:
        raise ValueError(f"{path}, line {line}: no frames")

    channels = np.array(values["root"])[:, [skeleton.root_order.index(c) for c in ("tx", "ty", "tz")]]
    turns = [c for c in skeleton.root_order if c[0] == "r"]
    angles = np.array(values["root"])[:, [skeleton.root_order.index(c) for c in turns]]
    rotations = np.tile(np.eye(3), (frames, len(names), 1, 1))
    root_axes = "".join(c[1] for c in turns)
    rotations[:, 0] = Rotation.from_euler(root_axes, angles, degrees=skeleton.degrees).as_matrix()
    offsets = np.zeros((len(names), 3))
    for j, name in enumerate(names[1:], 1):
        bone = skeleton.bones[name]
        if skeleton.parents[name] != "root":
            offsets[j] = skeleton.bones[skeleton.parents[name]].vector
        if bone.freedoms:
            own = Rotation.from_euler(bone.freedoms, np.array(values[name]), degrees=skeleton.degrees)
            rotations[:, j] = (bone.frame * own * bone.frame.inv()).as_matrix()
    parents = np.array([-1] + [names.index(skeleton.parents[name]) for name in names[1:]])
    return Capture(tuple(CMU_NAMES.get(n.lower(), n) for n in names), parents, offsets, rotations, channels, fps)


def _bone(path: str | Path, line: int, entry: dict, degrees: bool) -> tuple[str, Bone]:
    """Return name and bone of an entry of :bonedata, whose values are (line, words) by key."""
    missing = {"name", "direction", "length", "axis"} - set(entry)
    if missing or not entry["name"][1]:
        raise ValueError(f"{path}, line {line}: the bone that ends here lacks {', '.join(sorted(missing)) or 'a name'}")
    direction = np.array(numbers(path, entry["direction"][0], entry["direction"][1], 3))
    (length,) = numbers(path, entry["length"][0], entry["length"][1], 1)
    axis_line, axis = entry["axis"]
    order = axis[3].lower() if len(axis) == 4 else "xyz"
    if sorted(order) != ["x", "y", "z"]:
        raise ValueError(f"{path}, line {axis_line}: axis order {axis[3]!r}, expected such as XYZ")
    frame = Rotation.from_euler(order, numbers(path, axis_line, axis[:3], 3), degrees=degrees)
    dof_line, dof = entry.get("dof", (line, []))
    freedoms = [word.lower() for word in dof]
    if len(set(freedoms)) != len(freedoms) or not set(freedoms) <= {"rx", "ry", "rz"}:
        raise ValueError(f"{path}, line {dof_line}: dof {' '.join(dof)!r}, allowed are rx, ry and rz once each")
    return entry["name"][1][0], Bone(direction * length, frame, "".join(f[1] for f in freedoms))


def _check_frame(path: str | Path, line: int, values: dict[str, list], frames: int) -> None:
    """Refuse a frame that lacks a bone."""
    missing = [name for name, rows in values.items() if len(rows) != frames]
    if missing:
        raise ValueError(f"{path}, line {line}: the frame before it lacks {', '.join(missing)}")


@dataclass(frozen=True)
class Arguments(SkeletonOptions):
    """Retarget an ASF/AMC recording onto a body."""

    skeleton: tyro.conf.Positional[Path]
    motion: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    source_fps: float = 120.0
    """Frames per second of the recording; the file does not say."""
    abduct: float = field(default=25.0, kw_only=True)
    """Degrees the upper arms are taken outward: CMU's skeletons hold them about 30 too close to the trunk."""
    drop_clavicles: float = field(default=15.0, kw_only=True)
    """Degrees the clavicles are lowered, for the same reason."""
    licence: str = field(
        default="of the recording; CMU's: free to use with credit, not to be resold (mocap.cs.cmu.edu)", kw_only=True
    )


def main(args: Arguments) -> None:
    """Write the motion file, and print which frames are implausible."""
    rig, capture = load_rig(args.body), read_amc(args.motion, read_asf(args.skeleton), args.source_fps)
    motion = retarget_as_asked(capture, rig, args, args.motion)
    write_motion(args.output, motion, rig, args.motion, args)


if __name__ == "__main__":
    run(main, Arguments, __doc__)
