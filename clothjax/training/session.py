"""A training at the terminal: the bar that shows it, and the signals that stop it."""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from tqdm import tqdm

from clothjax import progress


class Call(NamedTuple):
    """Result of one call of `update`, which takes `steps_per_call` training steps."""

    state: Any  # after the call
    step: int  # after the call
    metrics: dict[str, Any]  # arrays [steps_per_call] by name
    seconds: float  # without compilation
    compile_seconds: float  # zero but for the first call


@contextlib.contextmanager
def interrupts() -> Iterator[Callable[[], int]]:
    """Catch SIGINT and SIGTERM, so that a training can save before it stops; a second signal acts at once.

    It yields a function that returns the number of the signal that has come, or 0.
    """
    received = []
    before = {}

    def note(number: int, _: Any) -> None:
        received.append(number)
        signal.signal(number, before[number])
        os.write(2, b"\nstopping after this call; once more to stop without saving\n")

    if threading.current_thread() is threading.main_thread():  # elsewhere Python does not allow handlers
        before.update({number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)})
    try:
        yield lambda: received[0] if received else 0
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def progress_report(first: int, steps: int, every: float) -> Iterator[Callable[[Call, float], None]]:
    """Yield a function that reports a call and its loss: by a bar on a terminal, by lines elsewhere.

    Args:
        first, steps: the steps before the first call and after the last.
        every: seconds between two lines.
    """
    terminal = sys.stdout.isatty()
    seconds, last_line = 0.0, time.monotonic()
    if first < steps:
        progress.say(f"training from step {first} to {steps}; compiling first")

    def report(call: Call, loss: float) -> None:
        nonlocal seconds, last_line
        seconds += call.seconds
        if call.compile_seconds:
            (bar.write if terminal else progress.say)(f"compiled in {call.compile_seconds:.1f} s")
        bar.set_postfix(loss=f"{loss:.4g}", refresh=False)
        bar.update(call.step - bar.n)
        if not terminal and (call.step == steps or time.monotonic() - last_line >= every):
            last_line = time.monotonic()
            rate = (call.step - first) / max(seconds, 1e-9)
            left = tqdm.format_interval((steps - call.step) / rate)
            progress.say(f"step {call.step}/{steps}  loss {loss:.4g}  {rate:.4g} steps/s  {left} left")

    with tqdm(total=steps, initial=first, unit="step", file=sys.stdout, disable=not terminal) as bar:
        yield report
