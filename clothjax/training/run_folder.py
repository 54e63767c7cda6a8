"""Files in the folder of a training run besides checkpoints: the lock, the metrics and the time."""

import contextlib
import json
import math
import os
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np


@contextlib.contextmanager
def lock(directory: Path) -> Iterator[None]:
    """Hold a lock on the directory while a run trains in it. The system releases it however the process ends.

    Raises:
        ValueError: if another run holds it.
    """
    import fcntl  # not on Windows

    with open(directory / "lock", "a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise ValueError(
                f"{directory}: process {file.read()} is training here; wait for it, or use another directory"
            ) from error
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def fingerprint(settings: dict, arrays: Iterable[np.ndarray] = ()) -> int:
    """Return a number that tells files of other settings, or that were made with other arrays, apart.

    Args:
        settings: those that the files depend on, as `configuration.to_dict` gives them.
    """
    return zlib.crc32(b"".join([json.dumps(settings).encode(), *(np.asarray(array).tobytes() for array in arrays)]))


@contextlib.contextmanager
def metrics_file(directory: Path, step: int) -> Iterator[Callable[[dict[str, float]], None]]:
    """Open `metrics.jsonl` for a training that goes on from `step`; rows of later steps are dropped.

    It yields a function that appends a row of figures by name.
    """
    path = directory / "metrics.jsonl"
    lines = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            if json.loads(line)["step"] > step:
                break
        except json.JSONDecodeError:  # the line that a killed process was writing
            break
        lines.append(line + "\n")
    _replace(path, "".join(lines))
    with open(path, "a") as file:

        def write(row: dict[str, float]) -> None:
            finite = {name: value if math.isfinite(value) else None for name, value in row.items()}
            file.write(json.dumps(finite) + "\n")
            file.flush()

        yield write


def read_seconds(directory: Path) -> tuple[float, float]:
    """Return the seconds of training and of compilation in all sessions so far, from `training.json`; 0 if unknown.

    Steps that were lost, because the process ended before a checkpoint, are counted too.
    """
    path = directory / "training.json"
    if not path.exists():
        return 0.0, 0.0
    record = json.loads(path.read_text())
    return record["seconds"], record["compile_seconds"]


def write_seconds(directory: Path, seconds: float, compile_seconds: float, step: int, steps: int) -> None:
    """Write the seconds of training and of compilation up to `step` of `steps` to `training.json`."""
    record = {"step": step, "steps": steps, "seconds": seconds, "compile_seconds": compile_seconds}
    _replace(directory / "training.json", json.dumps(record) + "\n")


def add_seconds(directory: Path, **spent: float) -> dict[str, float]:
    """Add seconds, by the name of a part of the run, to those in `clock.json`; return the sums of all sessions."""
    path = directory / "clock.json"
    total = json.loads(path.read_text()) if path.exists() else {}
    total |= {name: total.get(name, 0.0) + seconds for name, seconds in spent.items()}
    _replace(path, json.dumps(total) + "\n")
    return total


def _replace(path: Path, text: str) -> None:
    with whole(path) as file:
        file.write(text.encode())


@contextlib.contextmanager
def whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file to write bytes to; it gets its name when it is complete, or not at all."""
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        yield file
    partial.replace(path)
