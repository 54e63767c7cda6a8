"""The scene: a garment, the part of the body within its reach, graphs and tables. NumPy only."""

from typing import NamedTuple

import jraph
import numpy as np

from clothjax.body import reach
from clothjax.config import Config
from clothjax.geometry import mesh_hierarchy, topology
from clothjax.geometry.clusters import Clusters
from clothjax.geometry.correspondence import OnMesh, on_each_other, rigged_like
from clothjax.geometry.proximity import Patches, patches
from clothjax.physics import contact_search
from clothjax.types import Array, Body, Garment, Mesh


class Table(NamedTuple):
    """The neighbours that a mesh-convolution block reads: output p reads the inputs ids[p, k] where mask[p, k]."""

    ids: Array  # [P, K] int32, padded with the number of inputs
    mask: Array  # [P, K] bool


class Felt(NamedTuple):
    """The garment of `model.felt`, which feels the forces."""

    garment: Garment
    mesh: Mesh  # as of `Scene`
    clusters: Clusters | None  # likewise, of this garment's vertices
    on_garment: OnMesh  # where this garment's vertices lie on the scene's; pinned ones have no shares in it


class Scene(NamedTuple):
    """Shared by all simulations of an experiment, whatever their character and motion."""

    garment: Garment
    body: Body  # only the vertices that the garment can reach; none where there is no body to touch
    still: bool  # True if the body never moves
    mesh: Mesh  # elements that have energy: faces, hinges and edges with a vertex that is not pinned
    graph: dict[str, jraph.GraphsTuple]  # `mesh`, and the coarse levels in use: edges sorted by receiver
    level: Array  # [V] int32, the deepest coarse level of a vertex, plus one; 0 for none
    tables: tuple[Table, ...]  # one a block of mesh convolution
    patches: Patches | None  # of the body
    clusters: Clusters | None  # of the garment's vertices, and of the centroids of the body's faces
    garment_patches: Patches
    felt: Felt | None = None  # None where the garment itself feels

    @property
    def touchable(self) -> bool:
        """True if there is a body to touch."""
        return self.patches is not None


def build_scene(garment: Garment, body: Body, config: Config, felt: Garment | None = None) -> Scene:
    """Build the scene of a garment on a body; deterministic.

    Args:
        felt: that of `model.felt`, if it is not the garment itself.

    Raises:
        ValueError: if the body is not near the garment, a coarse level of `model.processor` would be empty, or `felt`
            is another garment.
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
    within = reach.reachable(body, garment, config.physics.reach) if touchable else _bare(body)
    return Scene(
        garment=garment,
        body=within,
        still=config.physics.body == "still",
        mesh=topology.free_mesh(faces, np.asarray(garment.pinned)),
        graph=graph,
        level=mesh_hierarchy.vertex_levels(len(garment.vertices), levels).astype(np.int32),
        tables=tuple(Table(np.asarray(t.ids, np.int32), np.asarray(t.mask)) for t in hierarchy),
        patches=patches(np.asarray(within.vertices), np.asarray(within.faces)) if touchable else None,
        clusters=contact_search.clusters(garment, within) if touchable else None,
        garment_patches=patches(np.asarray(garment.vertices), faces),
        felt=None if felt is None else _felt(felt, garment, within if touchable else None),
    )


def _felt(felt: Garment, garment: Garment, within: Body | None) -> Felt:
    mesh = topology.free_mesh(np.asarray(felt.faces), np.asarray(felt.pinned))
    clusters = None if within is None else contact_search.clusters(felt, within)
    on_garment, _ = on_each_other(felt, garment)
    return Felt(rigged_like(felt, garment), mesh, clusters, on_garment)


def edge_set(undirected: np.ndarray, vertices: int) -> jraph.GraphsTuple:
    """Build a graph without features from undirected edges [E, 2] of V `vertices`.

    It has both directions, 2 E edges sorted by receiver.
    """
    senders, receivers = topology.directed(undirected)
    counts = (np.array([n], np.int32) for n in (vertices, len(senders)))
    # jraph's annotations name JAX arrays only
    return jraph.GraphsTuple(None, None, receivers, senders, None, *counts)  # pyright: ignore[reportArgumentType]


def _bare(body: Body) -> Body:
    """Return the rig of a body without its surface."""
    return reach.part(body, np.zeros(0, np.int32), np.zeros((0, 3), np.int32))
