"""An evaluation in parts: shared by several processes, each kept as it is measured, gone on with after a stop."""

import json
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

from clothjax.files import damage
from clothjax.progress import say
from clothjax.training import run_folder


class Part(NamedTuple):
    """Part of an evaluation, which a process measures by itself."""

    measure: Callable[..., dict]  # from what is measured and ...
    about: tuple[str, ...]  # ... a motion, for some of them also a wearer or a push

    @property
    def name(self) -> str:
        return ", ".join((self.measure.__name__, *self.about))


class Kept(NamedTuple):
    """The file that keeps the parts measured so far, and the fingerprint of what they are of."""

    path: Path
    of: int

    def read(self) -> dict[str, dict]:
        """Return what an evaluation of the same fingerprint left when it was stopped, by the names of parts.

        Raises:
            ValueError: if the file is damaged.
        """
        if not self.path.exists():
            return {}
        try:
            kept = json.loads(self.path.read_text())
            return dict(kept["parts"]) if kept["of"] == self.of else {}
        except damage.UNREADABLE as error:
            raise ValueError(f"{self.path}: not what an evaluation leaves ({error}); remove it") from error

    def write(self, found: dict[str, dict]) -> None:
        with run_folder.whole(self.path) as file:
            file.write(json.dumps({"of": self.of, "parts": found}).encode())


def measure_all(
    parts: list[Part], measured: Any, load: Callable[[], Any], kept: Kept, jobs: int, report: Callable[[int], None]
) -> dict[Part, dict]:
    """Measure all parts that were not measured before, here or in several processes.

    Args:
        measured: what is measured, the first argument of each part.
        load: loads it again in another process, which must be able to unpickle this function.
        kept: where parts are kept.
        jobs: processes that measure at once.
        report: is told how many parts there are after each.

    Raises:
        ValueError: if what was kept is not readable.
    """
    found = kept.read()
    left = [part for part in parts if part.name not in found]
    if len(left) < len(parts):
        say(f"{kept.path}: has {len(parts) - len(left)} of {len(parts)} parts; remove it to measure them again")

    def add(part: Part, result: dict) -> None:
        found[part.name] = result
        kept.write(found)
        report(sum(each.name in found for each in parts))

    if jobs == 1:
        for part in left:
            add(part, part.measure(measured, *part.about))
    elif left:
        spawn = multiprocessing.get_context("spawn")  # a copy of a process with threads may hang
        with ProcessPoolExecutor(min(jobs, len(left)), spawn, _begin, (load,)) as pool:
            working = {pool.submit(_work, part): part for part in left}
            try:
                for future in as_completed(working):
                    add(working[future], future.result())
            except BaseException:
                pool.shutdown(cancel_futures=True)  # else what is left is measured, and lost
                raise
    return {part: found[part.name] for part in parts}


_own: list[Any] = []  # what a process of `measure_all` measures


def _begin(load: Callable[[], Any]) -> None:
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()
    _own.append(load())


def _end_with(parent) -> None:
    """End this process when the one that began it is gone, however it ended."""
    parent.join()
    os._exit(1)


def _work(part: Part) -> dict:
    return part.measure(_own[0], *part.about)
