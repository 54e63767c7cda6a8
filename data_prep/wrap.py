"""A closed surface around a body of several objects, with openings, or with clothes on: what contact needs."""

import igl
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from data_prep.dressing import WINDING
from data_prep.mesh import compact, components, zero_set

CELL = 0.008  # m, of the grid on which a surface is found
BLOCK = 4  # cells, on whose middle it is looked for first
SMALLEST = 1e-5  # m^3, of a piece
VERTICES = 7000  # of a surface that is wrapped, as many as the embedded body has


def is_closed(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Return whether a mesh is one closed surface, whose faces have their outside outside."""
    return _watertight(vertices, faces) and components(len(vertices), faces).max() == 0


def _watertight(vertices: np.ndarray, faces: np.ndarray) -> bool:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)


def wrap(vertices: np.ndarray, faces: np.ndarray, count: int = VERTICES) -> tuple[np.ndarray, np.ndarray]:
    """Return closed surfaces of about `count` vertices around whatever triangles wind around (Barill et al. 2018).

    What is smaller than SMALLEST is left out, as are hollows.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3], of any number of objects, open or not.
        count: of vertices.

    Raises:
        ImportError: without fast-simplification (`pip install clothjax[data]`).
        ValueError: if they enclose nothing.
    """
    try:
        import fast_simplification
    except ImportError as error:
        raise ImportError("decimating needs fast-simplification: pip install clothjax[data]") from error
    places, field = _field(vertices, faces)
    if field.min() > -CELL:
        raise ValueError("its triangles enclose no body: which objects are the body (--object)?")
    surface, triangles = zero_set(places, gaussian_filter(field, 0.6))
    if trimesh.Trimesh(surface, triangles, process=False).volume < 0:
        triangles = triangles[:, ::-1]
    a, b, c = surface[triangles].swapaxes(0, 1)
    label = components(len(surface), triangles)[triangles[:, 0]]
    volume = np.bincount(label, np.sum(a * np.cross(b, c), axis=-1) / 6)
    surface, triangles = compact(surface, triangles[volume[label] > SMALLEST])
    surface, triangles = surface.astype(np.float32), triangles.astype(np.int32)
    for aggressiveness in (5, 3, 1):  # simplifying sometimes leaves an edge with four faces
        coarse, corners = fast_simplification.simplify(surface, triangles, target_count=2 * count, agg=aggressiveness)
        if _watertight(coarse, corners):
            return coarse.astype(np.float64), corners.astype(np.int64)
    return surface.astype(np.float64), triangles.astype(np.int64)


def _field(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the places [X, Y, Z, 3] m of a grid and the distance [X, Y, Z] to a surface, within BLOCK cells of it.

    It is negative inside. Only where a block's middle is near is it computed for every place of the block.
    """
    low, high = vertices.min(axis=0) - BLOCK * CELL, vertices.max(axis=0) + BLOCK * CELL
    blocks = np.ceil((high - low) / (BLOCK * CELL)).astype(int)
    shape = tuple(BLOCK * blocks)
    places = low + CELL * np.stack(np.indices(shape), axis=-1)
    middles = (
        places.reshape(blocks[0], BLOCK, blocks[1], BLOCK, blocks[2], BLOCK, 3).mean(axis=(1, 3, 5)).reshape(-1, 3)
    )
    distance = np.sqrt(igl.point_mesh_squared_distance(middles, vertices, faces)[0])
    inside = igl.signed_distance(middles, vertices, faces, sign_type=WINDING)[0] < 0
    far = BLOCK * CELL
    field = _spread(np.where(inside, -far, far), blocks)
    near = _spread(distance < 0.5 * np.sqrt(3) * far + far, blocks)
    field[near] = igl.signed_distance(places[near], vertices, faces, sign_type=WINDING)[0]
    return places, np.clip(field, -far, far)


def _spread(values: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Return the value of its block at every place of a grid."""
    return np.kron(values.reshape(blocks), np.ones((BLOCK,) * 3, values.dtype))
