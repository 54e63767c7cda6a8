"""Shared parts of the programs: the command line, and the options and output of those that retarget a recording."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clothjax import cli
from clothjax.files.storage import Rig, save_motion
from clothjax.types import Motion
from data_prep.repair import Bad, mend


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
class MotionOptions:
    """Options of every program that retargets a recording onto a body."""

    body: str = "body"
    """File of the body, or the name of the embedded one."""
    fps: float = 30.0
    """Frames per second of the result."""
    freeze: bool = True
    """Keep hands, fingers and toes still."""
    bad: Bad = "keep"
    """Treatment of frames with a movement that no body can make: `keep` them, `repair` them by interpolation, or `drop`
    all but the longest stretch without any."""
    licence: str = "of the recording"


def write_motion(output: Path, motion: Motion, rig: Rig, recording: Path, options: MotionOptions) -> None:
    """Treat the implausible frames of a motion as asked, save it, and print which frames they are.

    Args:
        output: file to write.
        motion: of the joints of `rig`.
        rig: body and joint names.
        recording: file that the motion is from; names the motion.
        options: of the program.
    """
    motion, report = mend(motion, rig.body, options.bad)
    name = recording.name.partition(".")[0]
    save_motion(output, motion, rig.names, name=name, source=recording.name, licence=options.licence)
    print(f"{output}: {len(motion.translation)} frames, {report}")
