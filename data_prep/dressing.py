"""Operations that fit a garment to a body: clearance, skinning weights and shape directions."""

import igl
import numpy as np

from clothjax.geometry.topology import boundary_loops
from clothjax.types import Body, Garment
from data_prep.diffusion import diffuse
from data_prep.skeleton import ancestors, landmarks

WINDING = igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER
CLEARANCE = 0.004  # m, between garment and body
ON_SKIN = 1e-7  # m; nearer points take the normal of the skin as their way out


def push_out(vertices: np.ndarray, faces: np.ndarray, body: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Push a garment out of the body: its vertices by CLEARANCE, the middles of its edges and faces by half of it.

    If parts of the body nearly touch there may be no such place; the garment then ends up between them.

    Args:
        vertices: [V, 3] m, of the garment.
        faces: [F, 3], of the garment.
        body: [B, 3] m, vertices of the body.
        triangles: faces of the body.
    """
    vertices = clear_vertices(vertices, body, triangles, 10)
    groups = (faces, faces[:, :2], faces[:, 1:], faces[:, [2, 0]])
    for _ in range(20):
        signed, away = outward(np.concatenate([vertices[g].mean(axis=1) for g in groups]), body, triangles)
        if signed.min() >= CLEARANCE / 2:
            break
        move, count = np.zeros_like(vertices), np.zeros(len(vertices))
        too_close = (signed < CLEARANCE / 2).reshape(len(groups), -1)
        for group, bad, direction in zip(groups, too_close, away.reshape(len(groups), -1, 3)):
            for column in group[bad].T:
                np.add.at(move, column, direction[bad])
                np.add.at(count, column, 1)
        vertices = vertices + CLEARANCE / 2 * move / np.maximum(count, 1)[:, None]
    return vertices


def clear_vertices(points: np.ndarray, body: np.ndarray, triangles: np.ndarray, attempts: int) -> np.ndarray:
    """Move points [V, 3] away from the body until CLEARANCE is between."""
    for _ in range(attempts):
        signed, away = outward(points, body, triangles)
        if signed.min() >= 0.999 * CLEARANCE:
            break
        points = points + away * np.where(signed < CLEARANCE, 1.02 * CLEARANCE - signed, 0)[:, None]
    return points


def outward(points: np.ndarray, body: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance [V] of points to the body in m, negative inside, and the directions [V, 3] away from it."""
    signed, face, foot = igl.signed_distance(points, body, triangles, sign_type=WINDING)[:3]
    away = (points - foot) * np.sign(signed)[:, None]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    on_skin = np.abs(signed) < ON_SKIN
    away[on_skin] = igl.per_face_normals(body, triangles, np.array([0.0, 1.0, 0.0]))[face[on_skin]]
    return signed, away


def limbs(body: Body, names: tuple[str, ...], bone: str, share: float = 0.3) -> np.ndarray:
    """Return the vertices of the body [B] bool that belong to a bone of either side, or to what hangs on it.

    Args:
        body: with skinning weights.
        names: of its joints.
        bone: CMU's name without the side, such as `ForeArm`.
        share: least sum of the weights of these joints.
    """
    known = landmarks(names, body.parents)
    roots = {known[side + bone] for side in ("Left", "Right") if side + bone in known}
    chosen = [bool(roots & set(ancestors(joint, body.parents))) for joint in range(len(names))]
    return np.asarray(body.weights)[:, chosen].sum(axis=1) > share


def highest_opening(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the vertices [V] bool on the boundary loop of a mesh that reaches highest; there must be one."""
    highest = np.zeros(len(vertices), bool)
    highest[max(boundary_loops(faces), key=lambda loop: vertices[loop, 1].max())] = True
    return highest


def dress(
    vertices: np.ndarray, faces: np.ndarray, body: Body, hidden: np.ndarray, pinned: np.ndarray, samples: int, seed: int
) -> Garment:
    """Make a garment of a mesh by diffusing the body's skinning weights and shape directions onto it.

    Args:
        vertices: [V, 3] m.
        faces: [F, 3].
        body: around which the mesh is.
        hidden: [B] bool, vertices of the body that the garment does not follow.
        pinned: [V] bool.
        samples: of the diffusion, for loose garments; 0 for tight ones.
        seed: of the samples.
    """
    weights, shapedirs = diffuse(vertices, faces, body, samples=samples, hidden=hidden, pinned=pinned, seed=seed)
    return Garment(vertices.astype(np.float32), faces.astype(np.int32), weights, shapedirs, pinned)
