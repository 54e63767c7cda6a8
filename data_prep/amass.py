"""Motions of AMASS (SMPL-H and SMPL-X layouts), for any body with CMU's or SMPL's joint names.

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
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from clothjax.files import configuration
from clothjax.files.damage import UNREADABLE
from clothjax.files.storage import Rig, canonical_rotation, load_rig
from clothjax.progress import progress_bar
from clothjax.types import Motion
from data_prep import doubts, skeleton
from data_prep.program import METRES, Axis, MotionOptions, Unit, run, write_motion
from data_prep.recording import LEAST_RATE, MOST_RATE, Capture, resample
from data_prep.rest_pose import AXES, UPRIGHT, turn_upright
from data_prep.retarget import FROZEN, from_t_pose, leg_length, stand
from data_prep.skeleton import cmu_names
from data_prep.smpl import BODY
from data_prep.takes import Takes, find

RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
NEARLY, WRONG = 0.25, 0.7  # by which entries of rotations are off half of the time, as of a network, and ever
TRUNK = ("spine1", "spine2", "spine3", "neck", "left_collar", "right_collar")
MOST_TURNED = 1.2  # rad, of these on their parents
BONES = tuple(
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
)
MOVED, RIGID = 0.05, 0.02  # m that bones move, and the share of their lengths by which these change, of positions
STANDING = (0.5, 1.5)  # m, of the pelvis of a figure that stands, or jumps, above the ground at zero
HIGHEST = 10.0  # m, of a pelvis whose path is in metres
LARGEST = 4 * np.pi  # rad, of a turn that is not in degrees
BENT = 0.1  # rad, of knees or elbows on average, that show which way these bend ...
ONE_WAY = 0.5  # ... if this share of it is in one direction


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
    rotations = _matrices(poses, path)
    crooked = [] if allow else _crooked(rotations)
    if crooked:
        raise ValueError(
            f"{path}: poses {poses.shape} are no rotations of a known kind: as they are, {', '.join(crooked)} would be "
            "turned as no body is; convert them to axis-angle of joints on their parents, --allow takes it all the same"
        )
    trans = trans * METRES[units]
    wrong = [part for part, one_way in _bends(rotations).items() if one_way < -ONE_WAY]
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


def _matrices(poses: np.ndarray, path: str | Path) -> np.ndarray:
    """Return rotations [T, J, 3, 3] of BODY in poses, which their shape, norms and right angles tell apart.

    Args:
        poses: axis-angle [T, 3 J] or [T, J, 3], quaternions [T, 4 J] or [T, J, 4], matrices [T, 9 J] or [T, J, 3, 3],
            or two of their columns or rows [T, 6 J], [T, J, 6] or [T, J, 3, 2].
        path: of the file, for messages.
    """
    count = poses[0].size
    own = count if poses.ndim == 2 else int(np.prod(poses.shape[2:]))
    for width, convert in ((9, _of_matrices), (6, _of_six), (4, _of_quaternions), (3, _of_axis_angle)):
        if own in (width, count) and count % width == 0 and count >= width * len(BODY):
            found = convert(poses.reshape(len(poses), -1, width)[:, : len(BODY)], path)
            if found is not None:
                return found
    raise ValueError(
        f"{path}: poses {poses.shape}: expected axis-angle [T, J, 3], quaternions [T, J, 4] or matrices [T, J, 3, 3] "
        f"of at least {len(BODY)} joints, or two columns of those; convert it"
    )


def _of_matrices(nines: np.ndarray, path: str | Path) -> np.ndarray | None:
    """Return the rotations [T, J, 3, 3] of which [T, J, 9] are the entries, None if they are no matrices."""
    matrices = nines.reshape(*nines.shape[:2], 3, 3)
    off = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    off = np.where(np.linalg.det(matrices) > 0, off, np.inf)
    return _nearest(matrices) if _are_rotations(off, path) else None


def _of_six(sixes: np.ndarray, path: str | Path) -> np.ndarray | None:
    """Return the rotations [T, J, 3, 3] of which two columns or rows are given, None if [T, J, 6] are none of these.

    The two follow each other or alternate: only as they are meant are they at right angles. Columns alternate; of those
    that follow each other the knees show what they are, for they bend one way.
    """
    pair = sixes.reshape(*sixes.shape[:2], 2, 3)
    layouts = {"in a row": (pair[..., 0, :], pair[..., 1, :]), "alternating": (sixes[..., ::2], sixes[..., 1::2])}

    def off(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        products = np.stack([np.sum(a * a, axis=-1) - 1, np.sum(b * b, axis=-1) - 1, np.sum(a * b, axis=-1)])
        return np.abs(products).max(axis=0)

    layout = min(layouts, key=lambda name: np.median(off(*layouts[name])))
    a, b = layouts[layout]
    if not _are_rotations(off(a, b), path):
        return None
    columns = _nearest(np.stack([a, b, np.cross(a, b)], axis=-1))
    one_way = 1.0 if layout == "alternating" else _bends(columns).get("knees", 0.0)
    if abs(one_way) < ONE_WAY:
        raise ValueError(
            f"{path}: poses {sixes.shape} are 6D, but its knees do not show by their bend whether they are "
            "columns or rows of matrices; convert it to axis-angle"
        )
    return columns if one_way > 0 else np.swapaxes(columns, -1, -2)


def _of_quaternions(fours: np.ndarray, path: str | Path) -> np.ndarray | None:
    """Return the rotations [T, J, 3, 3] of quaternions [T, J, 4] of any one norm, None if they are none."""
    norms = np.linalg.norm(fours, axis=-1)
    if not _are_rotations(np.abs(norms / max(np.median(norms), 1e-9) - 1.0), path):
        return None
    first, *_, last = np.abs(fours).mean(axis=(0, 1))  # that of the angle is largest: most joints turn little
    order = fours[..., [1, 2, 3, 0]] if first > last else fours
    return Rotation.from_quat(order.reshape(-1, 4)).as_matrix().reshape(*fours.shape[:2], 3, 3)


def _of_axis_angle(threes: np.ndarray, path: str | Path) -> np.ndarray:
    """Return the rotations [T, J, 3, 3] of vectors [T, J, 3], in rad along their axes."""
    largest = np.linalg.norm(threes, axis=-1).max()
    if largest > LARGEST:
        raise ValueError(f"{path}: poses turn by up to {largest:.0f} rad: are they in degrees? Convert it to radians")
    bones = [threes[:, BODY.index(end)] - threes[:, BODY.index(start)] for start, end in BONES]
    lengths = np.linalg.norm(bones, axis=-1)
    if np.ptp(bones, axis=1).max() > MOVED and np.all(np.ptp(lengths, axis=1) < RIGID * lengths.mean(axis=1)):
        raise ValueError(
            f"{path}: poses {threes.shape} are where joints are, for their distances stay the same: rotations are "
            "needed; convert it"
        )
    return Rotation.from_rotvec(threes.reshape(-1, 3)).as_matrix().reshape(*threes.shape, 3)


def _are_rotations(off: np.ndarray, path: str | Path) -> bool:
    """Return whether entries of joints [T, J] are those of rotations, by how far off they are.

    Raises:
        ValueError: if a few are not, naming the first.
    """
    if not np.median(off) < NEARLY:
        return False
    wrong = np.argwhere(off > WRONG)
    if len(wrong):
        frame, joint = wrong[0]
        raise ValueError(f"{path}: poses of frame {frame}, {BODY[joint]}, are no rotation, as others are: cut it out")
    return True


def _nearest(matrices: np.ndarray) -> np.ndarray:
    """Return the rotations [T, J, 3, 3] nearest to matrices."""
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_matrix().reshape(matrices.shape)


def _crooked(rotations: np.ndarray) -> list[str]:
    """Return the joints of the trunk that are turned on their parents by more than a body's over half of the frames.

    Args:
        rotations: [T, J, 3, 3] of SMPL's joints.
    """
    joints = [BODY.index(name) for name in TRUNK]
    angles = Rotation.from_matrix(rotations[:, joints].reshape(-1, 3, 3)).magnitude().reshape(-1, len(joints))
    return [name for name, angle in zip(TRUNK, np.median(angles, axis=0), strict=True) if angle > MOST_TURNED]


def _bends(rotations: np.ndarray) -> dict[str, float]:
    """Return which way knees and elbows bend: 1 as of a body, -1 the other way; those that hardly do are left out.

    Args:
        rotations: [T, J, 3, 3] of SMPL's joints.
    """
    joints = [BODY.index(name) for name in ("left_knee", "right_knee", "left_elbow", "right_elbow")]
    turned = Rotation.from_matrix(rotations[:, joints].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 4, 3)
    angles = {"knees": turned[:, :2, 0], "elbows": turned[:, 2:, 1] * [-1, 1]}
    sizes = {part: float(np.abs(bend).mean()) for part, bend in angles.items()}
    return {part: float(bend.mean()) / sizes[part] for part, bend in angles.items() if sizes[part] > BENT}


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
        body_file: file of the body (or embedded), with CMU's or SMPL's joint names.
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
    names = cmu_names(rig.names)
    local = {
        name: capture.rotations[:, i]
        for i, name in enumerate(capture.names)
        if not (freeze and any(part in name for part in FROZEN))
    }
    lacking = sorted(set(local) - set(names))
    if lacking:
        raise ValueError(f"{body_file} has no joint {', '.join(lacking)}: name its joints as CMU's or SMPL's")
    rotations = from_t_pose(local, rig.body, names, canonical_rotation(body_file))
    scale = leg_length(rig.body.joints, skeleton.find(names, rig.body.parents, str(body_file))) / leg
    path = (capture.translation - capture.translation[0] * [1, 0, 1]) * scale
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
