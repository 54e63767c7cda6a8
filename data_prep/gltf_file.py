"""glTF 2.0 files (.glb, .gltf): their meshes as they stand in the scene, skinned ones as their skeleton stands.

Read are nodes, skins, default morph weights, sparse and normalised accessors. What is compressed is refused by name.
"""

import base64
import json
import urllib.parse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

DTYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
SUFFIXES = (".glb", ".gltf", ".vrm")
READ = ("KHR_mesh_quantization", "KHR_texture", "KHR_lights", "KHR_materials", "EXT_texture", "VRM")  # beginnings
GLB = b"glTF"
TRIANGLES = 4  # the mode of a primitive; strips and fans follow
MOST = 10_000_000  # entries of an accessor


class Part(NamedTuple):
    """Triangles of one material of one object."""

    names: tuple[str, ...]  # of its node, its mesh, and its material
    vertices: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3]
    colours: np.ndarray | None  # [V, 3], 0 to 1


class Document:
    """A glTF file, with its binary data.

    Args:
        path: of the file.

    Raises:
        ValueError: naming the file, if it is damaged, or needs an extension that is not read.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        data, self.binary = self.path.read_bytes(), b""
        if data[:4] == GLB:
            at, chunks = 12, []
            while at + 8 <= len(data):
                size = int.from_bytes(data[at : at + 4], "little")
                chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
                at += 8 + size
            data = next((chunk for kind, chunk in chunks if kind == b"JSON"), b"")
            self.binary = next((chunk for kind, chunk in chunks if kind == b"BIN\0"), b"")
        self.json: dict[str, Any] = json.loads(data)
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
                self._buffers[index] = (self.path.parent / urllib.parse.unquote(uri)).read_bytes()
        return self._buffers[index]

    def places(self) -> dict[int, np.ndarray]:
        """Return the matrices [4, 4] of the nodes in the scene, to the world; parents come before children."""
        scenes = self.entries("scenes")
        roots = scenes[self.json.get("scene", 0)].get("nodes", []) if scenes else None
        if roots is None:
            children = {child for node in self.entries("nodes") for child in node.get("children", ())}
            roots = [i for i in range(len(self.entries("nodes"))) if i not in children]
        found, open_nodes = {}, [(root, np.eye(4)) for root in roots]
        while open_nodes:
            index, above = open_nodes.pop()
            if index in found:
                raise ValueError(f"node {index} has two parents")
            found[index] = above @ local(self.entries("nodes")[index])
            open_nodes += [(child, found[index]) for child in self.entries("nodes")[index].get("children", ())]
        return found

    def skin_transforms(self, index: int, places: dict[int, np.ndarray]) -> np.ndarray:
        """Return the matrices [J, 4, 4] of the joints of a skin, from its mesh to the world."""
        skin = self.entries("skins")[index]
        joints = np.stack([places[joint] for joint in skin["joints"]])
        if "inverseBindMatrices" not in skin:
            return joints
        return joints @ self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2).astype(np.float64)


def local(node: dict[str, Any]) -> np.ndarray:
    """Return the matrix [4, 4] of a node on its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    turn = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix()
    result = np.eye(4)
    result[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), np.float64)[None]
    result[:3, 3] = node.get("translation", (0, 0, 0))
    return result


def parts(path: str | Path) -> list[Part]:
    """Read the triangles of all objects of a file.

    Raises:
        ValueError: as `Document`, and for strips and fans of triangles.
    """
    document = Document(path)
    places, found = document.places(), []
    for index, place in places.items():
        node = document.entries("nodes")[index]
        if "mesh" not in node:
            continue
        mesh = document.entries("meshes")[node["mesh"]]
        weights = node.get("weights", mesh.get("weights", ()))
        for primitive in mesh["primitives"]:
            attributes = primitive["attributes"]
            mode = primitive.get("mode", TRIANGLES)
            if mode < TRIANGLES or "POSITION" not in attributes:
                continue  # points and lines
            if mode > TRIANGLES:
                raise ValueError("strips or fans of triangles: export it as triangles")
            vertices = document.accessor(attributes["POSITION"]).astype(np.float64)
            for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
                if "POSITION" in target:
                    vertices = vertices + weight * document.accessor(target["POSITION"])
            if "skin" in node and "JOINTS_0" in attributes:  # its node does not move a skinned mesh
                matrices = document.skin_transforms(node["skin"], places)
                vertices = _skinned(vertices, document, attributes, matrices)
            else:
                vertices = vertices @ place[:3, :3].T + place[:3, 3]
            count = len(vertices)
            flat = document.accessor(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(count)
            faces = flat[: len(flat) // 3 * 3].astype(np.int64).reshape(-1, 3)
            colours = document.accessor(attributes["COLOR_0"])[:, :3] if "COLOR_0" in attributes else None
            material = primitive.get("material")
            names = (node.get("name"), mesh.get("name"))
            names += (None if material is None else document.entries("materials")[material].get("name"),)
            found.append(Part(tuple(name for name in names if name), vertices, faces, colours))
    return found


def _skinned(vertices: np.ndarray, document: Document, attributes: dict, matrices: np.ndarray) -> np.ndarray:
    """Return vertices [V, 3] as the joints carry them."""
    blended, total = np.zeros((len(vertices), 4, 4)), np.zeros(len(vertices))
    for group in range(4):
        if f"JOINTS_{group}" not in attributes:
            break
        joints = document.accessor(attributes[f"JOINTS_{group}"]).astype(np.int64)
        weights = document.accessor(attributes[f"WEIGHTS_{group}"]).astype(np.float64)
        blended += np.einsum("vk,vkab->vab", weights, matrices[joints])
        total += weights.sum(axis=1)
    moved = np.einsum("vab,vb->va", blended[:, :3], np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1))
    return moved / np.where(total > 0, total, 1.0)[:, None]
