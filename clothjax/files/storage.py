"""Bodies, garments and motions as HDF5 files: one schema, checked when a file is opened.

Lengths are metres, +Y is up. Every file has the attributes `format` (below), `version` 1, `name`,
`units` "m", `up` "+Y", `licence` and `source`. Floats are float32 unless said otherwise.

Body, `format` "clothjax/body":
    vertices [B, 3]; faces [Fb, 3] int32; joints [J, 3]; joint_names [J] strings;
    parents [J] int32, the root first with -1, parents before their children;
    weights_index [B, n] int16 and weights_value [B, n]: skinning weights, each row summing to 1;
    shapedirs [B, 3, S] and joint_shapedirs [J, 3, S], per standard deviation;
    optional posedirs [B, 3, 9 (J - 1)];
    optional canonical_rotation [J, 3, 3], which rotates each bone of the canonical pose to a T-pose.
Garment, `format` "clothjax/garment", attribute `body`, the name of the body it is aligned with:
    vertices [V, 3]; faces [F, 3] int32; weights_index [V, n] int16 and weights_value [V, n];
    shapedirs [V, 3, S]; pin [V] bool, the vertices that follow skinning;
    optional cloth [V, 3]: factors of the material's density, of its mu and lam, and of its bending.
Motion, `format` "clothjax/motion", attribute `fps` float64:
    poses [T, J, 3], axis-angle in radians, local to the parent; zero is the body's canonical pose;
    trans [T, 3] float64, of the root relative to its canonical place; joint_names [J] strings.

Readers accept any `format` that ends in /body, /garment or /motion, and ignore further datasets.
"""

import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from clothjax.types import Array, Body, Garment, Motion

