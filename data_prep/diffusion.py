"""Transfer of a body's skinning weights and shape directions to a garment."""

import igl
import numpy as np
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from clothjax.types import Body
from data_prep.mesh import edge_table

INFLUENCES = 8  # joints that move a vertex, at most


def diffuse(
    points: np.ndarray,
    faces: np.ndarray,
    body: Body,
    *,
    samples: int = 0,
    spread: float = 0.05,
    hidden: np.ndarray | None = None,
    pinned: np.ndarray | None = None,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Transfer skinning weights and shape directions to a garment around a body, as HOOD does.

    Args:
        points: [V, 3] m, in the body's canonical pose.
        faces: [F, 3] of the garment.
        body: source of the data.
        samples: 0 for tight garments, which get the data of the nearest point on the body's surface. For loose
            garments, the number of points drawn around each vertex, with sqrt(distance) as deviation; the data of
            the nearest body vertices are averaged.
        spread: m, deviation of a blur over a tight garment. Without it the garment would tear where the nearest
            point jumps from arm to trunk or leg to leg.
        hidden: [B] bool, body vertices that give no data, such as hands beside the hips.
        pinned: [V] bool, vertices that only skinning moves. They get the unblurred data of the nearest point, and so
            keep their distance to the body when it bends, unless it folds there.
        seed: of the samples.

    Returns:
        Skinning weights [V, J] and shape directions [V, 3, S], float32.

    Raises:
        ValueError: if no face of the body is left that has no hidden vertex.
    """
    usable = np.ones(len(body.vertices), bool) if hidden is None else ~hidden
    surface = np.asarray(body.faces, np.int64)[usable[body.faces].all(axis=1)]
    if not len(surface):
        raise ValueError("every face of the body has a hidden vertex: nothing to take the skinning from")
    points, vertices = np.asarray(points, np.float64), np.asarray(body.vertices, np.float64)
    shapedirs = np.reshape(body.shapedirs, (len(vertices), -1))
    data = np.concatenate([body.weights, shapedirs], axis=1).astype(np.float64)
    fixed = np.zeros(len(points), bool) if pinned is None else np.asarray(pinned, bool)
    nearest = _nearest(points, vertices, surface, data)
    if samples:
        mixed = _sampled(points, vertices[usable], data[usable], samples, seed)
        mixed[fixed] = nearest[fixed]
    else:
        mixed = _blur(nearest, points, np.asarray(faces), spread, fixed)
    joints = body.weights.shape[1]
    weights = np.clip(mixed[:, :joints], 0, None)
    threshold = np.sort(weights, axis=1)[:, -min(INFLUENCES, joints)][:, None]
    weights = np.where(weights >= threshold, weights, 0)
    weights /= weights.sum(axis=1, keepdims=True)
    return weights.astype(np.float32), mixed[:, joints:].reshape(len(points), 3, -1).astype(np.float32)


def _sampled(points, vertices, data, samples: int, seed: int) -> np.ndarray:
    """Average the data [V, d] of the body vertices nearest to random points around each point [V, 3]."""
    tree, rng = cKDTree(vertices), np.random.default_rng(seed)
    deviation = np.sqrt(tree.query(points)[0])[:, None]
    mixed = np.zeros((len(points), data.shape[1]))
    for _ in range(samples):
        mixed += data[tree.query(points + rng.normal(size=points.shape) * deviation)[1]]
    return mixed / samples


def _nearest(points, vertices, faces, data) -> np.ndarray:
    """Interpolate the data [V, d] of the nearest point on the body's surface."""
    _, face, foot = igl.point_mesh_squared_distance(points, vertices, faces)[:3]
    corners = faces[face]
    share = igl.barycentric_coordinates(foot, *(np.ascontiguousarray(vertices[c]) for c in corners.T))
    return np.einsum("vk,vkd->vd", share, data[corners])


def _blur(data: np.ndarray, points: np.ndarray, faces: np.ndarray, deviation: float, fixed: np.ndarray) -> np.ndarray:
    """Blur data [V, d] by half steps to the neighbours' mean, except on fixed vertices.

    Each step adds a quarter of the squared edge length to the variance.
    """
    edges = edge_table(faces)[0]
    square = np.mean(np.sum((points[edges[:, 0]] - points[edges[:, 1]]) ** 2, axis=1))
    start, end = np.concatenate([edges, edges[:, ::-1]]).T
    mean = coo_matrix((np.ones(len(start)), (start, end)), (len(points), len(points))).tocsr()
    count = np.maximum(np.asarray(mean.sum(axis=1)), 1)
    for _ in range(round(4 * deviation**2 / square)):
        data = np.where(fixed[:, None], data, (data + (mean @ data) / count) / 2)
    return data
