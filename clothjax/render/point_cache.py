"""Vertex caches of a garment for Blender, Maya, Houdini, 3ds Max and Cinema 4D, and OBJ sequences."""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.obj import export_obj

from clothjax.render.performance import Part, Performance


def to_pc2(path: str | Path, performance: Performance) -> None:
    """Write the garment [T, V, 3] m in the world as a Point Cache 2, and NAME_mesh.obj, the mesh to put it on."""
    vertices = performance.placed(performance.parts[-1])
    head = b"POINTCACHE2\0" + np.array([1, vertices.shape[1]], "<i4").tobytes()
    head += np.array([0.0, 1.0], "<f4").tobytes() + np.array([len(vertices)], "<i4").tobytes()
    Path(path).write_bytes(head + vertices.astype("<f4").tobytes())
    _rest(Path(path), performance)


def to_mdd(path: str | Path, performance: Performance) -> None:
    """Write the garment [T, V, 3] m in the world as a Lightwave MDD, and NAME_mesh.obj, the mesh to put it on."""
    vertices = performance.placed(performance.parts[-1])
    head = np.array(vertices.shape[:2], ">i4").tobytes()
    seconds = (np.arange(len(vertices)) / performance.fps).astype(">f4").tobytes()
    Path(path).write_bytes(head + seconds + vertices.astype(">f4").tobytes())
    _rest(Path(path), performance)


def to_obj(path: str | Path, performance: Performance) -> None:
    """Write every frame as an OBJ of its own with all parts: NAME_0000.obj, NAME_0001.obj, ..."""
    path = Path(path)
    for t in range(len(performance.root)):
        _mesh(path.with_name(f"{path.stem}_{t:04d}.obj"), performance, t, performance.parts)


def _rest(path: Path, performance: Performance) -> None:
    _mesh(path.with_name(f"{path.stem}_mesh.obj"), performance, 0, performance.parts[-1:])


def _mesh(path: Path, performance: Performance, frame: int, parts: tuple[Part, ...]) -> None:
    root = np.asarray(performance.root)[frame]
    meshes: dict[str, Any] = {
        part.name: trimesh.Trimesh(part.vertices[frame] + root, part.faces, process=False) for part in parts
    }
    path.write_text(export_obj(trimesh.Scene(meshes), include_normals=False, header=""))
