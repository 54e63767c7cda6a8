"""Files of triangle meshes in the formats of modelling programs, with their colours and objects."""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh

from data_prep import gltf_file

BETWEEN = "\x1f"  # names of an object, its group and its material


class Mesh(NamedTuple):
    """A mesh as it is in the file."""

    vertices: np.ndarray  # [V, 3] in the file's units
    faces: np.ndarray  # [F, 3]
    red: np.ndarray  # [V] bool, painted red
    objects: dict[str, np.ndarray]  # by name, [V] bool


def read(path: str | Path) -> Mesh:
    """Read a mesh file (.obj, .ply, .off, .stl, .glb), with all of its objects in one mesh.

    Raises:
        ValueError: if it is no mesh, has no triangles, or has a vertex that is not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        parts = _of_gltf(path) if path.suffix.lower() in gltf_file.SUFFIXES else _of_trimesh(path)
    except Exception as error:  # whatever a reader of a damaged file of some format raises
        hint = "export it as .obj or .glb"
        if path.suffix.lower() == ".ply":
            hint = "export it with triangles only, or as .obj or .glb"
        raise ValueError(f"{path}: not a mesh that can be read ({_brief(error)}); {hint}") from error
    if not parts:
        raise ValueError(f"{path}: no triangles; export the mesh with its faces")
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
    return Mesh(vertices, faces, np.concatenate([part.red for part in parts]), objects)


class _Part(NamedTuple):
    """An object of a file, or a part of it, in the file's units."""

    names: tuple[str, ...]
    vertices: np.ndarray  # [V, 3] float64
    faces: np.ndarray  # [F, 3] int64
    red: np.ndarray  # [V] bool


def _of_trimesh(path: Path) -> list[_Part]:
    options = {"process": False, "split_objects": True, "group_material": False, "skip_materials": True}
    if path.suffix.lower() == ".obj":
        text = _with_groups(path.read_text(encoding="utf-8-sig", errors="replace"))
        scene = trimesh.load_scene(io.StringIO(text), file_type="obj", **options)
    else:
        scene = trimesh.load_scene(path, **options)
    parts = []
    for node in scene.graph.nodes_geometry:
        place, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            mesh = mesh.copy().apply_transform(place)
            names = dict.fromkeys(word for label in (node, name) for word in label.split(BETWEEN) if word)
            vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
            parts.append(_Part(tuple(names), vertices, faces, _red(mesh)))
    return parts


def _with_groups(text: str) -> str:
    """Return an OBJ file's text whose objects also are its groups and materials, with indices that count from 1.

    Programs such as Maya and Marvelous Designer write parts as groups. Relative indices count back from the last.
    """
    counts, current, lines = {"v": 0, "vt": 0, "vn": 0}, {"o": "", "g": "", "usemtl": ""}, []
    for line in text.replace("\\\n", " ").splitlines():
        key, _, rest = line.strip().partition(" ")
        if key in counts:
            counts[key] += 1
        elif key in current:
            current[key] = rest.strip()
            label = BETWEEN.join(dict.fromkeys(name for name in current.values() if name and name != "default"))
            line = f"o {label or 'default'}"
        elif key == "f" and "-" in rest:
            corners = [corner.split("/") for corner in rest.split()]
            line = " ".join(["f", *("/".join(map(_absolute, corner, counts.values())) for corner in corners)])
        lines.append(line)
    return "\n".join(lines) + "\n"


def _absolute(index: str, count: int) -> str:
    return str(count + 1 + int(index)) if index.startswith("-") else index


def _of_gltf(path: Path) -> list[_Part]:
    parts = [part for part in gltf_file.parts(gltf_file.Document(path)) if len(part.faces)]
    colours = [None if part.colours is None else 255.0 * part.colours for part in parts]
    return [
        _Part(part.names, part.vertices, part.faces, _is_red(own, len(part.vertices)))
        for part, own in zip(parts, colours, strict=True)
    ]


def _brief(error: Exception) -> str:
    """Return the first line of an error, shortened."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _red(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return which vertices [V] bool are painted red."""
    painted = mesh.visual.kind == "vertex"
    return _is_red(np.asarray(mesh.visual.vertex_colors) if painted else None, len(mesh.vertices))


def _is_red(colours: np.ndarray | None, count: int) -> np.ndarray:
    """Return which of `count` vertices are red, of colours [V, 3 or more] from 0 to 255, if there are any."""
    if colours is None:
        return np.zeros(count, bool)
    red, green, blue = colours[:, :3].astype(int).T
    return (red > 150) & (green < 100) & (blue < 100)
