"""Motion capture in BVH files.

    python -m data_prep.bvh 01_01.bvh out.h5 --body body.h5 --fps 30 --skip 1

Plain or .gz. Joints are matched by name: CMU's, Mixamo's and Daz's are known. Positions are read for the root only.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from clothjax.files.storage import load_rig
from data_prep.program import MotionOptions, run, write_motion
from data_prep.retarget import Capture, cmu_names, numbers, read_lines, retarget

DAZ_NAMES = {"hip": "Hips", "abdomen": "LowerBack", "chest": "Spine1", "neck": "Neck", "head": "Head"}
for _letter, _side in (("l", "Left"), ("r", "Right")):
    for _daz, _cmu in (
        ("Collar", "Shoulder"),
        ("Shldr", "Arm"),
        ("ForeArm", "ForeArm"),
        ("Hand", "Hand"),
        ("Thigh", "UpLeg"),
        ("Shin", "Leg"),
        ("Foot", "Foot"),
    ):
        DAZ_NAMES[_letter + _daz] = _side + _cmu


def read_bvh(path: str | Path) -> Capture:
    """Read the recording in a BVH file.

    Raises:
        ValueError: naming file and line.
    """
    lines = read_lines(path)
    names, parents, offsets, channels = _hierarchy(path, lines)
    line, words = next(lines, (0, []))
    if words[:1] != ["Frames:"]:
        raise ValueError(f"{path}, line {line}: expected 'Frames: N' after MOTION; cut short?")
    frames = int(numbers(path, line, words[1:], 1)[0])
    line, words = next(lines, (line, []))
    if words[:2] != ["Frame", "Time:"]:
        raise ValueError(f"{path}, line {line}: expected 'Frame Time: SECONDS'")
    (duration,) = numbers(path, line, words[2:], 1)
    if frames < 1 or duration <= 0:
        raise ValueError(f"{path}, line {line}: {frames} frames of {duration} s: both must be > 0")
    width = sum(map(len, channels))
    rows = []
    for line, words in lines:
        rows.append(numbers(path, line, words, width))
    if len(rows) != frames:
        raise ValueError(f"{path}, line {line}: {len(rows)} frames, {frames} announced; cut short?")

    values, column = np.array(rows), 0
    rotations = np.tile(np.eye(3), (frames, len(names), 1, 1))
    translation = np.tile(offsets[0], (frames, 1))
    for j, own in enumerate(channels):
        axes = "".join(c[0] for c in own if c.endswith("rotation"))
        turning = [column + k for k, c in enumerate(own) if c.endswith("rotation")]
        if axes:
            rotations[:, j] = Rotation.from_euler(axes, values[:, turning], degrees=True).as_matrix()
        for k, channel in enumerate(own):
            if j == 0 and channel.endswith("position"):
                translation[:, "XYZ".index(channel[0])] = values[:, column + k]
        column += len(own)
    plain = [name.rpartition(":")[2] for name in names]  # Mixamo writes mixamorig:Hips
    known = cmu_names(tuple(DAZ_NAMES.get(name, name) for name in plain))
    # CMU's rate is 120, its files say 0.0083333: without rounding every clip would be interpolated
    rate = round(1 / duration, 2)
    return Capture(known, np.array(parents), offsets, rotations, translation, rate)


def _hierarchy(path: str | Path, lines) -> tuple[list[str], list[int], np.ndarray, list[list[str]]]:
    """Read names, parents, offsets [n, 3] and channels of the joints, up to MOTION."""
    names, parents, offsets, channels = [], [], [], []
    open_joints: list[int] = []  # -1 for an end site
    next_open, line = None, 0  # joint whose brace comes next
    for line, words in lines:
        key = words[0]
        if key == "MOTION":
            if open_joints or not names or any(o is None for o in offsets):
                raise ValueError(f"{path}, line {line}: MOTION before the hierarchy is complete")
            return names, parents, np.array(offsets), channels
        if key in ("ROOT", "JOINT"):
            if len(words) < 2 or (key == "ROOT") == bool(names) or (key == "JOINT" and not open_joints):
                raise ValueError(f"{path}, line {line}: {' '.join(words)!r}: one ROOT, then JOINTs within it")
            next_open = len(names)
            names.append(" ".join(words[1:]).removesuffix("{").strip())
            parents.append(open_joints[-1] if open_joints else -1)
            offsets.append(None)
            channels.append([])
        elif key == "End":
            next_open = -1
        if words[-1] == "{":
            if next_open is None:
                raise ValueError(f"{path}, line {line}: '{{' without a joint")
            open_joints.append(next_open)
            next_open = None
        elif key == "}" and open_joints:
            open_joints.pop()
        elif key in ("OFFSET", "CHANNELS") and open_joints:
            joint = open_joints[-1]
            if key == "OFFSET" and joint >= 0:
                offsets[joint] = numbers(path, line, words[1:], 3)
            elif key == "CHANNELS":
                channels[joint] = _channels(path, line, words)
        elif key not in ("HIERARCHY", "ROOT", "JOINT", "End"):
            raise ValueError(f"{path}, line {line}: {' '.join(words)[:60]!r} is not part of a BVH hierarchy")
    raise ValueError(f"{path}, line {line}: no MOTION; cut short, or not a BVH file")


def _channels(path: str | Path, line: int, words: list[str]) -> list[str]:
    """Return the names of a joint's channels."""
    allowed = {axis + kind for axis in "XYZ" for kind in ("position", "rotation")}
    own = words[2:]
    if not set(own) <= allowed or len(set(own)) != len(own) or words[1:2] != [str(len(own))]:
        raise ValueError(
            f"{path}, line {line}: {' '.join(words)!r}: expected a count, then as many of {sorted(allowed)}"
        )
    return own


@dataclass(frozen=True)
class Arguments(MotionOptions):
    """Retarget a BVH recording onto a body."""

    motion: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    skip: int = 0
    """Frames left out at the start: in many files the first is an added T-pose."""
    abduct: float = 0.0
    """Degrees the upper arms are taken outward; 25 for CMU's recordings (see data_prep.asf_amc)."""
    drop_clavicles: float = 0.0
    """Degrees the clavicles are lowered; 15 for CMU's recordings."""


def main(args: Arguments) -> None:
    """Write the motion file, and print which frames are implausible."""
    rig, capture = load_rig(args.body), read_bvh(args.motion)
    capture = capture._replace(rotations=capture.rotations[args.skip :], translation=capture.translation[args.skip :])
    motion = retarget(
        capture, *rig, fps=args.fps, abduct=args.abduct, drop_clavicles=args.drop_clavicles, freeze=args.freeze
    )
    write_motion(args.output, motion, rig, args.motion, args)


if __name__ == "__main__":
    run(main, Arguments, __doc__)
