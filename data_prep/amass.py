"""Motions of AMASS (SMPL-H and SMPL-X layouts), for any body whose joints have names of a known scheme.

    python -m data_prep.amass 01_01_poses.npz out.h5 --body body.h5 --fps 30
    python -m data_prep.amass --list configs/thesis/takes.yaml AMASS_FOLDER OUT_FOLDER --body body.h5

The second writes a file for each take of CMU's in the list, such as `OUT_FOLDER/cmu_07_02.motion.h5`.

SMPL's poses are relative to a T-pose, so the skeleton of the recorded person is not needed. Hands and toes stay still.
Poses may be axis-angle, quaternions, matrices or their first two columns (6D). The files have z up; others show that by
how their figures stand.
"""

import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm

from clothjax.files import configuration
from clothjax.files.damage import UNREADABLE
from clothjax.files.storage import Rig, canonical_rotation, load_rig
from clothjax.progress import progress_bar
from clothjax.types import Motion
from data_prep import doubts, pose_arrays, skeleton
from data_prep.program import METRES, Axis, MotionOptions, Unit, run, write_motion
from data_prep.recording import LEAST_RATE, MOST_RATE, Capture, resample
from data_prep.rest_pose import AXES, UPRIGHT, turn_upright
from data_prep.retarget import FROZEN, from_t_pose, leg_length, stand
from data_prep.skeleton import cmu_names
from data_prep.smpl import BODY
from data_prep.takes import Takes, find

RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
STANDING = (0.5, 1.5)  # m, of the pelvis of a figure that stands, or jumps, above the ground at zero
HIGHEST = 10.0  # m, of a pelvis whose path is in metres


def read_amass(
    path: str | Path,
    up: Axis | None = None,
    units: Unit = "m",
    allow: bool = False,
    tell: Callable[[str], object] = str,
) -> Capture:
    """Read a recording with +Y up and CMU's joint names; it has no skeleton, so its offsets are zero.

    Args:
        path: .npz.
        up: axis that points up; None for the one along which the figures stand.
        units: of the path.
        allow: take another axis than that, a crooked trunk, and knees and elbows that bend the wrong way.
        tell: called with a line if it is not z that is up.

    Raises:
        ValueError: naming the file, the array and the first wrong entry; for a path that is not in `units`; for what
            `allow` would take.
    """
    poses, trans, fps = _arrays(path)
    rotations = pose_arrays.matrices(poses, path)
    crooked = [] if allow else pose_arrays.crooked(rotations)
    if crooked:
        raise ValueError(
            f"{path}: poses {poses.shape} are no rotations of a known kind: as they are, {', '.join(crooked)} would be "
            "turned as no body is; convert them to axis-angle of joints on their parents, --allow takes it all the same"
        )
    trans = trans * METRES[units]
    wrong = [part for part, one_way in pose_arrays.bends(rotations).items() if one_way < -pose_arrays.ONE_WAY]
    if wrong and not allow:
        raise ValueError(
            f"{path}: {' and '.join(wrong)} bend the wrong way: left and right are exchanged, or an axis is negated; "
            "convert it again, --allow takes it all the same"
        )
    stands = rotations[:, 0, :, 1].mean(axis=0)  # SMPL's pelvis has +y up
    seen = max(AXES, key=lambda axis: float(stands @ AXES[axis]))
    seen = seen if stands @ AXES[seen] > UPRIGHT else None
    lies = seen not in (None, "z") and not STANDING[0] < float(np.median(trans @ AXES[seen])) < STANDING[1]
    if lies and up is None:
        raise ValueError(
            f"{path}: its pelvis stands along {seen}, but is not as high there: give --up z if the figure lies or "
            f"crawls, --up {seen} if it stands"
        )
    if up is not None and seen not in (None, up) and not (allow or lies):
        raise ValueError(f"{path}: --up {up}, but its figure stands along {seen}; --allow takes it all the same")
    if up is None and seen not in (None, "z"):
        tell(f"{seen} is up, for the figure stands along it; --up says otherwise")
    up = up or seen or "z"
    speed = np.linalg.norm(np.diff(trans, axis=0), axis=1).max(initial=0.0) * fps
    height = abs(float(np.median(trans @ AXES[up])))
    if units == "m" and (speed > doubts.FASTEST or height > HIGHEST):
        found = f"up to {speed:.0f} m/s, {height:.0f} m high"
        raise ValueError(f"{path}: trans looks like centimetres ({found}): give --units cm, or mm, or cut jumps out")
    turn = turn_upright(AXES[up])
    rotations[:, 0], trans = turn @ rotations[:, 0], trans @ turn.T
    return Capture(cmu_names(BODY), np.full(len(BODY), -1), np.zeros((len(BODY), 3)), rotations, trans, fps)


