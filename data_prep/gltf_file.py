"""glTF 2.0 files (.glb, .gltf, .vrm): their meshes as they stand in the scene, and how animations move its nodes.

Read are nodes, skins, default morph weights, sparse and normalised accessors. What is compressed is refused by name.
"""

import base64
import json
import urllib.parse
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from clothjax.files.damage import UNREADABLE
from data_prep.recording import LEAST_RATE

DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
SUFFIXES = (".glb", ".gltf", ".vrm", ".vrma")
READ = ("KHR_mesh_quantization", "KHR_texture", "KHR_lights", "KHR_materials", "EXT_texture", "VRM")  # beginnings
COPIES = "EXT_mesh_gpu_instancing"
GLB = b"glTF"
TRIANGLES = 4  # the mode of a primitive; strips and fans follow
MOST = 10_000_000  # entries of an accessor
LATE = 1e-4  # s, by which a key may be late, as numbers of a file are rounded
SAMPLED = 10  # keys at equal times, from which on they are the frames of a recording
MOST_FRAMES = 200_000  # of an animation: two hours at 30 a second


class Skinned(NamedTuple):
    """How joints carry the vertices of a part."""

    skin: int
    turned: float  # degrees, by which the scene turns its joints against each other, beside how it was bound
    bound: np.ndarray  # [V, 3] as the mesh has them, with its default morph weights
    joints: np.ndarray  # [V, n] int64, among those of the skin
    weights: np.ndarray  # [V, n], of sum 1 or 0


