"""Motion capture in BVH files.

    python -m data_prep.bvh 01_01.bvh out.h5 --body body.h5 --fps 30 --skip 1

Plain or .gz. Which joint is which is known of many programs (`skeleton.py`), or said with `--joints map.yaml`. The
frames say which way is up, and how a joint is turned in a T-pose.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from clothjax.files.storage import load_rig
from data_prep import skeleton
from data_prep.program import SkeletonOptions, retarget_as_asked, run, write_motion
from data_prep.recording import LEAST_RATE, MOST_RATE, Capture, numbers, read_lines
from data_prep.rest_pose import figure
from data_prep.skeleton import cmu_names

USUAL = (24.0, 25.0, 30.0, 50.0, 60.0, 72.0, 90.0, 100.0, 120.0, 200.0, 240.0)  # of which others may be rounded
APART, JUMP = 3.0, 0.1  # of the farthest later jump, and of the longest bone: the jump after an added T-pose
STRAIGHT, TURNED = 1 + 2 * np.cos(np.radians([0.1, 10.0]))  # traces of rotations by 0.1 and by 10 degrees


def read_bvh(path: str | Path, tell: Callable[[str], object] = str, joints: Path | None = None) -> Capture:
    """Read the recording of the figure in a BVH file; what its hips hang on carries it.

    Args:
        path: of the file.
        tell: called with a line about each thing that is hardly meant: its Frame Time, angles, a second figure.
        joints: a mapping file, as of `skeleton.mapped`, for names that are not known.

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
    if not LEAST_RATE <= 1 / duration <= MOST_RATE:
        raise ValueError(
            f"{path}, line {line}: a Frame Time of {duration:g} would be {1 / duration:.3g} frames a second: it is in "
            f"seconds, such as {1 / 30:.4f}"
        )
    fps = _rate(words[2], duration)
    if abs(fps * duration - 1) > 5e-3:
        tell(f"a Frame Time of {words[2]} is taken as {fps:g} frames a second")
    width = sum(map(len, channels))
    rows = []
    for line, words in lines:
        rows.append(numbers(path, line, words, width))
    if len(rows) != frames:
        why = "cut short?" if len(rows) < frames else f"write 'Frames: {len(rows)}', or take out what is too much"
        raise ValueError(f"{path}, line {line}: {len(rows)} frames, {frames} announced; {why}")

    values, column = np.array(rows), 0
    rotations = np.tile(np.eye(3), (frames, len(names), 1, 1))
    places, turned = np.tile(offsets, (frames, 1, 1)), []
    given = np.full((frames, len(names), 3), np.nan)  # by channels of position
    for j, own in enumerate(channels):
        axes = "".join(c[0] for c in own if c.endswith("rotation"))
        turning = [column + k for k, c in enumerate(own) if c.endswith("rotation")]
        if axes:
            rotations[:, j] = Rotation.from_euler(axes, values[:, turning], degrees=True).as_matrix()
            turned += turning
        for k, channel in enumerate(own):
            if channel.endswith("position"):
                given[:, j, "XYZ".index(channel[0])] = values[:, column + k]
        column += len(own)
    if 0.1 < np.abs(values[:, turned]).max(initial=0.0) < 2 * np.pi:
        tell("no angle is over 6.28: are they in radians? BVH has degrees, so write them anew if they are")
    # some programs write the place on the parent, some what is added to it, which is nearer to zero than to the offset
    usual, own = np.median(given[:, 1:], axis=0), offsets[1:]
    added = np.nansum(usual * own) < 0.5 * np.sum(own**2, where=np.isfinite(usual))
    given[:, 1:] += own if added else 0.0
    places = np.where(np.isfinite(given), given, places)
    plain = cmu_names(tuple(name.rpartition(":")[2] for name in names))  # Mixamo writes mixamorig:Hips
    above = np.array(parents)
    hips = [parts.hips for parts in skeleton.figures(plain, above, joints)]
    for other in hips[1:]:
        tell(f"there are two figures: that of {names[hips[0]]} is taken, that of {names[other]} is left out")
    return _hanging_on(hips[0] if hips else 0, plain, above, places, rotations, fps)


def _rate(text: str, duration: float) -> float:
    """Return the usual rate that a Frame Time is the rounded time of, or its own: CMU writes 0.0083333 for 120 Hz."""
    digits = len(text.partition(".")[2]) if "e" not in text.lower() else 17
    usual = [rate for rate in USUAL if abs(duration - 1 / rate) < 1.01 * 10.0**-digits]
    return min(usual, key=lambda rate: abs(duration - 1 / rate), default=round(1 / duration, 2))


