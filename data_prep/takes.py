"""Lists of takes of CMU's motion capture by kind, and their files in AMASS."""

import re
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

LAYOUTS = {"poses": "SMPL-H", "stageii": "SMPL-X"}  # by how the names of their files end, the preferred one first
TAKE = re.compile(r"(\d+)_(\d+)")
FILE = re.compile(rf"(\d+)_(\d+)_({'|'.join(LAYOUTS)})\.npz")


@dataclass(frozen=True)
class Takes:
    """A list of takes, each written SUBJECT_NUMBER in quotes, such as "07_02": YAML reads 07_02 as a number."""

    train: dict[str, tuple[str, ...]]
    """Takes to train on, by kind, such as `walk`."""
    test: tuple[str, ...] = ()
    """Takes to test on."""
    frames: int | None = None
    """Number of frames that `train` should have at 30 frames per second."""

    def __post_init__(self):
        seen = set()
        for take in self.all:
            if not TAKE.fullmatch(take):
                raise ValueError(f"{take!r} is no take: write subject and number, such as '07_02'")
            if _numbers(take) in seen:
                raise ValueError(f"take {take} is listed twice")
            seen.add(_numbers(take))

    @property
    def all(self) -> list[str]:
        """Takes to train on, then those to test on."""
        return [take for takes in (*self.train.values(), self.test) for take in takes]


def find(folder: Path, takes: Iterable[str], tell: Callable[[str], object] = str) -> dict[str, Path]:
    """Find takes in the tree of a folder, each in a folder that is named after its subject.

    Args:
        folder: of AMASS, or one around it, with files such as `CMU/07/07_02_poses.npz`.
        takes: such as `07_02`.
        tell: called with a line for a take that has several files.

    Returns:
        The files by take; a take without a file is left out.

    Raises:
        ValueError: if there is no such folder.
    """
    if not folder.is_dir():
        raise ValueError(f"{folder}: no such folder")
    files = defaultdict(list)
    for path in folder.rglob("*.npz"):
        match, subject = FILE.fullmatch(path.name), path.parent.name
        if match and subject.isdecimal() and int(subject) == int(match[1]):
            files[int(match[1]), int(match[2])].append((list(LAYOUTS).index(match[3]), path))
    found = {}
    for take in takes:
        candidates = sorted(files[_numbers(take)])
        if candidates:
            layout, found[take] = candidates[0]
            if len(candidates) > 1:
                name = list(LAYOUTS.values())[layout]
                tell(f"{take}: {len(candidates)} files, of which {found[take]} is taken ({name})")
    return found


def _numbers(take: str) -> tuple[int, int]:
    """Return the numbers of a take's subject and of the take."""
    subject, number = take.split("_")
    return int(subject), int(number)
