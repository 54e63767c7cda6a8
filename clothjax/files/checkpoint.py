"""Checkpoints of a training state: atomic, every leaf checked, readable in parts. The only user of Orbax.

A checkpoint is the folder `DIRECTORY/STEP`. In it, `state` has the leaves by name (`params/decoder/w`), and `about` is
a JSON with the configuration and the shape, dtype and checksum of each leaf. Orbax writes under a temporary name and
renames at the end, so a process killed at any moment leaves the checkpoint before it.
"""

import shutil
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from clothjax.files import damage

FORMAT = 1
"""Version of the format; readers refuse a newer one."""

Tree = TypeVar("Tree")
T = TypeVar("T")


class Checkpoint(NamedTuple):
    """Description of a checkpoint, without its arrays."""

    path: Path  # of its folder
    step: int  # training steps so far
    config: dict  # of the run, from `configuration.to_dict`
    description: str  # one line for a person
    leaves: dict[str, dict]  # name -> its "shape", "dtype", "checksum" and, for random keys, "key"


class _Damaged(Exception):
    """A checkpoint cannot be read, or its arrays have other checksums than when it was written."""


def save(directory: str | Path, step: int, state: Any, config: dict, description: str = "", *, keep: int = 3) -> None:
    """Write a checkpoint, then remove all but the newest `keep`. Each process of a run calls it.

    Args:
        directory: of all checkpoints of a run; created if it does not exist.
        step: number of training steps so far.
        state: any pytree of arrays; typed random keys may be among them.
        config: the run's configuration, from `configuration.to_dict`.
        description: one line for a person.

    Raises:
        ValueError: if there is already a checkpoint of this step or a later one.
        OSError: if it could not be written.
    """
    directory = Path(directory).resolve()
    existing = steps(directory)
    if existing and existing[-1] >= step:
        raise ValueError(f"{directory}: cannot save step {step}, there is already a checkpoint of step {existing[-1]}")
    arrays = {name: jnp.asarray(leaf) for name, leaf in named(state).items()}
    about = {
        "format": FORMAT,
        "step": step,
        "config": config,
        "description": description,
        "leaves": {name: _describe(leaf) for name, leaf in arrays.items()},
    }
    arrays = {name: _plain(leaf) for name, leaf in arrays.items() if leaf.size}  # Orbax cannot store empty arrays
    options = ocp.CheckpointManagerOptions(
        max_to_keep=keep, enable_async_checkpointing=False, cleanup_tmp_directories=True
    )
    try:
        with ocp.CheckpointManager(directory, options=options) as manager:
            parts = ocp.args.Composite(state=ocp.args.PyTreeSave(arrays), about=ocp.args.JsonSave(about))
            manager.save(step, args=parts)
    except Exception as error:  # Orbax raises many kinds for a disk that is full, slow or gone
        before = f"step {existing[-1]} is complete" if existing else "there is none before it"
        raise OSError(
            f"{directory}: the checkpoint of step {step} could not be written ({before}): make room, and run the same "
            f"command again ({_first_line(error)})"
        ) from error


def steps(directory: str | Path) -> list[int]:
    """List the steps of the complete checkpoints in a directory, ascending."""
    directory = Path(directory)
    if not directory.is_dir():
        return []
    return sorted(int(entry.name) for entry in directory.iterdir() if entry.name.isdecimal() and entry.is_dir())


def latest(directory: str | Path) -> Checkpoint:
    """Return the description of the newest checkpoint.

    Raises:
        ValueError: if there is none, or a newer version of this library wrote it.
    """
    return _newest(Path(directory).resolve(), _about)


def restore(directory: str | Path, like: Tree) -> tuple[Tree, Checkpoint]:
    """Read the complete state of the newest undamaged checkpoint, bit for bit; warn of damaged ones.

    Args:
        directory: of all checkpoints of a run.
        like: a state of the expected structure, shapes, dtypes and sharding: arrays or `jax.ShapeDtypeStruct`s.

    Raises:
        ValueError: if there is no undamaged checkpoint, or a leaf is missing, left over or of another shape.
    """
    wanted = named(like)

    def read_one(path: Path) -> tuple[Tree, Checkpoint]:
        checkpoint = _about(path)
        _check(checkpoint, wanted)
        leaves = _leaves(checkpoint, wanted)
        return jax.tree.unflatten(jax.tree.structure(like), [leaves[name] for name in wanted]), checkpoint

    return _newest(Path(directory).resolve(), read_one)


def read(directory: str | Path, *parts: str) -> tuple[dict[str, Any], Checkpoint]:
    """Read parts of the newest undamaged checkpoint as nested dictionaries, whatever their shapes are.

    The fields of a NamedTuple come back as a dictionary, and so do the elements of a list, by their numbers.

    Raises:
        ValueError: if there is no undamaged checkpoint, or it has no such part.
    """

    def read_one(path: Path) -> tuple[dict[str, Any], Checkpoint]:
        about = _about(path)
        like = nested(
            {
                name: jax.ShapeDtypeStruct(tuple(leaf["shape"]), leaf["dtype"])
                for name, leaf in about.leaves.items()
                if name.partition("/")[0] in parts and "/" in name
            }
        )
        empty = [part for part in parts if part not in like]
        if empty:
            raise ValueError(f"{path}: has no {', '.join(empty)}; it is of another kind of training")
        leaves = _leaves(about, named(like))
        return jax.tree.unflatten(jax.tree.structure(like), leaves.values()), about

    return _newest(Path(directory).resolve(), read_one)


