"""The devices that a training runs on: one, several of a machine, or those of several processes."""

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
    """Joins this process to the others of its training, before anything is computed.

    Args:
        processes: `ADDRESS:PORT,COUNT,INDEX` of the first process, of all, and of this one; `alone`; by default, those
            of a SLURM, Open MPI (up to 4) or Kubernetes job (an indexed one), if there are several.

    Raises:
        ValueError: if `processes` is something else.
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
    """Whether a launcher that jax knows started this process beside others. SLURM's batch script itself is alone."""
    slurm = int(os.environ.get("SLURM_STEP_NUM_TASKS", 1))
    mpi = int(os.environ.get("OMPI_COMM_WORLD_SIZE", 1)) if "OMPI_MCA_orte_hnp_uri" in os.environ else 1
    return max(slurm, mpi) > 1 or {"KUBERNETES_SERVICE_HOST", "JOB_COMPLETION_INDEX"} <= os.environ.keys()


@contextlib.contextmanager
def together(directory: Path) -> Iterator[None]:
    """Within it, of several processes none outlives an error in one: they cannot go on without each other.

    Args:
        directory: of the run, whose checkpoints are whole and can be resumed from.
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
            "set stage1.batch, stage2.batch and tuning.batch to multiples"
        )
    return None if count == 1 else Mesh(np.array(there[:count]), (AXIS,))


def shard(function: Callable, device_mesh: Mesh | None) -> Callable:
    """`function` of a batch, each device having a part: its first argument and its results have a leading axis [N]."""
    if device_mesh is None:
        return function

    def run(batch, *others):
        part, whole = PartitionSpec(AXIS), PartitionSpec()
        specs = (part, *[whole] * len(others))
        # nothing is communicated within, so there is nothing to check
        each = jax.shard_map(function, mesh=device_mesh, in_specs=specs, out_specs=part, check_vma=False)
        return each(batch, *others)

    return run


def replicated(device_mesh: Mesh | None) -> NamedSharding | None:
    """The sharding of what every device has a copy of."""
    return None if device_mesh is None else NamedSharding(device_mesh, PartitionSpec())


def replicate(tree: Tree, device_mesh: Mesh | None) -> Tree:
    """The arrays of the first process on every device of all."""
    if device_mesh is None:
        return jax.tree.map(jnp.asarray, tree)

    def one(leaf):
        if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(one(jax.random.key_data(leaf)), impl=jax.random.key_impl(leaf))
        leaf = np.asarray(leaf)
        if jax.process_count() > 1:  # each has computed it, on another machine with other rounding
            leaf = np.asarray(multihost_utils.broadcast_one_to_all(leaf))
        return jax.device_put(leaf, replicated(device_mesh))

    return jax.tree.map(one, tree)
