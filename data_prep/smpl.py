"""Bodies of the SMPL family (SMPL, SMPL-H, SMPL-X), from the files that their authors publish.

    python -m data_prep.smpl SMPL_FEMALE.pkl body.h5
    python -m data_prep.smpl SMPLX_NEUTRAL.npz body.h5 --shapes 10

The files do not come with clothjax: register at smpl.is.tue.mpg.de, and mind their licence. A .pkl is read without
chumpy, and no code in it is run: only arrays, numbers and texts are allowed.
"""

import codecs
import collections
import copyreg
import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse
import tyro

from clothjax.files.damage import UNREADABLE
from clothjax.files.storage import save_body
from clothjax.types import Body
from data_prep.program import run
from data_prep.recording import GZIP

BODY = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
FINGERS = tuple(
    f"{side}_{finger}{i}" for side in ("left", "right") for finger in ("index", "middle", "pinky", "ring", "thumb")
    for i in (1, 2, 3)
)  # fmt: skip
NAMES = {
    24: (*BODY, "left_hand", "right_hand"),
    52: (*BODY, *FINGERS),
    55: (*BODY, "jaw", "left_eye", "right_eye", *FINGERS),
}
EXPRESSIVE = {20: 10, 400: 300}  # shape parameters of SMPL-X among its columns; expressions follow
KEYS = ("v_template", "f", "weights", "shapedirs", "J_regressor", "kintree_table")


LEFT = tuple(f"left_{part}" for part in ("hip", "knee", "ankle", "collar", "shoulder", "elbow", "wrist"))
ALONG = 0.9  # cosine at least, between trunk or hips and the axis that they are along
TALL, OUTSIDE = (0.3, 3.0), 0.1  # m; share of that, by which a joint may be outside of its mesh


class _Placeholder:
    """Placeholder for an object of a class that is not loaded; holds its state."""

    def __setstate__(self, state):
        self.state = state


class _Chumpy(_Placeholder):
    """Placeholder for a chumpy array."""


class _Columns(_Placeholder):
    """Placeholder for a sparse matrix of scipy in compressed columns."""


class _Rows(_Placeholder):
    """Placeholder for a sparse matrix of scipy in compressed rows."""


SPARSE = {_Columns: scipy.sparse.csc_matrix, _Rows: scipy.sparse.csr_matrix}


def _from_buffer(buffer: bytes, dtype: np.dtype, shape: tuple[int, ...], order: str) -> np.ndarray:
    """Return an array as pickle's protocol 5 holds it."""
    return np.frombuffer(buffer, dtype).reshape(shape, order=order)


# classes and functions that the published files ask for, by their names of then and of now
ALLOWED = {
    "numpy.ndarray": np.ndarray,
    "numpy.dtype": np.dtype,
    "numpy.core.multiarray._reconstruct": np._core.multiarray._reconstruct,
    "numpy._core.multiarray._reconstruct": np._core.multiarray._reconstruct,
    "numpy.core.multiarray.scalar": np._core.multiarray.scalar,
    "numpy._core.multiarray.scalar": np._core.multiarray.scalar,
    "numpy.core.numeric._frombuffer": _from_buffer,
    "numpy._core.numeric._frombuffer": _from_buffer,
    "collections.OrderedDict": collections.OrderedDict,
    "chumpy.ch.Ch": _Chumpy,
    "_codecs.encode": codecs.encode,
    "copy_reg._reconstructor": copyreg._reconstructor,
    "copyreg._reconstructor": copyreg._reconstructor,
    "__builtin__.object": object,
    "builtins.object": object,
}
for _kind, _class in (("csc", _Columns), ("csr", _Rows)):
    for _at in (f"scipy.sparse.{_kind}.{_kind}", f"scipy.sparse._{_kind}.{_kind}"):
        ALLOWED |= {f"{_at}_matrix": _class, f"{_at}_array": _class}


