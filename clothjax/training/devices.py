"""Devices to train on: one, several of a machine, or those of several processes."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "simulations"

Tree = TypeVar("Tree")


def connect(processes: str = "") -> None:
    """Join this process to the others of its training, before anything is computed.

    Args:
        processes: `ADDRESS:PORT,COUNT,INDEX`: the address of the first process, their number, and the index of this
            one; or `alone`. The default is the processes of a SLURM, Open MPI (up to 4) or indexed Kubernetes job.

    Raises:
        ValueError: if `processes` is neither.
    """
    if processes == "alone":
        return
    if processes:
        address, *numbers = processes.split(",")
        if len(numbers) != 2 or ":" not in address or not all(number.isdecimal() for number in numbers):
            raise ValueError(
                "processes are given as ADDRESS:PORT,COUNT,INDEX, such as node1:4000,2,0, or as `alone`; "
                f"got {processes!r}"
            )
        count, index = map(int, numbers)
        if index >= count:
            raise ValueError(f"process {index} of {count}: indices count from 0")
        jax.distributed.initialize(address, count, index)
    elif _is_one_of_several():
        jax.distributed.initialize()


def _is_one_of_several() -> bool:
    """Return whether a launcher that jax knows started other processes too. SLURM's batch script itself is alone."""
    slurm = int(os.environ.get("SLURM_STEP_NUM_TASKS", 1))
    mpi = int(os.environ.get("OMPI_COMM_WORLD_SIZE", 1)) if "OMPI_MCA_orte_hnp_uri" in os.environ else 1
    return max(slurm, mpi) > 1 or {"KUBERNETES_SERVICE_HOST", "JOB_COMPLETION_INDEX"} <= os.environ.keys()


@contextlib.contextmanager
def together(directory: Path) -> Iterator[None]:
    """Exit this process at an error if it is one of several, which cannot go on without each other.

    Args:
        directory: of the run; its checkpoints are complete, so training can resume from them.

    Raises:
        Exception: the error itself, if the process is alone.
    """
    try:
        yield
    except Exception as error:
        if jax.process_count() == 1:
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        print(
            f"error: {reason}\nprocess {jax.process_index()} of {jax.process_count()} stops, and the others cannot go "
            "on without it, if they are not gone already; when that is mended, start all of them again: they resume "
            f"from the last checkpoint in {directory}",
            file=sys.stderr,
            flush=True,
        )
        os._exit(1)  # at a normal exit jax would wait for the others


def choose(wanted: str, *batches: int) -> Mesh | None:
    """Return the devices to spread batches over; None for a single one.

    Args:
        wanted: a number of devices; or `auto`, the largest number that divides every batch.
        batches: sizes of the batches.

    Raises:
        ValueError: if there are fewer devices, they do not divide a batch, or a process would have none.
    """
    present = jax.devices()
    if wanted != "auto" and not (wanted.isdecimal() and int(wanted) > 0):
        raise ValueError(f"devices are a number or `auto`, not {wanted!r}")
    if wanted == "auto" and jax.process_count() == 1:
        count = max(n for n in range(1, len(present) + 1) if not any(batch % n for batch in batches))
    else:
        count = len(present) if wanted == "auto" else int(wanted)
    if count > len(present):
        raise ValueError(f"{count} devices are wanted, there are {len(present)}")
    if jax.process_count() > 1 and count != len(present):
        raise ValueError(
            f"{jax.process_count()} processes have {len(present)} devices and use all of them, not {count}"
        )
    if any(batch % count for batch in batches):
        raise ValueError(
            f"batches of {' and '.join(map(str, batches))} cannot be divided among {count} devices: "
            "set stage1.batch, stage2.batch and tuning.batch to multiples"
        )
    return None if count == 1 else Mesh(np.array(present[:count]), (AXIS,))


def shard(function: Callable, device_mesh: Mesh | None) -> Callable:
    """Return `function` with its first argument and results, which have a leading axis [N], split over devices."""
    if device_mesh is None:
        return function

    def run(batch, *others):
        part, copy = PartitionSpec(AXIS), PartitionSpec()
        specs = (part, *[copy] * len(others))
        # nothing is communicated within, so there is nothing to check
        each = jax.shard_map(function, mesh=device_mesh, in_specs=specs, out_specs=part, check_vma=False)
        return each(batch, *others)

    return run


def replicated(device_mesh: Mesh | None) -> NamedSharding | None:
    """Return the sharding that gives every device a copy."""
    return None if device_mesh is None else NamedSharding(device_mesh, PartitionSpec())


def replicate(tree: Tree, device_mesh: Mesh | None) -> Tree:
    """Copy a pytree of arrays to every device; of several processes, the first one's arrays go to all."""
    if device_mesh is None:
        return jax.tree.map(jnp.asarray, tree)

    def one(leaf):
        if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(one(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        leaf = np.asarray(leaf)
        if jax.process_count() > 1:  # each has computed it, on another machine with other rounding
            leaf = np.asarray(multihost_utils.broadcast_one_to_all(leaf))
        return jax.device_put(leaf, replicated(device_mesh))

    return jax.tree.map(one, tree)
