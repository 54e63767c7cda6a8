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
    optional joint_names [J] strings, the body's;
    optional cloth [V, 3]: factors of the material's density, of its mu and lam, and of its bending.
Motion, `format` "clothjax/motion", attribute `fps` float64:
    poses [T, J, 3], axis-angle in radians, local to the parent; zero is the body's canonical pose;
    trans [T, 3] float64, of the root relative to its canonical place; joint_names [J] strings.

Readers accept any `format` that ends in /body, /garment or /motion, and ignore further datasets.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from clothjax.files import hdf5
from clothjax.files.hdf5 import Reader
from clothjax.types import Array, Body, Garment, Motion

ASSETS = Path(__file__).parents[1] / "assets"
FACTORS = (0.01, 100.0)  # allowed range of the factors of a garment's cloth


class Rig(NamedTuple):
    """A body and the names of its joints, read from one file."""

    body: Body
    names: tuple[str, ...]  # [J]


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
    with hdf5.reading(asset(path), "body") as file:
        vertices = file.floats("vertices", ("B", 3))
        joints = file.floats("joints", ("J", 3))
        parents = file.integers("parents", ("J",), -1, file.sizes["J"])
        _check_parents(file, parents)
        _check_size(file, "body height", np.ptp(vertices[:, 1]), 0.3, 3.0)
        body = Body(
            vertices=vertices,
            faces=_faces(file, "Fb", "B"),
            joints=joints,
            parents=parents,
            weights=_weights(file, "B"),
            shapedirs=file.floats("shapedirs", ("B", 3, "S")),
            joint_shapedirs=file.floats("joint_shapedirs", ("J", 3, "S")),
        )
        if "posedirs" in file:
            shape = ("B", 3, 9 * (file.sizes["J"] - 1))
            body = body._replace(posedirs=file.floats("posedirs", shape))
        return Rig(body, file.texts("joint_names", ("J",)))


def load_garment(path: str | Path, body: Body, joint_names: Sequence[str] | None = None) -> Garment:
    """Read the garment in a file (or embedded), made for `body`.

    Args:
        path: of the file.
        body: that wears it.
        joint_names: the body's; the garment must have the same in the same order, if its file has any.

    Raises:
        ValueError: naming the file, the dataset and the first wrong entry; or if the body is far away.
    """
    with hdf5.reading(asset(path), "garment") as file:
        if joint_names is not None and "joint_names" in file:
            remedy = "make it for this body (data_prep.garment --body)"
            _check_joints(file, "garment", file.texts("joint_names", ("names",)), joint_names, remedy)
        file.sizes.update(J=len(body.parents), S=np.shape(body.shapedirs)[-1])
        vertices = file.floats("vertices", ("V", 3))
        _check_size(file, "largest extent of the garment", np.ptp(vertices, axis=0).max(), 0.05, 3.0)
        distance = np.median(KDTree(np.asarray(body.vertices)).query(vertices)[0])
        if distance > 0.3:
            file.fail(
                f"half of the garment is more than {distance:.2f} m from the body: "
                "it was made for another body or another origin; align the two"
            )
        faces = _faces(file, "F", "V")
        _check_sides(file, faces)
        loose = np.setdiff1d(np.arange(file.sizes["V"]), faces)
        if len(loose):
            file.fail(f"vertex {loose[0]} has no face ({len(loose)} such): remove it")
        return Garment(
            vertices=vertices,
            faces=faces,
            weights=_weights(file, "V"),
            shapedirs=file.floats("shapedirs", ("V", 3, "S")),
            pinned=file.dataset("pin", ("V",)).astype(bool),
            cloth=_cloth(file) if "cloth" in file else None,
        )


def load_motion(path: str | Path, joint_names: Sequence[str] | None = None) -> Motion:
    """Read the clip in a file (or embedded): rotations float32, translation float64.

    Args:
        path: of the file.
        joint_names: the body's, from `joint_names(body_path)`; the motion must have the same in the same order.

    Raises:
        ValueError: naming the file, the dataset and the first wrong entry.
    """
    with hdf5.reading(asset(path), "motion") as file:
        poses = file.floats("poses", ("T", "J", 3)).astype(np.float64)
        translation = file.floats("trans", ("T", 3), np.float64)
        fps = file.attribute("fps")
        if not isinstance(fps, (int, float, np.number)) or not 0 < fps < np.inf:
            file.fail(f"attribute 'fps' must be a number > 0, got {fps!r}")
        if np.median(np.abs(translation[:, 1])) > 20:
            height = np.median(np.abs(translation[:, 1]))
            file.fail(f"root height {height:.0f} m looks like centimetres: divide by 100")
        names = file.texts("joint_names", ("J",))
        if joint_names is not None:
            _check_joints(file, "motion", names, joint_names, "retarget it (data_prep)")
        rotations = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
        return Motion(rotations.astype(np.float32), translation, float(fps))


def joint_names(path: str | Path) -> tuple[str, ...]:
    """Read the names [J] of the joints of a body or a motion, from a file (or embedded).

    Raises:
        ValueError: for a file that is missing or damaged.
    """
    with hdf5.reading(asset(path), "") as file:
        return file.texts("joint_names", ("J",))


