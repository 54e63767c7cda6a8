"""Generated motions: walk, run, jump, arms, twist, dance. They are made to move cloth; feet slide and float a little.

    python -m data_prep.procedural OUT_DIR --seeds 0 1 2 --seconds 8

Angles are about the world's axes (+X left, +Y up, +Z forward), from a T-pose. They are sums of sinusoids, smooth steps
and band-limited noise that differ from seed to seed; each clip eases in from rest. The body's `canonical_rotation`
converts them to its canonical pose.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from clothjax.files.storage import canonical_rotation, joint_names, load_rig, save_motion
from clothjax.types import Motion
from data_prep.program import run
from data_prep.retarget import from_t_pose, stand
from data_prep.skeleton import landmarks

# cycles per second, before the factor of the seed
RATES = {"walk": 0.9, "run": 1.35, "jump": 0.5, "arms": 0.35, "twist": 0.4, "dance": 0.8}
KINDS = tuple(RATES)
# s, width of the Gaussian that smooths a kind's sharp turns, so that no frame counts as implausible
SMOOTHING = {"run": 0.06, "jump": 0.08}
ARMS_DOWN = 75.0  # degrees from the T-pose, at rest
EASE_IN = 0.8  # s

SIDES = ((1, "Left"), (-1, "Right"))


class Beat(NamedTuple):
    """Time, phase and size of a clip, of which its angles are functions."""

    kind: str
    time: np.ndarray  # [T] s
    phase: np.ndarray  # [T] rad
    rate: float  # Hz
    ramp: np.ndarray  # [T] from 0 at rest to 1
    size: float  # amplitude of this seed
    rng: np.random.Generator


class Pattern(NamedTuple):
    """A motion in the making: degrees [T, 3] about x, y, z by joint, and the root's path [T, 3] in metres."""

    angles: dict[str, np.ndarray]
    root: np.ndarray

    def rotate(self, joint: str, x=0.0, y=0.0, z=0.0) -> None:
        """Add degrees, constants or [T], to a joint."""
        total = self.angles.setdefault(joint, np.zeros_like(self.root))
        for axis, value in enumerate((x, y, z)):
            total[:, axis] += value


def generate(kind: str, seed: int = 0, seconds: float = 8.0, fps: float = 30.0, body: str | Path = "body") -> Motion:
    """Generate a motion of a kind on a body's joints, standing on y = 0.

    Args:
        kind: one of KINDS.
        seed: of the rate, size, phase and sway.
        seconds: duration of the clip.
        fps: frames per second.
        body: file (or embedded), whose joints have names that `skeleton` knows.

    Raises:
        ValueError: for an unknown kind, a clip of less than three frames, or a body without the joints.
    """
    if kind not in RATES:
        raise ValueError(f"there is no motion {kind!r}: choose one of {', '.join(KINDS)}")
    if not fps > 0 or not seconds * fps >= 2:
        raise ValueError(f"a clip of {seconds} s at {fps} fps has fewer than three frames: make it longer")
    pattern = _pattern(kind, seed, seconds, fps)
    to_t_pose = canonical_rotation(body)
    body, names = load_rig(body)
    known = landmarks(names, body.parents)
    missing = sorted(set(pattern.angles) - set(known))
    if missing:
        raise ValueError(f"the body has no joints {missing} (CMU's names) or the like, only {', '.join(names)}")
    local: dict[str, np.ndarray] = {}
    for joint, angles in pattern.angles.items():  # two of a short trunk may be one
        name, turn = names[known[joint]], _matrices(angles)
        local[name] = local[name] @ turn if name in local else turn
    rotations = from_t_pose(local, body, names, to_t_pose)
    motion = Motion(rotations.astype(np.float32), pattern.root - body.joints[0], fps)
    return stand(motion, body)


