"""Motions of AMASS (SMPL-H and SMPL-X layouts), for any body with CMU's or SMPL's joint names.

    python -m data_prep.amass 01_01_poses.npz out.h5 --body body.h5 --fps 30

SMPL's poses are relative to a T-pose, so the skeleton of the recorded person is not needed. Hands and toes stay still.
The files have z up; for others give --up y.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from clothjax.files.damage import UNREADABLE
from clothjax.files.storage import Rig, canonical_rotation, load_rig
from clothjax.types import Motion
from data_prep.program import MotionOptions, run, write_motion
from data_prep.retarget import FROZEN, Capture, cmu_names, from_t_pose, leg_length, resample, stand
from data_prep.smpl import BODY

RATES = ("mocap_framerate", "mocap_frame_rate", "fps")


def read_amass(path: str | Path, up: Literal["y", "z"] = "z") -> Capture:
    """Read a recording with +Y up and CMU's joint names; it has no skeleton, so its offsets are zero.

    Raises:
        ValueError: naming the file, the array and the first wrong entry.
    """
    try:
        with Path(path).open("rb") as opened, np.load(opened, allow_pickle=False) as file:
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


def retarget_amass(
    capture: Capture, body_file: str | Path, *, fps: float = 30.0, leg: float = 0.8, freeze: bool = True
) -> tuple[Motion, Rig]:
    """Retarget a recording onto the body in a file, starting above the origin and standing on y = 0.

    Args:
        capture: the recording, from `read_amass`.
        body_file: file of the body (or embedded), with CMU's or SMPL's joint names.
        fps: frames per second of the result.
        leg: m, from hip to ankle of the recorded person; the path is scaled to the body's leg.
        freeze: keep toes and wrists as in the canonical pose.

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
    scale = leg_length({name: rig.body.joints[i] for i, name in enumerate(names)}) / leg
    path = (capture.translation - capture.translation[0] * [1, 0, 1]) * scale
    return stand(Motion(rotations.astype(np.float32), path, fps), rig.body), rig


@dataclass(frozen=True)
class Arguments(MotionOptions):
    """Retarget a motion of AMASS onto a body."""

    motion: tyro.conf.Positional[Path]
    """.npz as published."""
    output: tyro.conf.Positional[Path]
    up: Literal["y", "z"] = "z"
    """Axis of the file that points up."""
    leg: float = 0.8
    """Length of the recorded person's leg, hip to ankle, m."""


def main(args: Arguments) -> None:
    """Write the motion file, and print which frames are implausible."""
    capture = read_amass(args.motion, args.up)
    motion, rig = retarget_amass(capture, args.body, fps=args.fps, leg=args.leg, freeze=args.freeze)
    write_motion(args.output, motion, rig, args.motion, args)


if __name__ == "__main__":
    run(main, Arguments, __doc__)