class Part(NamedTuple):
    """Triangles of one material of one object."""

    names: tuple[str, ...]  # of its node, its mesh, and its material
    vertices: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3]
    colours: np.ndarray | None  # [V, 3], 0 to 1
    skinned: Skinned | None
    morphs: dict[str, np.ndarray]  # [V, 3] by name, as the mesh has them


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Raise whatever damage to a file raises as a ValueError that names it."""
    try:
        yield
    except UNREADABLE as error:
        told = isinstance(error, ValueError) and not isinstance(error, (json.JSONDecodeError, UnicodeDecodeError))
        detail = error if told else f"damaged, or not glTF: {type(error).__name__} {error}"
        prefix = "" if str(detail).startswith(str(path)) else f"{path}: "
        raise ValueError(f"{prefix}{detail}") from error


class Document:
    """A glTF file, with its binary data.

    Args:
        path: of the file.

    Raises:
        ValueError: if it needs an extension that is not read; whatever damage raises (see `naming`).
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        data, self.binary = self.path.read_bytes(), b""
        if not data:
            raise ValueError("an empty file: copy or download it again")
        if data[:4] == GLB:
            _check_version(str(int.from_bytes(data[4:8], "little")))
            at, chunks = 12, []
            while at + 8 <= len(data):
                size = int.from_bytes(data[at : at + 4], "little")
                chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
                at += 8 + size
            data = next((chunk for kind, chunk in chunks if kind == b"JSON"), b"")
            self.binary = next((chunk for kind, chunk in chunks if kind == b"BIN\0"), b"")
        self.json: dict[str, Any] = json.loads(data)
        _check_version(str(self.json.get("asset", {}).get("version", "2.0")))
        needed = [name for name in self.json.get("extensionsRequired", ()) if not name.startswith(READ)]
        if needed:
            raise ValueError(f"compressed or special ({', '.join(needed)}): export it without")
        self._buffers: dict[int, bytes] = {}

    def entries(self, kind: str) -> list[dict[str, Any]]:
        """Return the entries of a kind, such as `nodes`."""
        return self.json.get(kind, [])

    def accessor(self, index: int) -> np.ndarray:
        """Return the numbers of an accessor [n, width], normalised integers as floats, matrices by columns."""
        entry = self.entries("accessors")[index]
        dtype, width, count = np.dtype(DTYPES[entry["componentType"]]), WIDTHS[entry["type"]], entry["count"]
        if not 0 <= count <= MOST:
            raise ValueError(f"an accessor of {count} entries")
        values = np.zeros((count, width), dtype)
        if "bufferView" in entry:
            values = self._view(entry["bufferView"], entry.get("byteOffset", 0), dtype, width, count)
        if "sparse" in entry:
            sparse, values = entry["sparse"], values.copy()
            rows, new = sparse["indices"], sparse["values"]
            which = np.dtype(DTYPES[rows["componentType"]])
            at = self._view(rows["bufferView"], rows.get("byteOffset", 0), which, 1, sparse["count"])[:, 0]
            values[at] = self._view(new["bufferView"], new.get("byteOffset", 0), dtype, width, sparse["count"])
        if entry.get("normalized") and dtype.kind in "iu":
            return np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        return values

    def _view(self, index: int, offset: int, dtype: np.dtype, width: int, count: int) -> np.ndarray:
        view = self.entries("bufferViews")[index]
        size = width * dtype.itemsize
        stride = view.get("byteStride", size)
        start = view.get("byteOffset", 0) + offset
        data = self._buffer(view["buffer"])
        if count and start + stride * (count - 1) + size > len(data):
            raise ValueError("its data are cut short")
        return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            uri = self.entries("buffers")[index].get("uri")
            if uri is None:
                self._buffers[index] = self.binary
            elif uri.startswith("data:"):
                self._buffers[index] = base64.b64decode(uri.partition(",")[2])
            else:
                beside = self.path.parent / urllib.parse.unquote(uri)
                if not beside.is_file():
                    raise ValueError(f"its data are in {beside}, which is not there: copy that file, too")
                self._buffers[index] = beside.read_bytes()
        return self._buffers[index]

    def places(self) -> dict[int, np.ndarray]:
        """Return the matrices [4, 4] of the nodes in the scene, to the world; parents come before children."""
        scenes = self.entries("scenes")
        roots = scenes[self.json.get("scene", 0)].get("nodes", []) if scenes else None
        if roots is None:
            children = {child for node in self.entries("nodes") for child in node.get("children", ())}
            roots = [i for i in range(len(self.entries("nodes"))) if i not in children]
        found, open_nodes = {}, [(root, np.eye(4)) for root in reversed(roots)]
        while open_nodes:
            index, above = open_nodes.pop()
            if index in found:
                raise ValueError(f"node {index} has two parents")
            found[index] = above @ local(self.entries("nodes")[index])
            children = self.entries("nodes")[index].get("children", ())
            open_nodes += [(child, found[index]) for child in reversed(children)]
        return found

    def skin_transforms(self, index: int, places: dict[int, np.ndarray]) -> np.ndarray:
        """Return the matrices [J, 4, 4] of the joints of a skin, from its mesh to the world."""
        nodes = self.entries("skins")[index]["joints"]
        absent = [node for node in nodes if node not in places]
        if absent:
            name = self.entries("nodes")[absent[0]].get("name", absent[0])
            raise ValueError(f"the joint {name!r} of a skin is not in the scene: export it with its whole skeleton")
        joints = np.stack([places[node] for node in nodes])
        inverse = self.inverse_bind(index)
        return joints if inverse is None else joints @ inverse

    def inverse_bind(self, index: int) -> np.ndarray | None:
        """Return the matrices [J, 4, 4] from the mesh of a skin to its joints, as they were when it was bound."""
        accessor = self.entries("skins")[index].get("inverseBindMatrices")
        if accessor is None:
            return None
        return self.accessor(accessor).reshape(-1, 4, 4).swapaxes(1, 2).astype(np.float64)

    def moved(self, index: int, fps: float, wanted: set[int]) -> dict[int, np.ndarray]:
        """Return the matrices [T, 4, 4] of nodes in the scene over an animation, as `places`, from its first key on.

        Args:
            index: of the animation.
            fps: frames a second.
            wanted: the nodes, and whatever they hang on.
        """
        animation, moves = self.entries("animations")[index], {}
        for channel in animation["channels"]:
            node, kind = channel["target"].get("node"), channel["target"]["path"]
            if node in wanted and kind != "weights":
                sampler = animation["samplers"][channel["sampler"]]
                keys = self.accessor(sampler["input"])[:, 0].astype(np.float64)
                values = self.accessor(sampler["output"]).astype(np.float64)
                moves[node, kind] = keys, values, sampler.get("interpolation", "LINEAR")
        if not moves:
            return {}
        _check_keys(self, moves)
        start, end = (f(f(keys) for keys, *_ in moves.values()) for f in (min, max))
        if not 0 <= (end - start) * fps <= MOST_FRAMES:
            raise ValueError(f"an animation of {end - start:.3g} s has more than {MOST_FRAMES} frames")
        times = start + np.arange(int(np.floor((end - start) * fps + 1e-3)) + 1) / fps
        found: dict[int, np.ndarray] = {}
        for node in self.places():
            if node not in wanted:
                continue
            own = {kind: _sampled(times, *moves[node, kind]) for at, kind in moves if at == node}
            still = self.entries("nodes")[node]
            matrices = np.tile(local(still), (len(times), 1, 1)) if not own else _composed(own, still, len(times))
            parent = self.parent(node)
            found[node] = matrices if parent is None else found[parent] @ matrices
        return found

    def name(self, node: int) -> str:
        """Return what a node is called."""
        return self.entries("nodes")[node].get("name") or f"node {node}"

    def above(self, node: int) -> list[int]:
        """Return a node and those that it hangs on, up to the scene."""
        chain = [node]
        while (parent := self.parent(chain[-1])) is not None:
            chain.append(parent)
        return chain

    def parent(self, node: int) -> int | None:
        """Return the node that carries another."""
        return self._parents.get(node)

    @cached_property
    def _parents(self) -> dict[int, int]:
        return {child: i for i, node in enumerate(self.entries("nodes")) for child in node.get("children", ())}