def _pattern(kind: str, seed: int, seconds: float, fps: float) -> Pattern:
    """Return the angles and the root's path of a kind of motion."""
    rng = np.random.default_rng(10 * KINDS.index(kind) + seed)
    time = np.arange(int(seconds * fps) + 1) / fps
    rate = rng.uniform(0.85, 1.1) * RATES[kind]
    phase = 2 * np.pi * rate * time + rng.uniform(0, 2 * np.pi)
    beat = Beat(kind, time, phase, rate, _step(time, 0, EASE_IN), rng.uniform(0.85, 1.15), rng)
    pattern = Pattern({}, np.zeros((len(time), 3)))
    for sign, side in SIDES:
        pattern.rotate(f"{side}Arm", z=-sign * ARMS_DOWN)
    for sign, side in SIDES:
        pattern.rotate(f"{side}ForeArm", y=-sign * 12.0)
    moves = {"walk": _gait, "run": _gait, "jump": _jump, "arms": _arms, "twist": _twist, "dance": _dance}
    moves[kind](pattern, beat)
    for angles in pattern.angles.values():
        for axis in range(3):
            angles[:, axis] += beat.ramp * 1.5 * _noise(beat)
    pattern.rotate("Neck", y=beat.ramp * 5 * _noise(beat))
    pattern.rotate("Head", y=beat.ramp * 6 * _noise(beat))
    width = SMOOTHING.get(kind, 0.0) * fps
    if width:
        smooth = {j: gaussian_filter1d(a, width, axis=0, mode="nearest") for j, a in pattern.angles.items()}
        pattern = Pattern(smooth, gaussian_filter1d(pattern.root, width, axis=0, mode="nearest"))
    return pattern


def _gait(pattern: Pattern, beat: Beat) -> None:
    """Walk or run: move hips, knees, ankles and opposed arms half a cycle apart, and change direction slowly."""
    running = beat.kind == "run"
    hip, knee, shoulder, lean, speed = (42, 95, 42, 12, 3.0) if running else (26, 55, 26, 3, 1.35)
    hip, knee, shoulder = beat.size * hip, beat.size * knee, beat.size * shoulder
    ramp, sine = beat.ramp, np.sin
    for sign, side in SIDES:
        q = beat.phase + (0 if sign > 0 else np.pi)
        pattern.rotate(f"{side}UpLeg", x=ramp * (-hip * sine(q) - 0.25 * hip * running))
        pattern.rotate(f"{side}Leg", x=ramp * (knee * np.clip(sine(q + 1.15), 0, None) ** 1.5 + 6))
        pattern.rotate(f"{side}Foot", x=ramp * 10 * sine(q - 0.6))
        pattern.rotate(f"{side}Arm", x=ramp * shoulder * sine(q), z=sign * ramp * 8)
        bend = 70 + 15 * sine(q) if running else 20 + 12 * sine(q)
        pattern.rotate(f"{side}ForeArm", y=-sign * ramp * bend)
    p = beat.phase
    pattern.rotate("Hips", x=ramp * lean, y=ramp * 7 * sine(p), z=ramp * 3 * sine(p))
    pattern.rotate("Spine", y=-ramp * 10 * sine(p))
    pattern.root[:, 1] = -ramp * (0.05 if running else 0.02) * (1 + np.cos(2 * p)) / 2
    pattern.root[:, 2] = np.cumsum(ramp) * speed * (beat.time[1] - beat.time[0])
    pattern.rotate("Hips", y=ramp * beat.rng.normal() * 25 * _step(beat.time, 1, beat.time[-1]))


def _jump(pattern: Pattern, beat: Beat) -> None:
    """Crouch, leap along a parabola with the arms thrown up, land into a crouch, stand."""
    phase = (beat.time * beat.rate) % 1
    crouch = _step(phase, 0.0, 0.3) - _step(phase, 0.3, 0.42) + _step(phase, 0.62, 0.7) - _step(phase, 0.7, 0.95)
    leap = np.where((phase > 0.40) & (phase < 0.66), 1 - ((phase - 0.53) / 0.13) ** 2, 0).clip(0)
    ramp = beat.ramp
    for sign, side in SIDES:
        pattern.rotate(f"{side}UpLeg", x=-ramp * 70 * crouch)
        pattern.rotate(f"{side}Leg", x=ramp * 105 * crouch)
        pattern.rotate(f"{side}Foot", x=-ramp * 35 * crouch)
        pattern.rotate(f"{side}Arm", x=ramp * (50 * crouch - 120 * leap), z=sign * 12 * ramp)
    pattern.rotate("LowerBack", x=ramp * 22 * crouch)
    pattern.root[:, 1] = ramp * (-0.36 * crouch + 0.34 * leap)


