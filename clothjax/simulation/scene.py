"""The scene: a garment, the part of the body within its reach, graphs and tables. NumPy only."""

from typing import NamedTuple

import jraph
import numpy as np
from scipy.spatial import KDTree

from clothjax.config import Config
from clothjax.geometry import mesh_hierarchy, topology
from clothjax.geometry.proximity import Patches, patches
from clothjax.types import Array, Body, Garment, Mesh

NEAR = 0.05  # m, distance at which the body is beside the garment
NEAR_SHARE = 0.05  # share of a joint's vertices beside the garment from which the joint matters


class Table(NamedTuple):
    """The neighbours that a mesh-convolution block reads: output p reads the inputs ids[p, k] where mask[p, k]."""

    ids: Array  # [P, K] int32, padded with the number of inputs
    mask: Array  # [P, K] bool


class Scene(NamedTuple):
    """What all simulations of an experiment share, whatever their character and motion."""

    garment: Garment
    body: Body  # only the vertices that the garment can reach; none where there is no body to touch
    still: bool  # True if the body never moves
    mesh: Mesh  # elements that have energy: faces, hinges and edges with a vertex that is not pinned
    graph: dict[str, jraph.GraphsTuple]  # `mesh`, and the coarse levels in use: edges sorted by receiver
    level: Array  # [V] int32, the deepest coarse level of a vertex, plus one; 0 for none
    tables: tuple[Table, ...]  # one a block of mesh convolution
    patches: Patches | None  # of the body
    garment_patches: Patches

    @property
    def touchable(self) -> bool:
        """True if there is a body to touch."""
        return self.patches is not None


def build_scene(garment: Garment, body: Body, config: Config) -> Scene:
    """Build the scene of a garment on a body; deterministic.

    Raises:
        ValueError: if the body is not near the garment, or a coarse level of `model.processor` would be empty.
    """
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
        patches=patches(np.asarray(within.vertices), np.asarray(within.faces)) if touchable else None,
        garment_patches=patches(np.asarray(garment.vertices), faces),
    )


def edge_set(undirected: np.ndarray, vertices: int) -> jraph.GraphsTuple:
    """Build a graph without features from undirected edges [E, 2] of V `vertices`.

    It has both directions, 2 E edges sorted by receiver.
    """
    senders, receivers = topology.directed(undirected)
    counts = (np.array([n], np.int32) for n in (vertices, len(senders)))
    # jraph's annotations name JAX arrays only
    return jraph.GraphsTuple(None, None, receivers, senders, None, *counts)  # pyright: ignore[reportArgumentType]


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
    return _part(body, vertices, renumbered[inner_faces])


def _bare(body: Body) -> Body:
    """Return the rig of a body without its surface."""
    return _part(body, np.zeros(0, np.int32), np.zeros((0, 3), np.int32))


def _part(body: Body, vertices: np.ndarray, faces: np.ndarray) -> Body:
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