def _arrays(path: str | Path) -> tuple[np.ndarray, np.ndarray, float]:
    """Return poses [T, ...], path [T, 3] and rate of a file, finite and of two frames at least."""
    try:
        if not zipfile.is_zipfile(Path(path).resolve(strict=True)):
            raise ValueError("an .npz file of poses, trans and mocap_framerate is expected: convert it")
        with Path(path).open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            missing = [key for key in ("poses", "trans") if key not in file.files]
            rated = [key for key in RATES if key in file.files]
            if missing or not rated:
                raise ValueError(f"no {', '.join(missing) or RATES[0]} in it, only {', '.join(file.files)}")
            poses, trans = (np.asarray(file[key], np.float64) for key in ("poses", "trans"))
            rates = np.unique(np.concatenate([np.asarray(file[key], np.float64).ravel() for key in rated]))
    except FileNotFoundError:
        raise
    except UNREADABLE as error:
        raise ValueError(f"{path}: not a motion of AMASS: {error}") from error
    if trans.ndim != 2 or trans.shape[1:] != (3,) or poses.ndim < 2 or len(poses) != len(trans):
        raise ValueError(f"{path}: poses {poses.shape} and trans {trans.shape}: expected [T, ...] and [T, 3]")
    if len(trans) < 2:
        raise ValueError(f"{path}: a motion has two frames at least, not {len(trans)}: take a longer one")
    for name, rows in (("poses", poses.reshape(len(poses), -1)), ("trans", trans)):
        wrong = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(wrong):
            raise ValueError(f"{path}: {name} of frame {wrong[0]} is not finite: cut it out")
    if len(rates) != 1:
        raise ValueError(
            f"{path}: {', '.join(rated)} has {len(rates)} rates, as {rates[:3].tolist()}: leave the right one"
        )
    (fps,) = rates.tolist()
    if not LEAST_RATE <= fps <= MOST_RATE:
        raise ValueError(
            f"{path}: {', '.join(rated)} is {fps:g}, not a rate in Hz: {LEAST_RATE:g} to {MOST_RATE:g} are expected"
        )
    return poses, trans, fps


def retarget_amass(
    capture: Capture,
    body_file: str | Path,
    *,
    fps: float = 30.0,
    leg: float = 0.8,
    freeze: bool = True,
    tell: Callable[[str], object] = str,
) -> tuple[Motion, Rig]:
    """Retarget a recording onto the body in a file, starting above the origin and standing on y = 0.

    Args:
        capture: the recording, from `read_amass`.
        body_file: file of the body (or embedded), whose joints have names that `skeleton` knows.
        fps: frames per second of the result.
        leg: m, from hip to ankle of the recorded person; the path is scaled to the body's leg.
        freeze: keep toes and wrists as in the canonical pose.
        tell: called with a line if it does not stand on the file's zero.

    Returns:
        The motion, and the body with its joint names.

    Raises:
        ValueError: for a body without the joints, or a recording of fewer than two frames.
    """
    capture, rig = resample(capture, fps), load_rig(body_file)
    parts = skeleton.find(cmu_names(rig.names), rig.body.parents, str(body_file))
    known = skeleton.landmarks(rig.names, rig.body.parents)
    moved = {name: i for i, name in enumerate(capture.names) if not (freeze and any(part in name for part in FROZEN))}
    lacking = sorted(set(moved) - set(known))
    if lacking:
        raise ValueError(f"{body_file} has no joint that is known as {', '.join(lacking)}: rename its joints")
    local: dict[str, np.ndarray] = {}
    for joint, i in moved.items():  # two of a short trunk may be one
        name, turn = rig.names[known[joint]], capture.rotations[:, i]
        local[name] = local[name] @ turn if name in local else turn
    rotations = from_t_pose(local, rig.body, rig.names, canonical_rotation(body_file))
    scale = leg_length(rig.body.joints, parts) / leg
    path = (capture.translation - capture.translation[0] * [1, 0, 1]) * scale - rig.body.joints[0]
    motion = stand(Motion(rotations.astype(np.float32), path, fps), rig.body)
    for line in doubts.ground(float(path[0, 1] - motion.translation[0, 1])):
        tell(line)
    return motion, rig