def _arms(pattern: Pattern, beat: Beat) -> None:
    """Raise the arms sideways and lower them, each in its own phase, with bending elbows."""
    ramp = beat.ramp
    for sign, side in SIDES:
        lag = 0 if sign > 0 else beat.rng.uniform(0, np.pi)
        up = 0.5 - 0.5 * np.cos(beat.phase + lag)
        sway = sign * ramp * 30 * _noise(beat)
        pattern.rotate(f"{side}Arm", z=sign * ramp * up * (ARMS_DOWN + 60), y=-sway)
        pattern.rotate(f"{side}Shoulder", z=sign * ramp * up * 14)
        pattern.rotate(f"{side}ForeArm", y=-sign * ramp * 40 * (0.5 + 0.5 * np.sin(1.7 * beat.phase)))


def _twist(pattern: Pattern, beat: Beat) -> None:
    """Turn, bow and lean the trunk with half raised arms."""
    ramp, p = beat.ramp, beat.phase
    for joint, degrees in (("LowerBack", 12), ("Spine", 14), ("Spine1", 10)):
        turn = ramp * beat.size * degrees * np.sin(p)
        pattern.rotate(joint, x=ramp * 9 * np.sin(0.5 * p) ** 2, y=turn, z=ramp * 7 * np.sin(0.7 * p))
    for sign, side in SIDES:
        pattern.rotate(f"{side}Arm", x=ramp * 20 * np.sin(p - 0.5), z=sign * ramp * 45)


def _dance(pattern: Pattern, beat: Beat) -> None:
    """Step on the spot with wide arms, turning the hips against the chest."""
    ramp, p, sine = beat.ramp, beat.phase, np.sin
    for sign, side in SIDES:
        q = p + (0 if sign > 0 else np.pi)
        pattern.rotate(f"{side}UpLeg", x=-ramp * (14 + 16 * sine(q)), z=sign * ramp * 8)
        pattern.rotate(f"{side}Leg", x=ramp * (24 + 24 * sine(q)))
        pattern.rotate(f"{side}Arm", x=-ramp * 35 * sine(2 * p), z=sign * ramp * (50 + 45 * sine(q + 0.7)))
        pattern.rotate(f"{side}ForeArm", y=-sign * ramp * (50 + 35 * sine(2 * q)))
    pattern.rotate("Hips", y=ramp * 28 * sine(0.5 * p), z=ramp * 9 * sine(p))
    pattern.rotate("Spine", y=ramp * 14 * sine(2 * p), z=-ramp * 14 * sine(p))
    pattern.root[:, 0] = ramp * 0.12 * sine(0.5 * p)
    pattern.root[:, 1] = -ramp * 0.07 * (1 + sine(2 * p)) / 2


def _step(x: np.ndarray, start: float, end: float) -> np.ndarray:
    """Return 0 before `start`, 1 after `end` and a smooth step between, with two continuous derivatives."""
    s = np.clip((x - start) / (end - start), 0, 1)
    return s**3 * (s * (6 * s - 15) + 10)


def _noise(beat: Beat, waves: int = 4) -> np.ndarray:
    """Return smooth noise [T] of about unit size with frequencies of 0.12 to 0.6 Hz."""
    speed = beat.rng.uniform(0.2, 1, waves) * 0.6 * 2 * np.pi
    offset = beat.rng.uniform(0, 2 * np.pi, waves)
    height = beat.rng.normal(size=waves)
    return (np.sin(beat.time[:, None] * speed + offset) * height).sum(axis=1) / np.sqrt(waves / 2) / 1.5


def _matrices(degrees: np.ndarray) -> np.ndarray:
    """Convert degrees [T, 3] about x, y, z to rotations [T, 3, 3]."""
    return Rotation.from_euler("zyx", degrees[:, ::-1], degrees=True).as_matrix()


@dataclass(frozen=True)
class Arguments:
    """Generate motions and write one file for each kind and seed."""

    directory: tyro.conf.Positional[Path]
    kinds: tuple[str, ...] = KINDS
    seeds: tuple[int, ...] = (0, 1, 2, 3)
    seconds: float = 8.0
    """Duration of each clip."""
    fps: float = 30.0
    """Frames per second."""
    body: str = "body"
    """File of the body, or the name of the embedded one."""


def main(args: Arguments) -> None:
    """Write the motion files and print their paths."""
    names = joint_names(args.body)
    for kind in args.kinds:
        for seed in args.seeds:
            motion = generate(kind, seed, args.seconds, args.fps, args.body)
            name = f"{kind}_{seed}"
            path = args.directory / f"{name}.h5"
            save_motion(path, motion, names, name=name, source="data_prep.procedural", licence="CC0-1.0")
            print(path)


if __name__ == "__main__":
    run(main, Arguments, __doc__)