def set_aside(directory: str | Path, after: int) -> None:
    """Rename later checkpoints to `<step>.damaged`, so that a run resumed before them can save again."""
    directory = Path(directory)
    for step in steps(directory):
        if step > after:
            aside = directory / f"{step}.damaged"
            shutil.rmtree(aside, ignore_errors=True)
            (directory / str(step)).rename(aside)


def named(tree: Any) -> dict[str, Any]:
    """Return the leaves of a pytree by their paths, such as `params/decoder/w`.

    Keys of dictionaries and fields of a NamedTuple look alike in a path, so that `like` can be either.
    """
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    by_name = {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
    assert len(by_name) == len(leaves), "two leaves of the state have the same path"
    return by_name


def nested(leaves: dict[str, Any]) -> dict[str, Any]:
    """Return leaves by path as nested dictionaries: the inverse of `named`."""
    tree: dict[str, Any] = {}
    for name, leaf in leaves.items():
        *above, last = name.split("/")
        node = tree
        for key in above:
            node = node.setdefault(key, {})
        node[last] = leaf
    return tree


def _is_key(leaf: Any) -> bool:
    """Return whether a leaf is a typed random key."""
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: jax.Array) -> jax.Array:
    """Return the data of a random key, and any other leaf as it is."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _describe(leaf: jax.Array) -> dict:
    """Return shape, dtype, checksum and, for a random key, its kind."""
    description = {"shape": list(leaf.shape), "dtype": str(leaf.dtype), "checksum": _checksum(_plain(leaf))}
    return description | ({"key": str(jax.random.key_impl(leaf))} if _is_key(leaf) else {})


def _checksum(array: jax.Array) -> int | None:
    """Return the CRC-32 of the bytes (Orbax misses a flipped bit), or None for an array spread over processes."""
    if not (array.is_fully_addressable or array.is_fully_replicated):
        return None
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)


def _newest(directory: Path, read: Callable[[Path], T]) -> T:
    """Call `read` on the newest checkpoint that is not damaged."""
    existing = steps(directory)
    if not existing:
        why = "holds no checkpoints (folders named by a step)" if directory.is_dir() else "does not exist"
        raise ValueError(f"{directory}: {why}; train first, or give the folder of another run")
    for number in reversed(existing):
        try:
            return read(directory / str(number))
        except _Damaged as error:
            reason = f"{directory / str(number)} is damaged ({error})"
            warnings.warn(f"{reason}; looking for an older checkpoint", stacklevel=3)
    raise ValueError(f"{directory}: no undamaged checkpoint: {reason}")


def _about(path: Path) -> Checkpoint:
    """Read the description of a checkpoint."""
    try:
        with ocp.Checkpointer(ocp.JsonCheckpointHandler()) as reader:
            about = reader.restore(path / "about")
        version = about["format"]
        checkpoint = Checkpoint(path, about["step"], about["config"], about["description"], about["leaves"])
    except Exception as error:  # Orbax raises many kinds for broken files; the message has the reason
        raise _Damaged(f"its description cannot be read: {_first_line(error)}") from error
    damage.refuse_newer(path, version, FORMAT)
    return checkpoint


def _check(checkpoint: Checkpoint, wanted: dict[str, Any]) -> None:
    """Raise a ValueError if names, shapes or dtypes differ. Orbax's partial restore accepts this silently."""
    hint = "another garment, other model sizes or another version of the model"
    for name, leaf in wanted.items():
        stored = checkpoint.leaves.get(name)
        if stored is None:
            raise ValueError(f"{checkpoint.path}: has no {name}, which this model needs: {hint}")
        if tuple(stored["shape"]) != tuple(leaf.shape) or stored["dtype"] != str(leaf.dtype):
            raise ValueError(
                f"{checkpoint.path}: {name} is {stored['dtype']}{stored['shape']}, "
                f"this model needs {leaf.dtype}{list(leaf.shape)}: {hint}"
            )
    left_over = sorted(set(checkpoint.leaves) - set(wanted))
    if left_over:
        raise ValueError(f"{checkpoint.path}: holds {', '.join(left_over[:5])}, which this model has not: {hint}")


def _leaves(checkpoint: Checkpoint, wanted: dict[str, Any]) -> dict[str, jax.Array]:
    """Read leaves that the checkpoint has, and check them against their description."""
    default = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    abstract = {}
    for name, leaf in wanted.items():
        plain = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        sharding = getattr(leaf, "sharding", None) or default
        abstract[name] = jax.ShapeDtypeStruct(plain.shape, plain.dtype, sharding=sharding)
    stored = {name: leaf for name, leaf in abstract.items() if leaf.size}
    arguments = ocp.args.PyTreeRestore(
        item=stored, restore_args=ocp.checkpoint_utils.construct_restore_args(stored), partial_restore=True
    )
    try:
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler()) as reader:
            arrays = reader.restore(checkpoint.path / "state", args=arguments)
    except Exception as error:  # as in _about
        raise _Damaged(_first_line(error)) from error
    leaves = {}
    for name, leaf in abstract.items():
        array = arrays[name] if leaf.size else jnp.zeros(leaf.shape, leaf.dtype)
        description = checkpoint.leaves[name]
        if not isinstance(array, jax.Array) or description["checksum"] not in (None, _checksum(array)):
            raise _Damaged(f"{name} is not as it was written")
        key = description.get("key")
        leaves[name] = jax.random.wrap_key_data(array, impl=key) if key else array
    return leaves


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:200]}"