class _Unpickler(pickle.Unpickler):
    """Unpickler that loads nothing but ALLOWED."""

    def find_class(self, module: str, name: str):
        if f"{module}.{name}" not in ALLOWED:
            raise ValueError(
                f"it asks for {module}.{name}, which none of the published body models needs: do not trust it, "
                "or save it anew with plain arrays"
            )
        return ALLOWED[f"{module}.{name}"]


def read(path: str | Path) -> dict[str, np.ndarray]:
    """Read the arrays in KEYS, and `posedirs` if there, of a model file, all dense.

    Raises:
        ValueError: naming the file, if it cannot be read, asks for code, or lacks an array.
    """
    path = Path(path)
    try:
        if path.suffix.lower() == ".npz":
            with Path(path).open("rb") as opened, np.load(opened, allow_pickle=False) as file:
                arrays = {key: file[key] for key in (*KEYS, "posedirs") if key in file.files}
        else:
            with path.open("rb") as file:
                if file.read(len(GZIP)) == GZIP:
                    raise ValueError("it is packed by gzip: unpack it")
                file.seek(0)
                model = _Unpickler(file, encoding="latin1").load()
            arrays = {key: _array(model[key]) for key in (*KEYS, "posedirs") if key in model}
    except FileNotFoundError:
        raise
    except (pickle.UnpicklingError, *UNREADABLE) as error:
        raise ValueError(f"{path}: not a body model of the SMPL family: {error}") from error
    missing = [key for key in KEYS if key not in arrays]
    if missing:
        raise ValueError(f"{path}: has no {', '.join(missing)}: is it a body model of the SMPL family?")
    return arrays


def _array(value) -> np.ndarray:
    """Return the dense array of a value that was unpickled."""
    if isinstance(value, _Chumpy):
        value = value.state["x"]
    if type(value) in SPARSE:
        state = value.state
        shape = state["_shape"] if "_shape" in state else state["shape"]
        value = SPARSE[type(value)]((state["data"], state["indices"], state["indptr"]), shape)
        value.check_format(full_check=True)  # toarray would write out of bounds for a wrong index
        value = value.toarray()
    return np.asarray(value)


def body(path: str | Path, shapes: int = 10) -> tuple[Body, tuple[str, ...]]:
    """Read the body of a model file.

    The joints are linear in betas, by the model's regressor. Pose blend shapes are included.

    Args:
        path: .pkl or .npz as published.
        shapes: number of shape parameters to use, the first ones.

    Returns:
        The body, and the names of its joints.

    Raises:
        ValueError: naming the file, the array and what is wrong with it.
    """
    arrays = read(path)

    def floats(key: str, *shape: int | None) -> np.ndarray:
        """Return an array of the model as finite float64 of a shape, None for any size."""
        try:
            array = np.asarray(arrays[key], np.float64)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: {key} is not of numbers ({error})") from error
        if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape)):
            wanted = " x ".join("any" if n is None else str(n) for n in shape)
            raise ValueError(f"{path}: {key} has shape {array.shape}, expected {wanted}")
        if not array.size:
            raise ValueError(f"{path}: {key} is empty")
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: {key} has an entry that is not finite")
        return array

    vertices = floats("v_template", None, 3)
    count = len(vertices)
    weights = floats("weights", count, None)
    joints = weights.shape[1]
    if joints not in NAMES:
        raise ValueError(f"{path}: has {joints} joints; those of {', '.join(map(str, NAMES))} are known")
    regressor = floats("J_regressor", joints, count)
    shapedirs = floats("shapedirs", count, 3, None)
    columns = shapedirs.shape[-1]
    own = EXPRESSIVE.get(columns, columns) if joints == len(NAMES[55]) else columns
    if not 1 <= shapes <= own:
        others = f" (the other {columns - own} are of expressions)" if own < columns else ""
        raise ValueError(f"{path}: has {own} shape parameters{others}; --shapes {shapes} is out of range")
    shapedirs = shapedirs[..., :shapes]
    parents = floats("kintree_table", 2, joints)[0].astype(np.int64)
    parents[0] = -1
    if (parents[1:] < 0).any() or (parents[1:] >= np.arange(1, joints)).any():
        raise ValueError(f"{path}: kintree_table: a parent does not come before its child")
    faces = floats("f", None, 3)
    if faces.min() < 0 or faces.max() >= count:
        raise ValueError(f"{path}: f: a face names vertex {int(faces.max())} of {count}")
    if weights.min() < 0 or np.abs(weights.sum(axis=1) - 1).max() > 1e-3:
        wrong = int(np.argmax(np.abs(weights.sum(axis=1) - 1) + np.minimum(weights.min(axis=1), 0) ** 2))
        raise ValueError(
            f"{path}: weights of vertex {wrong} sum to {weights[wrong].sum():.3g}, the least is "
            f"{weights[wrong].min():.3g}: they must be >= 0 and sum to 1"
        )
    posedirs = floats("posedirs", count, 3, 9 * (joints - 1)).astype(np.float32) if "posedirs" in arrays else None
    return Body(
        vertices=vertices.astype(np.float32),
        faces=faces.astype(np.int32),
        joints=(regressor @ vertices).astype(np.float32),
        parents=parents.astype(np.int32),
        weights=weights.astype(np.float32),
        shapedirs=shapedirs.astype(np.float32),
        joint_shapedirs=np.einsum("jv,vcs->jcs", regressor, shapedirs).astype(np.float32),
        posedirs=posedirs,
    ), NAMES[joints]


