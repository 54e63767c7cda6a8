"""Time, floating-point operations and memory of compiled programs, and what this machine could do at best."""

import contextlib
import time
from collections.abc import Iterator
from functools import partial
from typing import NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

MATRIX = 2048  # rows, for the peak of products
PASSES = 8
STREAM = 64 * 2**20  # numbers, for the peak of the memory: no cache holds them


class Program(NamedTuple):
    """A compiled function with its arguments."""

    compiled: jax.stages.Compiled
    arguments: tuple

    def run(self):
        return jax.block_until_ready(self.compiled(*self.arguments))


def program(function, *arguments) -> Program:
    """`function` compiled for these arguments."""
    return Program(jax.jit(function).lower(*arguments).compile(), arguments)


def interleaved(programs: dict[str, Program], rounds: int) -> dict[str, float]:
    """Median seconds of each program; all take turns, so that a slow minute is slow for all."""
    taken = {name: [] for name in programs}
    for each in programs.values():
        each.run()
    for _ in range(rounds):
        for name, each in programs.items():
            began = time.perf_counter()
            each.run()
            taken[name].append(time.perf_counter() - began)
    return {name: float(np.median(seconds)) for name, seconds in taken.items()}


def temporary_bytes(one: Program) -> int:
    """Memory that a program needs beside its arguments and results."""
    return int(one.compiled.memory_analysis().temp_size_in_bytes)


def cost(one: Program) -> dict[str, float]:
    """The compiler's count of floating-point operations and bytes accessed; the inside of a loop counts once."""
    counted = one.compiled.cost_analysis() or {}
    return {"flops": float(counted.get("flops", 0.0)), "bytes": float(counted.get("bytes accessed", 0.0))}


@contextlib.contextmanager
def unrolled() -> Iterator[None]:
    """Within it, scans are compiled without loops, so that `cost` counts all of them.

    Loops that end when their work is done, as those of the searches for contact, still count once.
    """
    with mock.patch.object(jax.lax, "scan", partial(jax.lax.scan, unroll=True)):
        yield


def peaks(rounds: int) -> dict[str, float]:
    """What this machine reaches: flop/s in a product of float32 matrices, byte/s in adding to a long vector."""

    def stream(long):  # in place: fresh memory would be slower
        return jax.lax.fori_loop(0, PASSES, lambda _, a: a + 1.0, long)

    square, long = jnp.ones((MATRIX, MATRIX)), jnp.ones(STREAM)
    seconds = interleaved({"matrix": program(lambda a: a @ a, square), "stream": program(stream, long)}, rounds)
    return {
        "flops_per_second": 2 * MATRIX**3 / seconds["matrix"],
        "bytes_per_second": 8 * STREAM * PASSES / seconds["stream"],
    }


def against_peaks(seconds: float, counted: dict[str, float], best: dict[str, float]) -> dict[str, float]:
    """A program's cost with the fractions of both peaks that it reaches."""
    return {
        "seconds": seconds,
        **counted,
        "matrix_peak_fraction": counted["flops"] / seconds / best["flops_per_second"],
        "bandwidth_fraction": counted["bytes"] / seconds / best["bytes_per_second"],
    }
