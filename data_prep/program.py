"""Shared parts of the programs: the command line, pictures, and the options and output of those that write motions."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from clothjax import cli
from clothjax.files.storage import Rig, save_motion
from clothjax.render import ray_cast
from clothjax.types import Motion
from data_prep import skeleton
from data_prep.doubts import doubts
from data_prep.recording import Capture
from data_prep.repair import Bad, mend
from data_prep.retarget import Axes, retarget


def run(main: Callable[[Any], None], arguments: type, description: str) -> None:
    """Call a program's `main` with its parsed command line; a mistake of the user's ends it with one line.

    Args:
        main: takes an instance of `arguments`.
        arguments: dataclass of the options.
        description: shown by --help; the program's docstring, with an example.
    """
    with cli.fail_clearly():
        main(cli.arguments(arguments, f"data_prep.{Path(sys.argv[0]).stem}", description))


@dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Options of every program that writes motions."""

    fps: float = 30.0
    """Frames per second of the result."""
    bad: Bad = "keep"
    """Treatment of frames with a movement that no body can make: `keep` them, `repair` them by interpolation, or `drop`
    all but the longest stretch without any."""
    licence: str = "of the recording"


@dataclass(frozen=True, kw_only=True)
class MotionOptions(OutputOptions):
    """Options of every program that retargets a recording onto a body."""

    body: str = "body"
    """File of the body, or the name of the embedded one."""
    freeze: bool = True
    """Keep hands, fingers and toes still."""


TOO_HIGH = 20.0  # m, of the hips in half of the frames, for a file that is read again
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
Unit = Literal["m", "cm", "mm", "in", "ft"]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


@dataclass(frozen=True, kw_only=True)
class SkeletonOptions(MotionOptions):
    """Options of every program that reads a recording with a skeleton of its own."""

    up: Axis | None = None
    """Axis of the file that points up; it is read off the frames unless given."""
    forward: Axis | None = None
    """Axis of the file that becomes forward, +z; unless given, the figure keeps its heading."""
    joints: Path | None = None
    """File that says which joint is which part, `left upper arm: Bone.012`, for names that are not known."""
    by_positions: bool = False
    """Take where the joints are, not how they are turned, which some programs choose as they like. Hands and toes stay
    on their limbs."""
    allow: bool = False
    """Take a recording without arms, hands or head, and a result that differs from the recording."""
    abduct: float = 0.0
    """Degrees the upper arms are taken outward; 25 for CMU's recordings (see data_prep.asf_amc)."""
    drop_clavicles: float = 0.0
    """Degrees the clavicles are lowered; 15 for CMU's recordings."""


def known_parts(
    names: tuple[str, ...], parents: np.ndarray, joints: Path | None, file: Path, allow: bool = False
) -> skeleton.Parts:
    """Find the parts of a body by the names of its joints, or by a mapping file.

    Args:
        names, parents: of the joints.
        joints: the mapping file; None to go by the names.
        file: that the joints are of.
        allow: take a skeleton without arms or head.

    Raises:
        ValueError: if joints are not known; a mapping file to fill in is then written and named.
    """
    if joints is not None:
        return skeleton.mapped(names, parents, joints, allow)
    try:
        return skeleton.find(names, parents, str(file), allow)
    except ValueError as error:
        draft = Path(f"{file.name.partition('.')[0]}_joints.yaml")
        if not draft.exists():  # it may have been filled in
            draft.write_text(skeleton.guess(names, parents), encoding="utf-8")
        raise ValueError(f"{error}; {draft} is a first guess of one") from error


def retarget_as_asked(capture: Capture, rig: Rig, options: SkeletonOptions, recording: Path) -> Motion:
    """Retarget a recording with the options of a program.

    Raises:
        ValueError: as `known_parts` and `retarget`.
    """
    parts = known_parts(capture.names, capture.parents, options.joints, recording, options.allow)
    return retarget(
        capture,
        rig.body,
        rig.names,
        parts,
        fps=options.fps,
        abduct=options.abduct,
        drop_clavicles=options.drop_clavicles,
        freeze=options.freeze,
        axes=Axes(options.up, options.forward),
        by_positions=options.by_positions,
        allow=options.allow,
        about=str(recording),
        tell=lambda line: print(f"{recording}: {line}"),
    )


def draw(path: Path, surfaces: list[ray_cast.Surface], around: np.ndarray, margin: float) -> None:
    """Draw surfaces from four sides, or say what is not installed.

    Args:
        path: of the picture.
        surfaces: what is drawn.
        around: [V, 3] m, which each picture has in its middle, with a margin.
    """
    views = ("front", "three-quarter", "side", "back")
    try:
        pictures = [ray_cast.render(surfaces, ray_cast.camera_for(around, view, margin)) for view in views]
        ray_cast.comparison(path, {"": pictures}, views)
    except ImportError as error:
        print(f"{path}: not drawn ({error})")


def write_motion(
    output: Path, motion: Motion, rig: Rig, recording: Path, options: OutputOptions, animation: str = ""
) -> int:
    """Treat the implausible frames of a motion as asked, save it, and print which frames they are.

    Lines go above a progress bar, if there is one.

    Args:
        output: file to write.
        motion: of the joints of `rig`.
        rig: body and joint names.
        recording: file that the motion is from; names the motion.
        options: of the program.
        animation: of that file, where it may have several; names the motion in its place.

    Returns:
        The number of frames that are saved.

    Raises:
        ValueError: naming the recording, as `mend`; for a figure that is too far from the ground.
    """
    part = f", animation {animation}" if animation else ""
    height = float(np.median(np.abs(motion.translation[:, 1])))
    if height > TOO_HIGH:
        raise ValueError(
            f"{recording}{part}: the hips would be {height:.0f} m above the ground: give --up, or cut jumps out"
        )
    try:
        motion, report = mend(motion, rig.body, options.bad)
    except ValueError as error:
        raise ValueError(f"{recording}{part}: {error}") from error
    name, source = animation or recording.name.partition(".")[0], f"{recording.name}{part}"
    save_motion(output, motion, rig.names, name=name, source=source, licence=options.licence)
    for doubt in doubts(motion, rig.body, rig.names):
        tqdm.write(f"{recording}{part}: {doubt}")
    tqdm.write(f"{output}: {len(motion.translation)} frames, {report}")
    return len(motion.translation)