VERSION = 1
# exceptions that readers of files raise for damaged files or files of another kind
UNREADABLE = (
    ValueError, LookupError, TypeError, AttributeError, OSError, EOFError, RuntimeError, ArithmeticError, MemoryError,
    SyntaxError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
ASSETS = Path(__file__).parents[1] / "assets"
FACTORS = (0.01, 100.0)  # allowed range of the factors of a garment's cloth


class Rig(NamedTuple):
    """A body and the names of its joints, read from one file."""

    body: Body
    names: tuple[str, ...]  # [J]


class NewerFormat(ValueError):
    """A file was written by a newer version of this library."""


def refuse_newer(path: str | Path, version: int, known: int) -> None:
    """Refuse a file that a newer version of this library wrote.

    Args:
        version, known: numbers of the file's format, and of the newest that is known here.

    Raises:
        NewerFormat: if `version` is the larger.
    """
    if version > known:
        raise NewerFormat(f"{path}: has format {version}, this version of clothjax reads up to {known}; update it")


# Names


def asset(name: str | Path) -> Path:
    """Find the file of a configuration's entry: a path, or the name of an embedded asset such as "tshirt_1000".

    Raises:
        ValueError: for a name that is neither.
    """
    path = Path(name)
    if path.suffix or len(path.parts) > 1:
        return path
    for folder in (ASSETS, ASSETS / "motions"):
        if (folder / f"{name}.h5").is_file():
            return folder / f"{name}.h5"
    known = ", ".join(n for kind in ("body", "garment", "motion") for n in asset_names(kind))
    raise ValueError(f"nothing embedded is called {str(name)!r}: give the path of a file (.h5), or one of {known}")


def asset_names(kind: str) -> tuple[str, ...]:
    """List the names of the embedded assets of a kind, "body", "garment" or "motion", in alphabetical order."""
    files = sorted((ASSETS / "motions" if kind == "motion" else ASSETS).glob("*.h5"))
    names = tuple(file.stem for file in files)
    return names if kind == "motion" else tuple(n for n in names if (n == "body") == (kind == "body"))


# Reading


def load_body(path: str | Path) -> Body:
    """Read the body in a file (or embedded asset); its skinning weights are dense, [B, J] float32.

    Raises:
        ValueError: naming the file, the dataset and the first wrong entry.
    """
    return load_rig(path).body


def load_rig(path: str | Path) -> Rig:
    """Read the body in a file (or embedded) as `load_body` does, and the names of its joints.

    Raises:
        ValueError: naming the file, the dataset and the first wrong entry.
    """
    with _open(path, "body") as file:
        sizes: dict[str, int] = {}
        vertices = _floats(file, "vertices", ("B", 3), sizes)
        joints = _floats(file, "joints", ("J", 3), sizes)
        parents = _integers(file, "parents", ("J",), sizes, -1, sizes["J"])
        _check_parents(file, parents)
        _check_size(file, "body height", np.ptp(vertices[:, 1]), 0.3, 3.0)
        body = Body(
            vertices=vertices,
            faces=_faces(file, ("Fb", 3), sizes, sizes["B"]),
            joints=joints,
            parents=parents,
            weights=_weights(file, "B", sizes),
            shapedirs=_floats(file, "shapedirs", ("B", 3, "S"), sizes),
            joint_shapedirs=_floats(file, "joint_shapedirs", ("J", 3, "S"), sizes),
        )
        if "posedirs" in file:
            shape = ("B", 3, 9 * (sizes["J"] - 1))
            body = body._replace(posedirs=_floats(file, "posedirs", shape, sizes))
        return Rig(body, _names(file, sizes))


def load_garment(path: str | Path, body: Body) -> Garment:
    """Read the garment in a file (or embedded), made for `body`.

    Raises:
        ValueError: naming the file, the dataset and the first wrong entry; or if the body is far away.
    """
    with _open(path, "garment") as file:
        sizes = {"J": len(body.parents), "S": np.shape(body.shapedirs)[-1]}
        vertices = _floats(file, "vertices", ("V", 3), sizes)
        _check_size(file, "largest extent of the garment", np.ptp(vertices, axis=0).max(), 0.05, 3.0)
        distance = np.median(KDTree(np.asarray(body.vertices)).query(vertices)[0])
        if distance > 0.3:
            raise ValueError(
                f"{file.filename}: half of the garment is more than {distance:.2f} m from the body: "
                "it was made for another body or another origin; align the two"
            )
        faces = _faces(file, ("F", 3), sizes, sizes["V"])
        _check_sides(file, faces)
        loose = np.setdiff1d(np.arange(sizes["V"]), faces)
        if len(loose):
            raise ValueError(f"{file.filename}: vertex {loose[0]} has no face ({len(loose)} such): remove it")
        return Garment(
            vertices=vertices,
            faces=faces,
            weights=_weights(file, "V", sizes),
            shapedirs=_floats(file, "shapedirs", ("V", 3, "S"), sizes),
            pinned=_dataset(file, "pin", ("V",), sizes).astype(bool),
            cloth=_cloth(file, sizes) if "cloth" in file else None,
        )


def load_motion(path: str | Path, joint_names: Sequence[str] | None = None) -> Motion:
    """Read the clip in a file (or embedded): rotations float32, translation float64.

    Args:
        path: of the file.
        joint_names: the body's, from `joint_names(body_path)`; the motion must have the same in the same order.

    Raises:
        ValueError: naming the file, the dataset and the first wrong entry.
    """
    with _open(path, "motion") as file:
        sizes: dict[str, int] = {}
        poses = _floats(file, "poses", ("T", "J", 3), sizes).astype(np.float64)
        translation = _floats(file, "trans", ("T", 3), sizes, np.float64)
        fps = file.attrs.get("fps")
        if not isinstance(fps, (int, float, np.number)) or not 0 < fps < np.inf:
            raise ValueError(f"{file.filename}: attribute 'fps' must be a number > 0, got {fps!r}")
        if np.median(np.abs(translation[:, 1])) > 20:
            height = np.median(np.abs(translation[:, 1]))
            raise ValueError(f"{file.filename}: root height {height:.0f} m looks like centimetres: divide by 100")
        names = _names(file, sizes)
        if joint_names is not None and names != tuple(joint_names):
            _refuse_joints(file, names, tuple(joint_names))
        rotations = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
        return Motion(rotations.astype(np.float32), translation, float(fps))


def joint_names(path: str | Path) -> tuple[str, ...]:
    """Read the names [J] of the joints of a body or a motion, from a file (or embedded).

    Raises:
        ValueError: for a file that is missing or damaged.
    """
    with _open(path, "") as file:
        return _names(file, {})


def canonical_rotation(path: str | Path) -> np.ndarray:
    """Read the rotations [J, 3, 3] of a body's bones from its canonical pose to a T-pose; identity if not stored."""
    with _open(path, "body") as file:
        names = _names(file, {})
        if "canonical_rotation" not in file:
            return np.tile(np.eye(3), (len(names), 1, 1))
        return _floats(file, "canonical_rotation", (len(names), 3, 3), {}, np.float64)


# Writing


def save_body(
    path: str | Path,
    body: Body,
    joint_names: Sequence[str],
    *,
    name: str,
    source: str,
    licence: str,
    canonical_rotation: np.ndarray | None = None,
) -> None:
    """Write a body as HDF5, completely or not at all.

    Args:
        joint_names: [J] strings.
        name, source, licence: attributes of the file.
        canonical_rotation: [J, 3, 3], which rotates each bone of the canonical pose to a T-pose.
    """
    data = {
        "vertices": np.float32(body.vertices),
        "faces": np.int32(body.faces),
        "joints": np.float32(body.joints),
        "parents": np.int32(body.parents),
        "joint_names": _strings(joint_names),
        **_sparse(body.weights),
        "shapedirs": np.float32(body.shapedirs),
        "joint_shapedirs": np.float32(body.joint_shapedirs),
    }
    if body.posedirs is not None:
        data["posedirs"] = np.float32(body.posedirs)
    if canonical_rotation is not None:
        data["canonical_rotation"] = np.float32(canonical_rotation)
    _write(path, "body", data, name=name, source=source, licence=licence)


def save_garment(path: str | Path, garment: Garment, *, name: str, body: str, source: str, licence: str) -> None:
    """Write a garment as HDF5, completely or not at all.

    Args:
        body: name of the body that it was made for.
        name, source, licence: attributes of the file.
    """
    data = {
        "vertices": np.float32(garment.vertices),
        "faces": np.int32(garment.faces),
        **_sparse(garment.weights),
        "shapedirs": np.float32(garment.shapedirs),
        "pin": np.asarray(garment.pinned, bool),
    }
    if garment.cloth is not None:
        data["cloth"] = np.float32(garment.cloth)
    _write(path, "garment", data, name=name, body=body, source=source, licence=licence)


def save_motion(
    path: str | Path, motion: Motion, joint_names: Sequence[str], *, name: str, source: str, licence: str
) -> None:
    """Write a motion as HDF5, completely or not at all.

    Args:
        joint_names: [J] strings.
        name, source, licence: attributes of the file.
    """
    rotations = np.asarray(motion.rotations, np.float64)
    poses = Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec().reshape(rotations.shape[:3])
    data = {
        "poses": np.float32(poses),
        "trans": np.float64(motion.translation),
        "joint_names": _strings(joint_names),
    }
    _write(path, "motion", data, fps=float(motion.fps), name=name, source=source, licence=licence)


# One dataset at a time


@contextmanager
def _open(path: str | Path, kind: str) -> Iterator[h5py.File]:
    """Open a file of a kind for reading, and check its attributes."""
    path = asset(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            form = str(_decoded(file.attrs.get("format", "missing")))
            if kind and form.rpartition("/")[2] != kind:
                raise ValueError(f"{path}: attribute 'format' is {form!r}, expected 'clothjax/{kind}'")
            for key, wanted in (("version", VERSION), ("units", "m"), ("up", "+Y")):
                value = _decoded(file.attrs.get(key, wanted))
                if value != wanted:
                    raise ValueError(f"{path}: attribute {key!r} is {value!r}, expected {wanted!r}")
            yield file
    except (OSError, RuntimeError, KeyError) as error:  # h5py raises these for a damaged file
        raise ValueError(f"{path}: not a readable HDF5 file, perhaps cut short ({error})") from error


def _dataset(file: h5py.File, name: str, shape: tuple, sizes: dict[str, int]) -> np.ndarray:
    """Read a dataset of a shape in numbers and letters; a letter new to `sizes` takes the size in the file."""
    if name not in file:
        raise ValueError(f"{file.filename}: dataset {name!r} is missing; it has {', '.join(sorted(map(str, file)))}")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"{file.filename}: {name!r} is not a dataset but a {type(dataset).__name__}")
    actual = dataset.shape
    wanted = tuple(sizes.get(n, n) for n in shape)
    if actual[:1] == (0,):
        what = {"T": "frames", "J": "joints"}.get(shape[0], "rows")
        raise ValueError(f"{file.filename}: dataset {name!r} is empty, there are no {what} in it")
    if len(actual) != len(wanted) or any(isinstance(w, int) and w != n for n, w in zip(actual, wanted, strict=True)):
        text = ", ".join(f"{n} = {sizes[n]}" if n in sizes else str(n) for n in shape)
        raise ValueError(f"{file.filename}: dataset {name!r} has shape {actual}, expected ({text})")
    sizes.update({letter: n for letter, n in zip(shape, actual, strict=True) if isinstance(letter, str)})
    return dataset[()]


def _floats(file: h5py.File, name: str, shape: tuple, sizes: dict[str, int], dtype: type = np.float32) -> np.ndarray:
    """Read a dataset of finite numbers."""
    value = _dataset(file, name, shape, sizes)
    if value.dtype.kind not in "fiu":
        raise ValueError(f"{file.filename}: dataset {name!r} must hold numbers, got {value.dtype}")
    wrong = np.argwhere(~np.isfinite(value))
    if len(wrong):
        where = tuple(int(i) for i in wrong[0])
        raise ValueError(
            f"{file.filename}: dataset {name!r} is {value[where]} at {where}"
            f" ({len(wrong)} such values): all must be finite"
        )
    return value.astype(dtype)


def _integers(file: h5py.File, name: str, shape: tuple, sizes: dict[str, int], low: int, high: int) -> np.ndarray:
    """Read a dataset of integers from `low` to `high` - 1."""
    value = _dataset(file, name, shape, sizes)
    if value.dtype.kind not in "iu":
        raise ValueError(f"{file.filename}: dataset {name!r} must hold integers, got {value.dtype}")
    wrong = np.argwhere((value < low) | (value >= high))
    if len(wrong):
        where = tuple(int(i) for i in wrong[0])
        raise ValueError(f"{file.filename}: dataset {name!r} is {value[where]} at {where}, allowed {low} to {high - 1}")
    return value.astype(np.int32)


def _faces(file: h5py.File, shape: tuple, sizes: dict[str, int], vertices: int) -> np.ndarray:
    """Read faces, each of three different vertices."""
    faces = _integers(file, "faces", shape, sizes, 0, vertices)
    a, b, c = faces.T
    twice = np.flatnonzero((a == b) | (b == c) | (c == a))
    if len(twice):
        raise ValueError(f"{file.filename}: face {twice[0]} has a vertex twice, {faces[twice[0]].tolist()}: remove it")
    return faces


def _check_sides(file: h5py.File, faces: np.ndarray) -> None:
    """Raise a ValueError if the faces are not a sheet with two sides."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    for rows, allowed in ((np.sort(ends, axis=1), 2), (ends, 1)):
        _, first, times = np.unique(rows, axis=0, return_index=True, return_counts=True)
        if times.max(initial=0) > allowed:
            a, b = rows[first[times.argmax()]].tolist()
            around = np.flatnonzero((faces == a).any(axis=1) & (faces == b).any(axis=1)).tolist()
            if allowed == 2:
                what = f"the edge of vertices {a} and {b} has {len(around)} faces, not two: separate the layers"
            else:
                what = f"faces {around[0]} and {around[1]} are wound opposite ways: turn one"
            raise ValueError(f"{file.filename}: {what}; `python -m data_prep.garment --mesh` checks and orients a mesh")


def _weights(file: h5py.File, letter: str, sizes: dict[str, int]) -> np.ndarray:
    """Read sparse skinning weights as a dense array [letter, J]."""
    index = _integers(file, "weights_index", (letter, "n"), sizes, 0, sizes["J"])
    value = _floats(file, "weights_value", (letter, "n"), sizes)
    wrong = np.flatnonzero((np.abs(value.sum(axis=1) - 1) > 1e-3) | (value.min(axis=1, initial=0) < 0))
    if len(wrong):
        raise ValueError(
            f"{file.filename}: dataset 'weights_value', row {wrong[0]} is {value[wrong[0]].tolist()}:"
            " weights must be >= 0 and sum to 1"
        )
    dense = np.zeros((len(index), sizes["J"]), np.float32)
    np.add.at(dense, (np.arange(len(index))[:, None], index), value)
    return dense / dense.sum(axis=1, keepdims=True)


def _cloth(file: h5py.File, sizes: dict[str, int]) -> np.ndarray:
    """Read the factors of a garment's cloth."""
    factors = _floats(file, "cloth", ("V", 3), sizes)
    low, high = FACTORS
    wrong = np.argwhere((factors < low) | (factors > high))
    if len(wrong):
        where = tuple(int(i) for i in wrong[0])
        raise ValueError(
            f"{file.filename}: dataset 'cloth' is {factors[where]:g} at {where}: a factor from {low} to {high}"
        )
    return factors


def _sparse(weights: Array) -> dict[str, np.ndarray]:
    """Convert dense skinning weights to the datasets of the file."""
    weights = np.asarray(weights)
    influences = max(int((weights > 0).sum(axis=1).max()), 1)
    index = np.argsort(-weights, axis=1, kind="stable")[:, :influences]
    value = np.take_along_axis(weights, index, axis=1)
    return {"weights_index": index.astype(np.int16), "weights_value": value.astype(np.float32)}


def _names(file: h5py.File, sizes: dict[str, int]) -> tuple[str, ...]:
    names = _dataset(file, "joint_names", ("J",), sizes)
    return tuple(str(_decoded(n)) for n in names)


def _decoded(value: object) -> object:
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def _strings(values: Sequence[str]) -> np.ndarray:
    """Encode strings at one length, so that the dataset holds them; HDF5 puts others in a heap without checksums."""
    encoded = [value.encode() for value in values]
    return np.array(encoded, h5py.string_dtype("utf-8", max(map(len, encoded), default=0) or 1))


def _check_parents(file: h5py.File, parents: np.ndarray) -> None:
    """Raise a ValueError if the first joint is not the only root, or a joint stands before its parent."""
    order = np.arange(len(parents))
    wrong = np.flatnonzero((parents >= order) | ((parents < 0) != (order == 0)))
    if len(parents) == 0 or len(wrong):
        first = int(wrong[0]) if len(wrong) else 0
        raise ValueError(
            f"{file.filename}: dataset 'parents' is {parents[first : first + 1].tolist()} at joint {first}:"
            " the first joint must have -1, every other one a joint before it"
        )


def _check_size(file: h5py.File, what: str, size: float, low: float, high: float) -> None:
    """Raise a ValueError for a length in m outside its range, with a guess at its real unit."""
    if low <= size <= high:
        return
    for unit, factor in (("centimetres", 100), ("millimetres", 1000)):
        if low <= size / factor <= high:
            raise ValueError(f"{file.filename}: {what} {size:g} m looks like {unit}: divide lengths by {factor}")
    raise ValueError(f"{file.filename}: {what} is {size:g} m, allowed {low} to {high}")


def _refuse_joints(file: h5py.File, names: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    """Raise a ValueError that lists how the joints of a motion differ from the body's."""
    lacking = [n for n in wanted if n not in names]
    further = [n for n in names if n not in wanted]
    text = f"lacks {lacking} and also has {further}" if lacking or further else f"has another order, {list(names)}"
    raise ValueError(f"{file.filename}: joints differ from the body's: the motion {text}; retarget it (data_prep)")


def _write(path: str | Path, kind: str, data: dict[str, np.ndarray], **attributes) -> None:
    """Write datasets and attributes under a temporary name, then rename the file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        # this version has checksums for all of a file: libhdf5 can crash on a damaged description of the data
        with h5py.File(partial, "w", libver=("v110", "v110")) as file:
            fixed = {"format": f"clothjax/{kind}", "version": VERSION, "units": "m", "up": "+Y"}
            for key, value in {**fixed, **attributes}.items():
                file.attrs[key] = _strings([value])[0] if isinstance(value, str) else value
            for key, value in data.items():
                options = {"compression": "gzip", "compression_opts": 9, "shuffle": True, "fletcher32": True}
                file.create_dataset(key, data=value, **options)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