@dataclass(frozen=True)
class Arguments(MotionOptions):
    """Retarget a motion of AMASS, or those of a list, onto a body."""

    motion: tyro.conf.Positional[Path]
    """.npz as published; with --list the folder of AMASS."""
    output: tyro.conf.Positional[Path]
    """File to write; with --list the folder of the files."""
    list: Path | None = None
    """YAML file of CMU's takes, such as configs/thesis/takes.yaml."""
    up: Axis | None = None
    """Axis of the file that points up; it is the one along which the figures stand unless given."""
    allow: bool = False
    """Take another axis than that, a crooked trunk, and knees and elbows that bend the wrong way."""
    units: Unit = "m"
    """Unit of the path."""
    leg: float = 0.8
    """Length of the recorded person's leg, hip to ankle, m."""


def main(args: Arguments) -> None:
    """Write the motion file, or those of a list, and print which frames are implausible."""
    if args.list is None:
        convert(args.motion, args.output, args)
    else:
        convert_list(args.list, args)


def convert(recording: Path, output: Path, args: Arguments) -> int:
    """Write the motion file of a recording, print which frames are implausible, and return the number of frames.

    Raises:
        ValueError: as `read_amass`, `retarget_amass` and `mend`.
    """

    def tell(line: str) -> None:
        tqdm.write(f"{recording}: {line}")

    capture = read_amass(recording, args.up, args.units, args.allow, tell)
    motion, rig = retarget_amass(capture, args.body, fps=args.fps, leg=args.leg, freeze=args.freeze, tell=tell)
    return write_motion(output, motion, rig, recording, args)


def convert_list(path: Path, args: Arguments) -> None:
    """Write the motion files of the takes in a list, and print how many takes and frames each kind has.

    Raises:
        ValueError: for a list, body or folder that is wrong; after all other takes, naming those that are missing or
            refused.
    """
    takes = configuration.load(Takes, path)
    load_rig(args.body)  # a wrong body is refused once, not with every take
    files = find(args.motion, takes.all, tqdm.write)
    frames: dict[str, int] = {}
    failed: dict[str, list[str]] = {}  # takes by the reason
    with progress_bar("takes", len(takes.all)) as report:
        for done, take in enumerate(takes.all, start=1):
            try:
                if take not in files:
                    raise ValueError(f"not in {args.motion} as SUBJECT/TAKE_poses.npz or SUBJECT/TAKE_stageii.npz")
                frames[take] = convert(files[take], args.output / f"cmu_{take}.motion.h5", args)
            except ValueError as error:
                failed.setdefault(str(error), []).append(take)
            report(done)

    def count(kind: str, listed: Sequence[str]) -> str:
        there = [frames[take] for take in listed if take in frames]
        return f"{kind}: {len(there)} of {len(listed)} takes, {sum(there)} frames"

    for kind, listed in takes.train.items():
        print(count(kind, listed))
    total = count("train", [take for listed in takes.train.values() for take in listed])
    print(total if takes.frames is None else f"{total}; the list states {takes.frames} at 30 frames per second")
    print(count("test", takes.test))
    if failed:
        reasons = "; ".join(f"{', '.join(of_reason)}: {reason}" for reason, of_reason in failed.items())
        raise ValueError(f"{len(takes.all) - len(frames)} of {len(takes.all)} takes are not converted: {reasons}")


if __name__ == "__main__":
    run(main, Arguments, __doc__)
