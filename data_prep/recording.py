"""A recorded motion of a skeleton; resampling it; and the lines and numbers of text files that hold one."""

import codecs
import zlib
from collections.abc import Iterator
from gzip import open as open_gzip
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

LEAST_RATE, MOST_RATE = 5.0, 2000.0  # frames a second of a recording
GZIP = b"\x1f\x8b"
OTHERS = {  # by how they begin
    b"glTF": "a glTF file: data_prep.gltf_motion reads it",
    b"Kaydara FBX": "an FBX file: make a glTF file of it, as data_prep/README.md says",
    b"PK\x03\x04": "a ZIP archive: unpack it, or if it is an .npz let data_prep.amass read it",
    b"\x89HDF": "an HDF5 file, not a recording of this kind",
}


class Capture(NamedTuple):
    """A recorded motion of a skeleton in any unit of length."""

    names: tuple[str, ...]  # CMU's for joints that CMU has
    parents: np.ndarray  # [n] root first with -1, parents before children
    offsets: np.ndarray  # [n, 3] from the parent, in the rest pose
    rotations: np.ndarray  # [T, n, 3, 3] local to the parent, identity in the rest pose
    translation: np.ndarray  # [T, 3] of the root
    fps: float


def resample(capture: Capture, fps: float) -> Capture:
    """Resample a recording: take every k-th frame, or interpolate by cubic splines if rates are no multiples.

    Raises:
        ValueError: for a rate that is not > 0, or a recording of fewer than two frames.
    """
    frames = len(capture.translation)
    if not fps > 0:
        raise ValueError(f"fps must be > 0, got {fps}")
    if frames < 2:
        raise ValueError(f"the recording has {frames} frames: it needs two at least")
    ratio = capture.fps / fps
    if abs(ratio - round(ratio)) < 1e-3 * ratio and round(ratio) >= 1:
        every = slice(None, None, round(ratio))
        return capture._replace(rotations=capture.rotations[every], translation=capture.translation[every], fps=fps)
    old = np.arange(frames) / capture.fps
    new = np.arange(int(np.floor(old[-1] * fps + 1e-6)) + 1) / fps
    new = np.minimum(new, old[-1])
    rotations = np.empty((len(new), *capture.rotations.shape[1:]))
    for j in range(rotations.shape[1]):
        rotations[:, j] = RotationSpline(old, Rotation.from_matrix(capture.rotations[:, j]))(new).as_matrix()
    translation = CubicSpline(old, capture.translation)(new)
    return capture._replace(rotations=rotations, translation=translation, fps=fps)


def read_lines(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Yield number and words of each line that is not blank, of a text file, which may be packed by gzip.

    Raises:
        ValueError: if the file cannot be read, or holds no text.
    """
    try:
        with open(path, "rb") as file:
            opener = open_gzip if file.read(len(GZIP)) == GZIP or str(path).endswith(".gz") else open
        with opener(path, "rb") as file:
            begin = file.read(max(map(len, OTHERS)))
        marked = begin[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        other = next((what for mark, what in OTHERS.items() if begin.startswith(mark)), None)
        if other is not None:
            raise ValueError(f"{path}: {other}")
        with opener(path, "rt", encoding="utf-16" if marked else "utf-8-sig", errors="replace") as file:
            for number, line in enumerate(file, 1):
                words = line.split()
                if words:
                    yield number, words
    except (OSError, EOFError, zlib.error) as error:  # the last two: a .gz cut short, a damaged one
        raise ValueError(f"{path}: cannot be read ({error})") from error


def numbers(path: str | Path, line: int, words: list[str], count: int | None = None) -> list[float]:
    """Convert words to finite numbers.

    Raises:
        ValueError: naming file and line, if a word is not a number or there are not `count` of them.
    """
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise ValueError(f"{path}, line {line}: {error}; expected numbers") from error
    if count is not None and len(values) != count:
        raise ValueError(f"{path}, line {line}: {len(values)} numbers, expected {count}")
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{path}, line {line}: {' '.join(words)!r} has a number that is not finite")
    return values
