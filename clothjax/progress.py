"""Lines and progress bars on the terminal."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

import jax
from tqdm import tqdm


def say(text: str) -> None:
    """Print a line; of several processes only the first prints."""
    if jax.process_index() == 0:
        print(text, flush=True)


@contextlib.contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show the progress of a work of `total` parts: a bar on a terminal, a line every ten seconds elsewhere.

    It yields a function, to be called with the number of parts done so far.
    """
    terminal = sys.stderr.isatty() and jax.process_index() == 0
    last = time.monotonic()
    with tqdm(total=total, desc=what, disable=not terminal, leave=False) as bar:

        def report(done: int) -> None:
            nonlocal last
            bar.update(done - bar.n)
            if not terminal and (time.monotonic() - last > 10 or done == total):
                last = time.monotonic()
                say(f"{what}: {done}/{total}")

        yield report
