"""Files of triangle meshes in the formats of modelling programs, with their colours and objects."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh


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
        scene = trimesh.load_scene(path, process=False, split_objects=True, group_material=False, skip_materials=True)
        parts = []
        for node in scene.graph.nodes_geometry:
            place, name = scene.graph[node]
            if isinstance(scene.geometry[name], trimesh.Trimesh) and len(scene.geometry[name].faces):
                parts.append(({node, name}, scene.geometry[name].copy().apply_transform(place)))
    except Exception as error:  # whatever a reader of a damaged file of some format raises
        raise ValueError(f"{path}: not a mesh that can be read ({_brief(error)}); export it as .obj or .glb") from error
    if not parts:
        raise ValueError(f"{path}: no triangles; export the mesh with its faces")
    starts = np.cumsum([0, *(len(part.vertices) for _, part in parts)])
    vertices = np.concatenate([np.asarray(part.vertices, np.float64) for _, part in parts])
    faces = np.concatenate([np.asarray(part.faces, np.int64) + start for (_, part), start in zip(parts, starts)])
    infinite = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(infinite):
        raise ValueError(f"{path}: vertex {infinite[0] + 1} of {len(vertices)} is not finite: {vertices[infinite[0]]}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{path}: a face names vertex {faces.max() + 1} of {len(vertices)}")
    objects = {name: np.zeros(len(vertices), bool) for names, _ in parts for name in names}
    for (names, part), start in zip(parts, starts):
        for name in names:
            objects[name][np.asarray(part.faces) + start] = True
    return Mesh(vertices, faces, np.concatenate([_red(part) for _, part in parts]), objects)


def _brief(error: Exception) -> str:
    """Return the first line of an error, shortened."""
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _red(part: trimesh.Trimesh) -> np.ndarray:
    """Return which vertices [V] bool are painted red."""
    if part.visual.kind != "vertex":
        return np.zeros(len(part.vertices), bool)
    red, green, blue = np.asarray(part.visual.vertex_colors)[:, :3].astype(int).T
    return (red > 150) & (green < 100) & (blue < 100)