def _hanging_on(
    root: int, names: tuple[str, ...], parents: np.ndarray, places: np.ndarray, rotations: np.ndarray, fps: float
) -> Capture:
    """Return the recording of a joint and of all that hang on it; those above it, such as an armature, carry it.

    Args:
        root: the joint.
        names: of the joints.
        parents: [n] of the joints.
        places: [T, n, 3] on their parents; of the root in the world.
        rotations: [T, n, 3, 3] local.
        fps: frames a second.
    """
    path, turn = places[:, root], rotations[:, root]
    for joint in skeleton.ancestors(root, parents)[1:]:
        path = places[:, joint] + np.einsum("tab,tb->ta", rotations[:, joint], path)
        turn = rotations[:, joint] @ turn
    kept = [j for j in range(len(names)) if root in skeleton.ancestors(j, parents)]
    offsets, rotations = np.median(places[:, kept], axis=0), rotations[:, kept]
    offsets[0], rotations[:, 0] = 0.0, turn  # the root has its path
    above = np.array([-1, *(kept.index(parents[j]) for j in kept[1:])])
    return Capture(tuple(names[j] for j in kept), above, offsets, rotations, path, fps)


def _begins_apart(capture: Capture) -> bool:
    """Return whether the first frame has no rotations but the root's, or a joint jumps after it as never later."""
    if len(capture.rotations) < 3:
        return False
    turned = np.trace(capture.rotations[:2, 1:], axis1=-2, axis2=-1).min(axis=1, initial=3.0)  # 3: not at all
    if turned[0] > STRAIGHT and turned[1] < TURNED:
        return True
    moved = figure(capture, capture.rotations, capture.translation).positions
    jumps = np.linalg.norm(np.diff(moved, n=2, axis=0), axis=-1).max(axis=1, initial=0.0)
    least = JUMP * np.linalg.norm(capture.offsets, axis=1).max(initial=0.0)
    return jumps[0] > max(APART * jumps[1:].max(initial=0.0), least)


def _hierarchy(path: str | Path, lines) -> tuple[list[str], list[int], np.ndarray, list[list[str]]]:
    """Read names, parents, offsets [n, 3] and channels of the joints, up to MOTION."""
    names, parents, offsets, channels = [], [], [], []
    open_joints: list[int] = []  # -1 for an end site
    next_open, line = None, 0  # joint whose brace comes next
    for line, words in _statements(lines):
        key = words[0]
        if key == "MOTION":
            if open_joints or not names or any(o is None for o in offsets):
                raise ValueError(f"{path}, line {line}: MOTION before the hierarchy is complete")
            return names, parents, np.array(offsets), channels
        if key in ("ROOT", "JOINT"):
            if len(words) < 2 or (key == "ROOT") == bool(names) or (key == "JOINT" and not open_joints):
                raise ValueError(f"{path}, line {line}: {' '.join(words)!r}: one ROOT, then JOINTs within it")
            next_open = len(names)
            names.append(" ".join(words[1:]))
            parents.append(open_joints[-1] if open_joints else -1)
            offsets.append(None)
            channels.append([])
        elif key == "End":
            next_open = -1
        elif key == "{":
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
        elif key != "HIERARCHY":
            raise ValueError(f"{path}, line {line}: {' '.join(words)[:60]!r} is not part of a BVH hierarchy")
    raise ValueError(f"{path}, line {line}: no MOTION; cut short, or not a BVH file")


def _statements(lines: Iterator[tuple[int, list[str]]]) -> Iterator[tuple[int, list[str]]]:
    """Yield number and words of each statement in the lines of a hierarchy; a brace is one, wherever it is."""
    for line, words in lines:
        for statement in re.split("([{}])", " ".join(words)):
            if statement.strip():
                yield line, statement.split()


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
class Arguments(SkeletonOptions):
    """Retarget a BVH recording onto a body."""

    motion: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    skip: int = 0
    """Frames left out at the start: in many files the first is an added T-pose."""


def main(args: Arguments) -> None:
    """Write the motion file, and print which frames are implausible."""
    if args.skip < 0:
        raise ValueError(f"--skip {args.skip}: give how many frames are left out, 0 or more")
    rig = load_rig(args.body)
    capture = read_bvh(args.motion, lambda line: print(f"{args.motion}: {line}"), args.joints)
    if not args.skip and _begins_apart(capture):
        print(f"{args.motion}: frame 0 is far from the next, as an added T-pose is: --skip 1 leaves it out")
    capture = capture._replace(rotations=capture.rotations[args.skip :], translation=capture.translation[args.skip :])
    motion = retarget_as_asked(capture, rig, args, args.motion)
    write_motion(args.output, motion, rig, args.motion, args)


if __name__ == "__main__":
    run(main, Arguments, __doc__)
