"""Motion of AMASS (SMPL-H and SMPL-X layouts), carried over to any body with CMU's or SMPL's joint names.

    python -m data_prep.amass 01_01_poses.npz out.h5 --body body.h5 --fps 30

SMPL's poses are relative to a T-pose, so no skeleton of who was recorded is needed. Hands and toes stay still. The
files are up in z; of others, say so with --up y.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from clothjax.cli import arguments, fail_clearly
from clothjax.files.storage import UNREADABLE, canonical_rotation, joint_names, load_body, save_motion
from clothjax.types import Motion
from data_prep.repair import Bad, mend
from data_prep.retarget import FROZEN, Capture, cmu_names, from_t_pose, leg_length, resample, stand
from data_prep.smpl import BODY

RATES = ("mocap_framerate", "mocap_frame_rate", "fps")


def read_amass(path: str | Path, up: Literal["y", "z"] = "z") -> Capture:
    """The recording in a file, +Y up, its joints named as CMU's; without a skeleton: its offsets are zero.

    Raises:
        ValueError: naming the file, the array and the first wrong entry.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = [key for key in ("poses", "trans") if key not in file.files]
            rate = next((key for key in RATES if key in file.files), None)
            if missing or rate is None:
                raise ValueError(f"no {', '.join(missing) or RATES[0]} in it, only {', '.join(file.files)}")
            poses, trans, fps = (np.asarray(file[key], np.float64) for key in ("poses", "trans", rate))
    except FileNotFoundError:
        raise
    except UNREADABLE as error:
        raise ValueError(f"{path}: not a motion of AMASS: {error}") from error
    if poses.ndim == 3:
        poses = poses.reshape(len(poses), -1)
    if poses.ndim != 2 or poses.shape[1] < 3 * len(BODY) or trans.shape != (len(poses), 3):
        raise ValueError(
            f"{path}: poses {poses.shape} and trans {trans.shape}: expected [T, {3 * len(BODY)} or more] and [T, 3]"
        )
    for name, rows in (("poses", poses), ("trans", trans)):
        wrong = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(wrong):
            raise ValueError(f"{path}: {name} of frame {wrong[0]} is not finite: cut it out")
    if fps.size != 1 or not 0 < fps.item() < 1e4:
        raise ValueError(f"{path}: {rate} is {fps}, not a rate in Hz")
    poses = poses[:, : 3 * len(BODY)].reshape(-1, 3)
    rotations = Rotation.from_rotvec(poses).as_matrix().reshape(len(trans), len(BODY), 3, 3)
    if up == "z":
        turn = Rotation.from_euler("x", -90, degrees=True).as_matrix()
        rotations[:, 0] = turn @ rotations[:, 0]
        trans = trans @ turn.T
    return Capture(cmu_names(BODY), np.full(len(BODY), -1), np.zeros((len(BODY), 3)), rotations, trans, fps.item())


def carry(
    capture: Capture, body_file: str | Path, *, fps: float = 30.0, leg: float = 0.8, freeze: bool = True
) -> tuple[Motion, tuple[str, ...]]:
    """A recording on the joints of a body file, starting above the origin and standing on y = 0; and their names.

    Args:
        leg: length of a leg, hip to ankle, of who was recorded, m: the path is scaled to the body's.
        freeze: keep toes and wrists as in the canonical pose.

    Raises:
        ValueError: for a body without the joints, or a recording of fewer than two frames.
    """
    capture = resample(capture, fps)
    body, names = load_body(body_file), joint_names(body_file)
    known = cmu_names(names)
    local = {
        name: capture.rotations[:, i]
        for i, name in enumerate(capture.names)
        if not (freeze and any(part in name for part in FROZEN))
    }
    lacking = sorted(set(local) - set(known))
    if lacking:
        raise ValueError(f"{body_file} has no joint {', '.join(lacking)}: name its joints as CMU's or SMPL's")
    rotations = from_t_pose(local, body, known, canonical_rotation(body_file))
    scale = leg_length({name: body.joints[i] for i, name in enumerate(known)}) / leg
    path = (capture.translation - capture.translation[0] * [1, 0, 1]) * scale
    return stand(Motion(rotations.astype(np.float32), path, fps), body), names


@dataclass(frozen=True)
class Arguments:
    """A motion of AMASS as a motion file."""

    motion: tyro.conf.Positional[Path]
    """.npz as published."""
    output: tyro.conf.Positional[Path]
    body: str = "body"
    """The body to carry it over to, by asset name or path."""
    fps: float = 30.0
    up: Literal["y", "z"] = "z"
    leg: float = 0.8
    """Length of a leg of who was recorded, hip to ankle, m."""
    freeze: bool = True
    """Keep wrists and toes still."""
    bad: Bad = "keep"
    """What becomes of frames in which no body could have moved so: `keep`, `repair` by interpolation, or `drop` all but
    the longest stretch without any."""
    licence: str = "of the recording"


def main(args: Arguments) -> None:
    """Writes the file the arguments ask for, and says which frames are implausible."""
    motion, names = carry(read_amass(args.motion, args.up), args.body, fps=args.fps, leg=args.leg, freeze=args.freeze)
    name = args.motion.name.partition(".")[0]
    motion, said = mend(motion, load_body(args.body), args.bad)
    save_motion(args.output, motion, names, name=name, source=args.motion.name, licence=args.licence)
    print(f"{args.output}: {len(motion.translation)} frames, {said}")


if __name__ == "__main__":
    with fail_clearly():
        main(arguments(Arguments, "data_prep.amass", __doc__))
