"""Files of triangle meshes in the formats of modelling programs, with their colours and objects."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from data_prep import gltf_file, polygon_file

POSED = 2.0  # degrees between two joints, from which a skeleton is in another pose than it was bound in
SRGB = 1 / 2.2  # the power of a linear colour, as glTF has them, that a screen shows


class Mesh(NamedTuple):
    """A mesh as it is in the file."""

    vertices: np.ndarray  # [V, 3] in the file's units
    faces: np.ndarray  # [F, 3]
    red: np.ndarray  # [V] bool, painted red
    objects: dict[str, np.ndarray]  # by name, [V] bool
    notes: tuple[str, ...] = ()  # what the user should know of how it was read


def read(path: str | Path) -> Mesh:
    """Read a mesh file (.obj, .ply, .off, .stl, .glb, .gltf), with all of its objects in one mesh.

    Raises:
        ValueError: if it is no mesh, has no triangles, or has a vertex that is not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        parts = next((read for suffixes, read in READERS.items() if path.suffix.lower() in suffixes), _of_trimesh)(path)
    except Exception as error:  # whatever a reader of a damaged file of some format raises
        hint = "export it as .obj or .glb"
        raise ValueError(f"{path}: not a mesh that can be read ({_brief(error)}); {hint}") from error
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise ValueError(f"{path}: no triangles, or it is cut short; export the mesh with its faces")
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts)])
    infinite = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(infinite):
        raise ValueError(f"{path}: vertex {infinite[0] + 1} of {len(vertices)} is not finite: {vertices[infinite[0]]}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{path}: a face names vertex {faces.max() + 1} of {len(vertices)}")
    objects = {name: np.zeros(len(vertices), bool) for part in parts for name in part.names}
    for part, start in zip(parts, starts):
        for name in part.names:
            objects[name][part.faces + start] = True
    notes = tuple(dict.fromkeys(part.note for part in parts if part.note))
    return Mesh(vertices, faces, np.concatenate([part.red for part in parts]), objects, notes)


class _Part(NamedTuple):
    """An object of a file, or a part of it, in the file's units."""

    names: tuple[str, ...]
    vertices: np.ndarray  # [V, 3] float64
    faces: np.ndarray  # [F, 3] int64
    red: np.ndarray  # [V] bool
    note: str = ""


def _of_polygons(path: Path) -> list[_Part]:
    whole = polygon_file.read(path)
    red, parts = _is_red(whole.colours, len(whole.vertices)), []
    for names, polygons in whole.groups.items():
        faces = polygon_file.triangles(whole.vertices, polygons)
        used, index = np.unique(faces, return_inverse=True)
        parts.append(_Part(names, whole.vertices[used], index.reshape(-1, 3), red[used]))
    return parts


def _of_trimesh(path: Path) -> list[_Part]:
    scene, parts = trimesh.load_scene(path, process=False), []
    for node in scene.graph.nodes_geometry:
        place, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh):
            mesh = mesh.copy().apply_transform(place)
            vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
            names = tuple(dict.fromkeys((node, name)))
            parts.append(_Part(names, vertices, faces, np.zeros(len(vertices), bool)))
    return parts


def _of_gltf(path: Path) -> list[_Part]:
    found = []
    for part in gltf_file.parts(gltf_file.Document(path)):
        if part.skinned is not None and (bare := int((part.skinned.weights.sum(axis=1) == 0).sum())):
            raise ValueError(f"{bare} vertices of {' '.join(part.names)} follow no joint")
        colours = None if part.colours is None else 255.0 * np.maximum(part.colours, 0.0) ** SRGB
        red, note = _is_red(colours, len(part.vertices)), ""
        if part.skinned is not None and part.skinned.turned > POSED:
            note = (
                f"its skeleton stands {part.skinned.turned:.0f} degrees from the pose that it was bound in, which is "
                "that of a body from the same file: reset its pose and export it again"
            )
        found.append(_Part(part.names, part.vertices, part.faces, red, note))
    return found


def _brief(error: Exception) -> str:
    """Return the first line of an error, shortened."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _is_red(colours: np.ndarray | None, count: int) -> np.ndarray:
    """Return which of `count` vertices are red, of colours [V, 3 or more] from 0 to 255, if there are any."""
    if colours is None:
        return np.zeros(count, bool)
    red, green, blue = colours[:, :3].T
    return (red > 150) & (green < 100) & (blue < 100)


READERS = {gltf_file.SUFFIXES: _of_gltf, (".obj", ".ply", ".off"): _of_polygons}