def _check_version(version: str) -> None:
    if not version.startswith("2"):
        raise ValueError(f"glTF of version {version}, not 2: export it as glTF 2.0")


def _check_keys(document: Document, moves: dict[tuple[int, str], tuple]) -> None:
    """Refuse keys of an animation that are not in order, not in seconds, or no rotations."""
    for (node, kind), (keys, values, _) in moves.items():
        name = document.name(node)
        if not (np.isfinite(keys).all() and np.isfinite(values).all()):
            raise ValueError(f"the {kind} of {name} has a key that is not finite: export it again")
        late = np.flatnonzero(np.diff(keys) <= 0)
        if len(late):
            raise ValueError(f"the {kind} of {name}: key {late[0] + 1} is not after key {late[0]}: export it again")
        still = np.flatnonzero(np.linalg.norm(values, axis=1) == 0.0) if kind == "rotation" else []
        if len(still) and len(values) == len(keys):
            raise ValueError(f"the rotation of {name} is no rotation at key {still[0]}: it is 0 0 0 0")
    keys = max((keys for keys, *_ in moves.values()), key=len)
    apart = np.diff(keys)
    if len(keys) >= SAMPLED and apart.min() > max(1 / LEAST_RATE, 0.9 * apart.max()):
        raise ValueError(
            f"its {len(keys)} keys are {apart[0]:.3g} s apart: are its times in seconds? Export it at 30 a second"
        )


def _composed(moves: dict[str, np.ndarray], node: dict[str, Any], frames: int) -> np.ndarray:
    """Return matrices [T, 4, 4] of a node that some channels move: `translation`, `rotation` or `scale` by frame."""
    parts = {"translation": (0, 0, 0), "rotation": (0, 0, 0, 1), "scale": (1, 1, 1)}
    parts = {kind: moves.get(kind, np.tile(node.get(kind, still), (frames, 1))) for kind, still in parts.items()}
    result = np.tile(np.eye(4), (frames, 1, 1))
    result[:, :3, :3] = Rotation.from_quat(parts["rotation"]).as_matrix() * parts["scale"][:, None]
    result[:, :3, 3] = parts["translation"]
    return result


def _sampled(times: np.ndarray, keys: np.ndarray, values: np.ndarray, how: str) -> np.ndarray:
    """Return the values [T, n] of a channel at times [T] s.

    Args:
        keys: [K] s.
        values: [K, n]; of a cubic spline [3 K, n]: tangent, value and tangent of each key.
        how: STEP, LINEAR or CUBICSPLINE.
    """
    times = np.clip(times, keys[0], keys[-1])
    if how == "CUBICSPLINE":
        before, middle, after = values.reshape(len(keys), 3, -1).swapaxes(0, 1)
        if len(keys) == 1:
            return np.tile(middle, (len(times), 1))
        low = np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 2)
        width = keys[low + 1] - keys[low]
        s = ((times - keys[low]) / width)[:, None]
        ends = (2 * s**3 - 3 * s**2 + 1) * middle[low] + (3 * s**2 - 2 * s**3) * middle[low + 1]
        slopes = (s**3 - 2 * s**2 + s) * after[low] + (s**3 - s**2) * before[low + 1]
        return ends + width[:, None] * slopes
    low = np.clip(np.searchsorted(keys, times + LATE, side="right") - 1, 0, len(keys) - 1)
    if how == "STEP" or len(keys) == 1:
        return values[low]
    if values.shape[1] == 4:
        return Slerp(keys, Rotation.from_quat(values))(times).as_quat()
    return np.stack([np.interp(times, keys, column) for column in values.T], axis=1)


