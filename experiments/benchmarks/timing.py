"""Time, floating-point operations and memory of compiled programs."""

import time
from typing import NamedTuple

import jax
import numpy as np


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
    """The compiler's count of floating-point operations and bytes accessed."""
    counted = one.compiled.cost_analysis() or {}
    return {"flops": float(counted.get("flops", 0.0)), "bytes": float(counted.get("bytes accessed", 0.0))}
