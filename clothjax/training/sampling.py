"""Batches of sequences that differ in their first argument, such as a random key."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from clothjax.files import damage
from clothjax.training import devices, run_folder
from clothjax.types import Array

ON_CPU, ELSEWHERE = 8, 64  # sequences in one program, by device; a CPU computes as many at once (kernels.cc)


def make_sampler(sequence: Callable, device_mesh: Mesh | None = None, elsewhere: int = ELSEWHERE) -> Callable:
    """Return a function that computes `sequence(one, *arguments)` for many, compiled once.

    Its arguments are `each`, the first arguments of the sequences with an axis [count], such as random keys; the other
    arguments, the same for all; a function to call with the number of sequences done; and a folder, or None, for what
    is done, which is read where it is there; then the result is one array. It returns the results on the host, with an
    axis [count].

    Args:
        sequence: a function that jax can transform; it returns a pytree of arrays.
        device_mesh: each device runs a part of them.
        elsewhere: sequences in one program on a device that is not a CPU.
    """
    on_cpu = jax.default_backend() == "cpu"
    among = 1 if device_mesh is None else device_mesh.size
    # the small operations of a rollout do not fill a CPU's cores: as many programs at once as there are
    at_once = (os.cpu_count() or 1) if on_cpu and device_mesh is None else 1

    @partial(jax.jit, out_shardings=devices.replicated(device_mesh))
    def run(part, *arguments):
        return devices.shard(jax.vmap(sequence, (0, *(None for _ in arguments))), device_mesh)(part, *arguments)

    def sample(
        each: Any, arguments: tuple, progress: Callable[[int], None] = lambda _: None, folder: Path | None = None
    ) -> Any:
        count = len(jax.tree.leaves(each)[0])
        size = among * min(ON_CPU if on_cpu else elsewhere, -(-count // (among * at_once)))
        arguments = devices.replicate(arguments, device_mesh)

        def part_from(start: int):
            rows = np.arange(start, start + size) % count
            part = devices.replicate(jax.tree.map(lambda x: x[rows], each), device_mesh)
            if folder is None:
                return jax.device_get(run(part, *arguments))
            path = folder / f"{start:05}_{size}.npy"
            if path.is_file():
                return _kept(path)
            found = jax.device_get(run(part, *arguments))
            with run_folder.whole(path) as file:
                np.save(file, found)
            return found

        parts = []
        with ThreadPoolExecutor(at_once) as pool:
            for part in pool.map(part_from, range(0, count, size)):
                parts.append(part)
                progress(min(len(parts) * size, count))
        return jax.tree.map(lambda *each: np.concatenate(each)[:count], *parts)

    return sample


def _kept(path: Path) -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except damage.UNREADABLE as error:
        raise ValueError(f"{path}: not readable ({error}); remove it to compute it again") from error


def keys(seed: int, count: int) -> Array:
    """Return `count` random keys from a seed."""
    return jax.random.split(jax.random.key(seed), count)
