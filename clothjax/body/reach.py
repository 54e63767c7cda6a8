"""The part of a body that a garment can touch, on the host."""

import numpy as np
from scipy.spatial import KDTree

from clothjax.types import Array, Body, Garment

NEAR = 0.05  # m, distance at which the body is beside the garment
NEAR_SHARE = 0.05  # share of a joint's vertices beside the garment from which the joint matters


def reachable(body: Body, garment: Garment, reach: float) -> Body:
    """Return the part of a body that a garment can touch.

    It has the vertices within `reach` m of the garment, in the canonical pose, of the joints that matter. Those carry
    part of the body beside the garment or, since cloth hangs, are below such a joint. The cut is by joint and far past
    hem and cuffs. Otherwise the tangent plane at its edge would act as a wall through the air for any garment vertex
    that came nearest to it.

    Raises:
        ValueError: if no part of the body is near the garment.
    """
    distance, _ = KDTree(garment.vertices).query(body.vertices)
    joint = np.asarray(body.weights).argmax(axis=1)
    members = np.maximum(np.bincount(joint, minlength=len(body.joints)), 1)
    beside = np.bincount(joint[distance < NEAR], minlength=len(body.joints))
    matters = beside >= NEAR_SHARE * members
    parents, height = np.asarray(body.parents), np.asarray(body.joints)[:, 1]
    matters |= (parents >= 0) & matters[parents] & (height < height[parents])
    inside = (distance < reach) & matters[joint]
    faces = np.asarray(body.faces)
    inner_faces = faces[inside[faces].all(axis=1)]
    if len(inner_faces) == 0:
        raise ValueError(
            f"no part of the body is within {NEAR} m of the garment: they are in different places or units "
            f"(garment {_box(garment.vertices)}, body {_box(body.vertices)})"
        )
    vertices = np.unique(inner_faces)
    renumbered = np.full(len(inside), -1, np.int32)
    renumbered[vertices] = np.arange(len(vertices), dtype=np.int32)
    return part(body, vertices, renumbered[inner_faces])


def part(body: Body, vertices: np.ndarray, faces: np.ndarray) -> Body:
    """Return a body with some of its vertices, and faces that are numbered among these."""
    return body._replace(
        vertices=body.vertices[vertices],
        faces=faces,
        weights=body.weights[vertices],
        shapedirs=body.shapedirs[vertices],
        posedirs=None if body.posedirs is None else body.posedirs[vertices],
    )


def _box(vertices: Array) -> str:
    """Describe the bounding box of vertices for a message."""
    vertices = np.asarray(vertices)
    low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
    return f"from {np.round(low, 2).tolist()} to {np.round(high, 2).tolist()} m"
