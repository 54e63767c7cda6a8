"""What stays fixed while an experiment runs: garment, the body within its reach, graphs and tables. NumPy only."""

from typing import NamedTuple

import jraph
import numpy as np
from scipy.spatial import cKDTree

from clothjax.config import Config
from clothjax.geometry import mesh_hierarchy, topology
from clothjax.geometry.proximity import Patches, patches
from clothjax.types import Array, Body, Garment, Mesh

NEAR = 0.05  # m, body beside the garment
NEAR_SHARE = 0.05  # of a joint's vertices beside the garment, for the joint to matter


class Table(NamedTuple):
    """One mesh-convolution block's neighbours: output p reads inputs ids[p, k] where mask[p, k]."""

    ids: Array  # [P, N] int32, padded with the number of inputs
    mask: Array  # [P, N] bool


class Scene(NamedTuple):
    """The fixed part of a simulation."""

    garment: Garment
    body: Body  # only the vertices that the garment can reach; none where there is no body to touch
    still: bool  # whether the body never moves
    mesh: Mesh  # what has energy: of faces, hinges and edges those with a vertex that is not pinned
    graph: dict[str, jraph.GraphsTuple]  # `mesh`, and the coarse levels in use: edges sorted by receiver
    level: Array  # [V] int32, the deepest coarse level of a vertex, plus one; 0 for none
    tables: tuple[Table, ...]
    patches: Patches | None  # of the body
    garment_patches: Patches

    @property
    def touchable(self) -> bool:
        """Whether there is a body to touch."""
        return self.patches is not None


def build_scene(garment: Garment, body: Body, config: Config) -> Scene:
    """The scene of a garment on a body; deterministic."""
    faces = np.asarray(garment.faces)
    used = {name for stack in config.model.processor for name in stack.edges}
    depth = 1 + max((int(name.removeprefix("coarse")) for name in used if name != "mesh"), default=-1)
    levels = mesh_hierarchy.coarse_levels(faces, depth) if depth else []
    for index, level in enumerate(levels):
        if f"coarse{index}" in used and len(level) == 0:
            raise ValueError(
                f"coarse level {index} of this garment ({len(garment.vertices)} vertices) is empty; "
                f"leave coarse{index} out of model.processor"
            )
    count = len(garment.vertices)
    graph = {"mesh": edge_set(topology.edges(faces), count)}
    graph |= {f"coarse{i}": edge_set(level, count) for i, level in enumerate(levels) if f"coarse{i}" in used}
    hierarchy = mesh_hierarchy.hierarchy(
        faces,
        len(garment.vertices),
        strides=[level.stride for level in config.model.convolution],
        radii=[level.radius for level in config.model.convolution],
    )
    touchable = config.physics.body != "none"
    within = reachable(body, garment, config.physics.reach) if touchable else _bare(body)
    mesh, free = topology.mesh(faces, len(garment.vertices)), ~np.asarray(garment.pinned)
    return Scene(
        garment=garment,
        body=within,
        still=config.physics.body == "still",
        mesh=Mesh(*(elements[free[elements].any(axis=1)] for elements in mesh)),
        graph=graph,
        level=mesh_hierarchy.vertex_levels(len(garment.vertices), levels).astype(np.int32),
        tables=tuple(Table(np.asarray(t.ids, np.int32), np.asarray(t.mask)) for t in hierarchy),
        patches=patches(within.vertices, within.faces) if touchable else None,
        garment_patches=patches(garment.vertices, faces),
    )


def edge_set(undirected: np.ndarray, vertices: int) -> jraph.GraphsTuple:
    """Both directions of undirected edges [E, 2] among V vertices, sorted by receiver, as a graph without features."""
    senders, receivers = topology.directed(undirected)
    counts = (np.array([n], np.int32) for n in (vertices, len(senders)))
    return jraph.GraphsTuple(None, None, receivers, senders, None, *counts)


def reachable(body: Body, garment: Garment, reach: float) -> Body:
    """The part of a body that a garment can touch.

    Kept are the vertices within `reach` m of the garment, in the canonical pose, of those joints that carry part of
    the body beside it and, since cloth hangs, of the joints below these. Cutting by joint and far past hem and cuffs
    matters: the tangent plane at the edge of the cut would act as a wall through the air if a garment vertex ever
    came nearest to it.
    """
    distance, _ = cKDTree(garment.vertices).query(body.vertices)
    joint = np.asarray(body.weights).argmax(axis=1)
    members = np.maximum(np.bincount(joint, minlength=len(body.joints)), 1)
    beside = np.bincount(joint[distance < NEAR], minlength=len(body.joints))
    matters = beside >= NEAR_SHARE * members
    parents, height = np.asarray(body.parents), np.asarray(body.joints)[:, 1]
    matters |= (parents >= 0) & matters[parents] & (height < height[parents])
    inside = (distance < reach) & matters[joint]
    faces = np.asarray(body.faces)
    kept_faces = faces[inside[faces].all(axis=1)]
    if len(kept_faces) == 0:
        raise ValueError(
            f"no part of the body is within {NEAR} m of the garment: they are in different places or units "
            f"(garment {_box(garment.vertices)}, body {_box(body.vertices)})"
        )
    kept = np.unique(kept_faces)
    renumbered = np.full(len(inside), -1, np.int32)
    renumbered[kept] = np.arange(len(kept), dtype=np.int32)
    return _part(body, kept, renumbered[kept_faces])


def _bare(body: Body) -> Body:
    """The rig of a body alone."""
    return _part(body, np.zeros(0, np.int32), np.zeros((0, 3), np.int32))


def _part(body: Body, kept: np.ndarray, faces: np.ndarray) -> Body:
    return body._replace(
        vertices=body.vertices[kept],
        faces=faces,
        weights=body.weights[kept],
        shapedirs=body.shapedirs[kept],
        posedirs=None if body.posedirs is None else body.posedirs[kept],
    )


def _box(vertices: np.ndarray) -> str:
    low, high = np.min(vertices, axis=0), np.max(vertices, axis=0)
    return f"from {np.round(low, 2).tolist()} to {np.round(high, 2).tolist()} m"
