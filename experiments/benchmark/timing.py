"""Time, floating-point operations and memory of compiled programs, and the peaks of this machine."""

import contextlib
import time
from collections.abc import Callable, Hashable, Iterator
from functools import partial
from typing import NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

MATRIX = 2048  # rows, for the peak of products
PASSES = 8
STREAM = 64 * 2**20  # numbers, for the peak of the memory: no cache holds them


Call = Callable[[], object]
_differences: list[float] = []


class Program(NamedTuple):
    """A compiled function with its arguments."""

    compiled: jax.stages.Compiled
    arguments: tuple

    def __call__(self):
        return jax.block_until_ready(self.compiled(*self.arguments))


def program(function, *arguments) -> Program:
    """Compile `function` for these arguments."""
    return Program(jax.jit(function).lower(*arguments).compile(), arguments)


def interleaved(calls: dict[Hashable, Call], rounds: int, in_a_row: int = 1) -> dict[Hashable, float]:
    """Measure median seconds of each call over rounds in which all take turns, in a changing order.

    So a slow minute is slow for all.

    Args:
        in_a_row: calls at each turn; the last is timed.
    """
    taken, order, names = {name: [] for name in calls}, np.random.default_rng(0), list(calls)
    for call in calls.values():
        call()
    for _ in range(rounds):
        for index in order.permutation(len(names)):
            for _ in range(in_a_row):
                began = time.perf_counter()
                calls[names[index]]()
                seconds = time.perf_counter() - began
            taken[names[index]].append(seconds)
    for seconds in taken.values() if rounds > 1 else ():
        one, other = np.median(seconds[::2]), np.median(seconds[1::2])
        _differences.append(max(one, other) / min(one, other))
    return {name: float(np.median(seconds)) for name, seconds in taken.items()}


def noise() -> float | None:
    """Return the factor by which the median time of a call differs from itself; None before `interleaved` ran.

    It is the 95th percentile, over all calls timed in this process, of the ratio between odd and even rounds."""
    return float(np.percentile(_differences, 95)) if _differences else None


def temporary_bytes(one: Program) -> int:
    """Return the memory that a program needs beside its arguments and results."""
    return int(one.compiled.memory_analysis().temp_size_in_bytes)


def cost(one: Program) -> dict[str, float]:
    """Return the compiler's count of floating-point operations and bytes accessed; the inside of a loop counts once."""
    counted = one.compiled.cost_analysis() or {}
    return {"flops": float(counted.get("flops", 0.0)), "bytes": float(counted.get("bytes accessed", 0.0))}


@contextlib.contextmanager
def unrolled() -> Iterator[None]:
    """Compile scans within it without loops, so that `cost` counts all their steps.

    Loops without a fixed end, such as the searches for contact, still count once.
    """
    with mock.patch.object(jax.lax, "scan", partial(jax.lax.scan, unroll=True)):
        yield


def peaks(rounds: int) -> dict[str, float]:
    """Measure the peaks of this machine: flop/s in a product of float32 matrices, byte/s in adding to a long vector."""

    def stream(long):  # in place: fresh memory would be slower
        return jax.lax.fori_loop(0, PASSES, lambda _, a: a + 1.0, long)

    square, long = jnp.ones((MATRIX, MATRIX)), jnp.ones(STREAM)
    seconds = interleaved({"matrix": program(lambda a: a @ a, square), "stream": program(stream, long)}, rounds)
    return {
        "flops_per_second": 2 * MATRIX**3 / seconds["matrix"],
        "bytes_per_second": 8 * STREAM * PASSES / seconds["stream"],
    }


def against_peaks(seconds: float, counted: dict[str, float], best: dict[str, float]) -> dict[str, float]:
    """Return a program's cost with the fractions of both peaks that it reaches."""
    return {
        "seconds": seconds,
        **counted,
        "matrix_peak_fraction": counted["flops"] / seconds / best["flops_per_second"],
        "bandwidth_fraction": counted["bytes"] / seconds / best["bytes_per_second"],
    }