def misplaced(body: Body) -> str:
    """Say how a body with SMPL's joints is not one in metres that stands along +y, faces +z, left at +x; or nothing."""
    vertices, joints = np.asarray(body.vertices, np.float64), np.asarray(body.joints, np.float64)
    at = dict(zip(BODY, joints, strict=False))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    tall = high[1] - low[1]
    low, high = low - OUTSIDE * tall, high + OUTSIDE * tall
    trunk = at["head"] - at["pelvis"]
    if trunk[1] < ALONG * np.linalg.norm(trunk):
        return "its head is not above its pelvis along +y: turn v_template and shapedirs"
    if not TALL[0] < tall < TALL[1]:
        return f"it is {tall:.3g} tall, which is not in m: scale v_template and shapedirs"
    if (joints < low).any() or (joints > high).any():
        outside = int(((joints < low) | (joints > high)).any(axis=1).argmax())
        return f"joint {outside}, of J_regressor, is outside of v_template: the two do not belong together"
    across = [at[left][0] - at[left.replace("left", "right")][0] for left in LEFT]
    ahead = np.mean([at[f"{side}_foot"][2] - at[f"{side}_ankle"][2] for side in ("left", "right")])
    hips = at["left_hip"] - at["right_hip"]
    if abs(hips[0]) < ALONG * np.linalg.norm(hips):
        return "its hips are not along x: turn v_template and shapedirs about y, so that it faces +z"
    if max(across) < 0 and ahead < 0:
        return "it faces -z: turn v_template and shapedirs by half a turn about y"
    if min(across) < 0 or ahead < 0:
        return "its left is not at +x, or its toes not at +z: it is mirrored, or joints are in another order"
    if np.linalg.det(vertices[np.asarray(body.faces)]).sum() < 0:
        return "its faces are seen from inside: turn each around in f"
    return ""


@dataclass(frozen=True)
class Arguments:
    """Convert a body of the SMPL family to a body file."""

    model: tyro.conf.Positional[Path]
    """.pkl or .npz as published."""
    output: tyro.conf.Positional[Path]
    shapes: int = 10
    """Number of shape parameters to use, the first ones."""


def main(args: Arguments) -> None:
    """Write the body file."""
    result, names = body(args.model, args.shapes)
    wrong = misplaced(result)
    if wrong:
        raise ValueError(f"{args.model}: {wrong}")
    save_body(args.output, result, names, name=args.output.stem, source=args.model.name, licence="of the model")
    print(f"{args.output}: {len(result.vertices)} vertices, {len(names)} joints, {args.shapes} shape parameters")


if __name__ == "__main__":
    run(main, Arguments, __doc__)