def local(node: dict[str, Any]) -> np.ndarray:
    """Return the matrix [4, 4] of a node on its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    result = np.eye(4)
    result[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)[None]
    result[:3, 3] = node.get("translation", (0, 0, 0))
    return result


def parts(document: Document) -> list[Part]:
    """Read the triangles of all objects in the scene of a file.

    Raises:
        ValueError: for strips and fans of triangles, copies by an extension, objects outside of the scene, or data that
            are cut short.
    """
    places, found = document.places(), []
    meant = [node.get("name", k) for k, node in enumerate(document.entries("nodes")) if "mesh" in node]
    if meant and not any("mesh" in document.entries("nodes")[index] for index in places):
        raise ValueError(f"its objects ({', '.join(map(str, meant))}) are not in its scene: export what is shown")
    for index, place in places.items():
        node = document.entries("nodes")[index]
        if "mesh" not in node:
            continue
        if COPIES in node.get("extensions", {}):
            raise ValueError(f"copies of one object ({COPIES}): export each as an object of its own")
        mesh = document.entries("meshes")[node["mesh"]]
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            mode = primitive.get("mode", TRIANGLES)
            if mode < TRIANGLES or "POSITION" not in attributes:
                continue  # points and lines
            if mode > TRIANGLES:
                raise ValueError("strips or fans of triangles: export it as triangles")
            vertices = document.accessor(attributes["POSITION"]).astype(np.float64)
            morphs = _morphs(document, mesh, primitive)
            for weight, morph in zip(node.get("weights", mesh.get("weights", ())), morphs.values(), strict=False):
                vertices = vertices + weight * morph
            skinned = None
            if "skin" in node and "JOINTS_0" in attributes:  # its node does not move a skinned mesh
                matrices = document.skin_transforms(node["skin"], places)
                skinned = _skinned(document, node["skin"], attributes, vertices, matrices)
                vertices = carried(skinned, matrices)
            else:
                vertices = vertices @ place[:3, :3].T + place[:3, 3]
            count = len(vertices)
            flat = document.accessor(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(count)
            faces = flat[: len(flat) // 3 * 3].astype(np.int64).reshape(-1, 3)
            colours = document.accessor(attributes["COLOR_0"])[:, :3] if "COLOR_0" in attributes else None
            material = primitive.get("material")
            names = (node.get("name"), mesh.get("name"))
            names += (None if material is None else document.entries("materials")[material].get("name"),)
            found.append(Part(tuple(name for name in names if name), vertices, faces, colours, skinned, morphs))
    return found


def _morphs(document: Document, mesh: dict, primitive: dict) -> dict[str, np.ndarray]:
    """Return what the morph targets of a primitive add to its vertices, [V, 3] by name."""
    names, morphs = mesh.get("extras", {}).get("targetNames", []), {}
    for number, target in enumerate(primitive.get("targets", ())):
        count = document.entries("accessors")[primitive["attributes"]["POSITION"]]["count"]
        added = document.accessor(target["POSITION"]) if "POSITION" in target else np.zeros((count, 3))
        name = names[number] if number < len(names) else f"morph_{number}"
        morphs[f"{name}_{number}" if name in morphs else name] = added.astype(np.float64)
    return morphs


def _skinned(document: Document, skin: int, attributes: dict, vertices: np.ndarray, matrices: np.ndarray) -> Skinned:
    joints, weights = [], []
    for group in range(4):
        if f"JOINTS_{group}" not in attributes:
            break
        joints.append(document.accessor(attributes[f"JOINTS_{group}"]).astype(np.int64))
        weights.append(document.accessor(attributes[f"WEIGHTS_{group}"]).astype(np.float64))
    joints, weights = (np.concatenate(each, axis=1) for each in (joints, weights))
    total = weights.sum(axis=1, keepdims=True)
    weights = weights / np.where(total > 0, total, 1.0)
    pulling = np.unique(joints[weights > 0.01])
    turns = nearest_rotations(matrices[pulling, :3, :3]) if len(pulling) else np.eye(3)[None]
    cosine = (np.einsum("jab,ab->j", turns, turns[0]) - 1.0) / 2.0
    turned = float(np.degrees(np.arccos(np.clip(cosine.min(), -1.0, 1.0))))
    return Skinned(skin, turned, vertices, joints, weights)


def nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    """Return the rotations [..., 3, 3] nearest to matrices that may scale."""
    left, _, right = np.linalg.svd(matrices)
    return left @ right


def carried(skinned: Skinned, matrices: np.ndarray) -> np.ndarray:
    """Return the vertices [V, 3] of a skinned part, as the matrices [J, 4, 4] of its skin's joints carry them."""
    blended = np.einsum("vk,vkab->vab", skinned.weights, matrices[skinned.joints])
    homogeneous = np.concatenate([skinned.bound, np.ones((len(skinned.bound), 1))], axis=1)
    return np.einsum("vab,vb->va", blended[:, :3], homogeneous)
