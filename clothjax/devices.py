"""The devices that a training runs on: one, several of a machine, or those of several processes."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "simulations"
CLUSTERS = {"SLURM_NTASKS": "SLURM_PROCID", "OMPI_COMM_WORLD_SIZE": "OMPI_COMM_WORLD_RANK"}

Tree = TypeVar("Tree")


def connect(processes: str = "") -> None:
    """Joins this process to the others of its training, before anything is computed.

    Args:
        processes: `ADDRESS:PORT,COUNT,INDEX` of the first process, of all, and of this one. By default those of a
            SLURM, Open MPI or Kubernetes job (an indexed one), if this is one of several processes in it.

    Raises:
        ValueError: if `processes` is something else.
    """
    if processes:
        address, *numbers = processes.split(",")
        if len(numbers) != 2 or ":" not in address or not all(number.isdecimal() for number in numbers):
            raise ValueError(
                f"processes are given as ADDRESS:PORT,COUNT,INDEX, such as node1:4000,2,0; got {processes!r}"
            )
        count, index = map(int, numbers)
        if index >= count:
            raise ValueError(f"process {index} of {count}: indices count from 0")
        jax.distributed.initialize(address, count, index)
    elif _is_one_of_several():
        jax.distributed.initialize()


def _is_one_of_several() -> bool:
    several = any(int(os.environ.get(size, 1)) > 1 and rank in os.environ for size, rank in CLUSTERS.items())
    return several or {"KUBERNETES_SERVICE_HOST", "JOB_COMPLETION_INDEX"} <= os.environ.keys()


@contextlib.contextmanager
def together(directory: Path) -> Iterator[None]:
    """Within it, this process ends when another of its training is gone: they cannot go on without each other.

    Args:
        directory: of the run, whose checkpoints are whole and can be resumed from.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if jax.process_count() == 1:
            raise
        reason = str(error).splitlines()[0]
        print(
            f"error: another process of this training is gone ({reason}); start all of them again to go on from the "
            f"last checkpoint in {directory}",
            file=sys.stderr,
            flush=True,
        )
        os._exit(1)  # at a normal exit jax would wait for the lost one


def choose(wanted: str, *batches: int) -> Mesh | None:
    """The devices to spread batches over; None for a single one.

    Args:
        wanted: a number; or `auto`, as many as there are and every batch can be divided among.

    Raises:
        ValueError: if there are not so many, a batch cannot be divided among them, or a process would have none.
    """
    there = jax.devices()
    if wanted != "auto" and not (wanted.isdecimal() and int(wanted) > 0):
        raise ValueError(f"devices are a number or `auto`, not {wanted!r}")
    if wanted == "auto" and jax.process_count() == 1:
        count = max(n for n in range(1, len(there) + 1) if not any(batch % n for batch in batches))
    else:
        count = len(there) if wanted == "auto" else int(wanted)
    if count > len(there):
        raise ValueError(f"{count} devices are wanted, there are {len(there)}")
    if jax.process_count() > 1 and count != len(there):
        raise ValueError(f"{jax.process_count()} processes have {len(there)} devices and use all of them, not {count}")
    if any(batch % count for batch in batches):
        raise ValueError(
            f"batches of {' and '.join(map(str, batches))} cannot be divided among {count} devices: "
            "set stage1.batch and stage2.batch to multiples"
        )
    return None if count == 1 else Mesh(np.array(there[:count]), (AXIS,))


def split(function: Callable, devices: Mesh | None) -> Callable:
    """`function` of a batch, each device having a part: its first argument and its results have a leading axis [N]."""
    if devices is None:
        return function

    def run(batch, *others):
        there = PartitionSpec(AXIS)
        # nothing is communicated within, so there is nothing to check
        each = jax.shard_map(
            function, mesh=devices, in_specs=(there, *[PartitionSpec()] * len(others)), out_specs=there, check_vma=False
        )
        return each(batch, *others)

    return run


def replicated(devices: Mesh | None) -> NamedSharding | None:
    """The sharding of what every device has a copy of."""
    return None if devices is None else NamedSharding(devices, PartitionSpec())


def copied(tree: Tree, devices: Mesh | None) -> Tree:
    """Arrays that every process has, on every device."""
    if devices is None:
        return jax.tree.map(jax.numpy.asarray, tree)

    def one(leaf):
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(one(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        return jax.device_put(np.asarray(leaf), replicated(devices))

    return jax.tree.map(one, tree)