def canonical_rotation(path: str | Path) -> np.ndarray:
    """Read the rotations [J, 3, 3] of a body's bones from its canonical pose to a T-pose; identity if not stored."""
    with hdf5.reading(asset(path), "body") as file:
        names = file.texts("joint_names", ("J",))
        if "canonical_rotation" not in file:
            return np.tile(np.eye(3), (len(names), 1, 1))
        return file.floats("canonical_rotation", (len(names), 3, 3), np.float64)


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
        "joint_names": hdf5.encoded(joint_names),
        **_sparse(body.weights),
        "shapedirs": np.float32(body.shapedirs),
        "joint_shapedirs": np.float32(body.joint_shapedirs),
    }
    if body.posedirs is not None:
        data["posedirs"] = np.float32(body.posedirs)
    if canonical_rotation is not None:
        data["canonical_rotation"] = np.float32(canonical_rotation)
    hdf5.write(path, "body", data, name=name, source=source, licence=licence)


def save_garment(
    path: str | Path, garment: Garment, joint_names: Sequence[str], *, name: str, body: str, source: str, licence: str
) -> None:
    """Write a garment as HDF5, completely or not at all.

    Args:
        joint_names: [J] strings, the body's.
        body: name of the body that it was made for.
        name, source, licence: attributes of the file.
    """
    data = {
        "vertices": np.float32(garment.vertices),
        "faces": np.int32(garment.faces),
        **_sparse(garment.weights),
        "shapedirs": np.float32(garment.shapedirs),
        "pin": np.asarray(garment.pinned, bool),
        "joint_names": hdf5.encoded(joint_names),
    }
    if garment.cloth is not None:
        data["cloth"] = np.float32(garment.cloth)
    hdf5.write(path, "garment", data, name=name, body=body, source=source, licence=licence)


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
        "joint_names": hdf5.encoded(joint_names),
    }
    hdf5.write(path, "motion", data, fps=float(motion.fps), name=name, source=source, licence=licence)


# Checks


def _faces(file: Reader, letter: str, vertices: str) -> np.ndarray:
    """Read faces [letter, 3], each of three different vertices."""
    faces = file.integers("faces", (letter, 3), 0, file.sizes[vertices])
    a, b, c = faces.T
    twice = np.flatnonzero((a == b) | (b == c) | (c == a))
    if len(twice):
        file.fail(f"face {twice[0]} has a vertex twice, {faces[twice[0]].tolist()}: remove it")
    return faces


def _check_sides(file: Reader, faces: np.ndarray) -> None:
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
            file.fail(f"{what}; `python -m data_prep.garment --mesh` checks and orients a mesh")


def _weights(file: Reader, letter: str) -> np.ndarray:
    """Read sparse skinning weights as a dense array [letter, J]."""
    index = file.integers("weights_index", (letter, "n"), 0, file.sizes["J"])
    value = file.floats("weights_value", (letter, "n"))
    wrong = np.flatnonzero((np.abs(value.sum(axis=1) - 1) > 1e-3) | (value.min(axis=1, initial=0) < 0))
    if len(wrong):
        file.fail(
            f"dataset 'weights_value', row {wrong[0]} is {value[wrong[0]].tolist()}: weights must be >= 0 and sum to 1"
        )
    dense = np.zeros((len(index), file.sizes["J"]), np.float32)
    np.add.at(dense, (np.arange(len(index))[:, None], index), value)
    return dense / dense.sum(axis=1, keepdims=True)


def _cloth(file: Reader) -> np.ndarray:
    """Read the factors of a garment's cloth."""
    factors = file.floats("cloth", ("V", 3))
    low, high = FACTORS
    wrong = np.argwhere((factors < low) | (factors > high))
    if len(wrong):
        where = tuple(int(i) for i in wrong[0])
        file.fail(f"dataset 'cloth' is {factors[where]:g} at {where}: a factor from {low} to {high}")
    return factors


def _sparse(weights: Array) -> dict[str, np.ndarray]:
    """Convert dense skinning weights to the datasets of the file."""
    weights = np.asarray(weights)
    influences = max(int((weights > 0).sum(axis=1).max()), 1)
    index = np.argsort(-weights, axis=1, kind="stable")[:, :influences]
    value = np.take_along_axis(weights, index, axis=1)
    return {"weights_index": index.astype(np.int16), "weights_value": value.astype(np.float32)}


def _check_parents(file: Reader, parents: np.ndarray) -> None:
    """Raise a ValueError if the first joint is not the only root, or a joint stands before its parent."""
    order = np.arange(len(parents))
    wrong = np.flatnonzero((parents >= order) | ((parents < 0) != (order == 0)))
    if len(parents) == 0 or len(wrong):
        first = int(wrong[0]) if len(wrong) else 0
        file.fail(
            f"dataset 'parents' is {parents[first : first + 1].tolist()} at joint {first}:"
            " the first joint must have -1, every other one a joint before it"
        )


def _check_size(file: Reader, what: str, size: float, low: float, high: float) -> None:
    """Raise a ValueError for a length in m outside its range, with a guess at its real unit."""
    if low <= size <= high:
        return
    for unit, factor in (("centimetres", 100), ("millimetres", 1000)):
        if low <= size / factor <= high:
            file.fail(f"{what} {size:g} m looks like {unit}: divide lengths by {factor}")
    file.fail(f"{what} is {size:g} m, allowed {low} to {high}")


def _check_joints(file: Reader, kind: str, names: tuple[str, ...], wanted: Sequence[str], remedy: str) -> None:
    """Raise a ValueError that lists how the joints of a motion or a garment differ from the body's, if they do."""
    lacking = [n for n in wanted if n not in names]
    further = [n for n in names if n not in wanted]
    if names != tuple(wanted):
        text = f"lacks {lacking} and also has {further}" if lacking or further else f"has another order, {list(names)}"
        file.fail(f"joints differ from the body's: the {kind} {text}; {remedy}")
