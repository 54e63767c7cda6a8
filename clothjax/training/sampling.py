"""Batches of rollouts, each with its own random clip, body and material."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import numpy as np
from jax.sharding import Mesh

from clothjax.training import devices

ON_CPU, ELSEWHERE = 4, 64  # sequences in one program, by device


def sample(
    sequence: Callable,
    arguments: tuple,
    count: int,
    seed: int,
    progress: Callable[[int], None] = lambda _: None,
    device_mesh: Mesh | None = None,
    together: int = ON_CPU,
):
    """Compute `sequence(key, *arguments)` for many random keys; return the results on the host, with an axis [count].

    Args:
        sequence: a function that jax can transform; it returns a pytree of arrays.
        arguments: the same for every key.
        count: number of keys, which come from `seed`.
        progress: called with the number of sequences done.
        device_mesh: each device runs a part of them.
        together: keys in one program on a CPU; 1 for sequences that take different numbers of steps.
    """
    on_cpu = jax.default_backend() == "cpu"
    among = 1 if device_mesh is None else device_mesh.size
    size = among * min(together if on_cpu else ELSEWHERE, -(-count // among))
    arguments = devices.replicate(arguments, device_mesh)
    keys = jax.random.split(jax.random.key(seed), count)

    @partial(jax.jit, out_shardings=devices.replicated(device_mesh))
    def run(keys, *arguments):
        return devices.shard(jax.vmap(sequence, (0, *(None for _ in arguments))), device_mesh)(keys, *arguments)

    def part_from(start: int):
        rows = np.arange(start, start + size) % count
        return jax.device_get(run(devices.replicate(keys[rows], device_mesh), *arguments))

    parts = []
    # the small operations of a rollout do not fill a CPU's cores: as many programs at once as there are
    with ThreadPoolExecutor(os.cpu_count() if on_cpu and device_mesh is None else 1) as pool:
        for part in pool.map(part_from, range(0, count, size)):
            parts.append(part)
            progress(min(len(parts) * size, count))
    return jax.tree.map(lambda *each: np.concatenate(each)[:count], *parts)
