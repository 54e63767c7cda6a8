"""Coarse levels against HOOD's own, and sampling against the tables of Zhou et al.'s published tool."""

from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from clothjax.geometry import mesh_hierarchy, topology

TABLES = Path(__file__).parents[1] / "data" / "graph_sampling.npz"
GOLDEN = Path(__file__).parents[3] / "shared" / "golden"
CASES = ["grid", "gridred", "gridalt", "gridseed", "grids3", "two", "twoseed"]


def sheet(rows: int, columns: int) -> np.ndarray:
    """Faces of a rows x columns grid of vertices."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def distances(count: int, edges: np.ndarray) -> np.ndarray:
    graph = coo_array((np.ones(len(edges)), np.asarray(edges).T), shape=(count, count)).tocsr()
    return dijkstra(graph, directed=False, unweighted=True)


@pytest.fixture(scope="module")
def tables():
    with np.load(TABLES) as file:
        return dict(file)


@pytest.fixture(scope="module")
def shirt():
    """HOOD's graphs of a t-shirt, and faces with exactly its edges: the cycles of three."""
    path = GOLDEN / "golden_hood_graph.npz"
    if not path.exists():
        pytest.skip("../shared/golden/golden_hood_graph.npz is not here (a mesh for research use only)")
    with np.load(path) as file:
        golden = dict(file)
    edges = np.unique(np.sort(golden["mesh_edge_index"].T, axis=1), axis=0)
    around = [set() for _ in range(4424)]
    for a, b in edges.tolist():
        around[a].add(b)
        around[b].add(a)
    faces = np.array([(a, b, c) for a, b in edges.tolist() for c in around[a] & around[b] if c > b])
    np.testing.assert_array_equal(topology.edges(faces), edges)
    return golden, faces


@pytest.mark.parametrize("centre", [None, 408, 409])
def test_coarse_levels_equal_hoods(shirt, centre):
    golden, faces = shirt
    levels = mesh_hierarchy.coarse_levels(faces, 4, centre)
    name = f"c{centre or 19}"
    for index, level in enumerate(levels):
        np.testing.assert_array_equal(level, golden[f"{name}_coarse{index}"])
    np.testing.assert_array_equal(mesh_hierarchy.vertex_levels(4424, levels[:3]), golden[f"{name}_vertex_level3"])


def test_the_default_centre_is_hoods_first(shirt):
    golden, faces = shirt
    centres = mesh_hierarchy.graph_centres(4424, topology.edges(faces))
    assert centres.tolist() == [golden["center"].min()]


def test_centres_have_least_eccentricity_in_each_component():
    faces = np.concatenate([sheet(5, 4), 20 + sheet(9, 3)])
    edges = topology.edges(np.random.default_rng(0).permutation(48)[faces])  # one vertex is loose
    hops = distances(48, edges)
    eccentricity = np.where(np.isfinite(hops), hops, 0).max(axis=1)
    labels = topology.components(48, edges)
    centres = mesh_hierarchy.graph_centres(48, edges)
    assert len(centres) == labels.max() + 1 == 3
    for component, centre in enumerate(centres):
        member = np.flatnonzero(labels == component)
        assert centre == member[eccentricity[member].argmin()]


def test_approximate_centres_are_nearly_central(monkeypatch):
    monkeypatch.setattr(mesh_hierarchy, "EXACT_CENTRE", 0)
    faces = np.concatenate([sheet(12, 9), 108 + sheet(20, 4)])
    edges = topology.edges(np.random.default_rng(1).permutation(188)[faces])
    hops = distances(188, edges)
    eccentricity = np.where(np.isfinite(hops), hops, 0).max(axis=1)
    labels = topology.components(188, edges)
    for component, centre in enumerate(mesh_hierarchy.graph_centres(188, edges)):
        member = labels == component
        assert member[centre] and eccentricity[centre] <= eccentricity[member].min() + 2


def test_components_are_coarsened_as_if_alone():
    one, other = sheet(9, 7), sheet(6, 8)
    together = mesh_hierarchy.coarse_levels(np.concatenate([one, 63 + other]), 3)
    for a, b, both in zip(*(mesh_hierarchy.coarse_levels(f, 3) for f in (one, other)), together):
        np.testing.assert_array_equal(np.concatenate([a, 63 + b]), both)


def test_levels_nest_shrink_and_may_be_empty():
    faces = sheet(20, 20)
    levels = mesh_hierarchy.coarse_levels(faces, 8)
    vertices = [set(level.ravel().tolist()) for level in levels]
    assert all(b < a or not a for a, b in zip(vertices, vertices[1:]))
    assert len(vertices[0]) <= 210 and len(levels[-1]) == 0 and levels[-1].shape == (0, 2)
    level = mesh_hierarchy.vertex_levels(401, levels)
    assert level[400] == 0
    for index, members in enumerate(vertices):
        assert set(np.flatnonzero(level > index).tolist()) == members


def test_a_level_keeps_each_component_in_one_piece():
    faces = sheet(15, 11)
    for level in mesh_hierarchy.coarse_levels(faces, 3, centre=0):
        vertices = np.unique(level)
        assert len(np.unique(topology.components(165, level)[vertices])) == 1


@pytest.mark.parametrize("case", CASES)
def test_tables_equal_the_published_tools(tables, case):
    def value(name):
        return tables[f"S_{case}_{name}"]

    strides = value("strides").tolist()
    levels = mesh_hierarchy.hierarchy(
        value("faces").astype(int),
        int(value("nverts")),
        strides,
        value("radii").tolist(),
        full_search=bool(value("full")),
        restart=False,
        seeds=value("seeds").tolist(),
    )
    assert len(levels) == len(strides)
    inputs = int(value("nverts"))
    for index, level in enumerate(levels):
        np.testing.assert_array_equal(level.ids, value(f"down{index}_ids"))
        np.testing.assert_array_equal(level.mask, level.ids < inputs)
        np.testing.assert_array_equal(level.sampled, level.ids[:, 0])
        inputs = len(level.sampled)


def test_all_tables_equal_the_full_golden_file():
    path = GOLDEN / "golden_meshconv.npz"
    if not path.exists():
        pytest.skip("../shared/golden/golden_meshconv.npz is not here")
    with np.load(path) as golden:
        for case in CASES:
            levels = mesh_hierarchy.hierarchy(
                golden[f"S_{case}_faces"],
                int(golden[f"S_{case}_nverts"]),
                golden[f"S_{case}_strides"].tolist(),
                golden[f"S_{case}_radii"].tolist(),
                bool(golden[f"S_{case}_full"]),
                False,
                golden[f"S_{case}_seeds"].tolist(),
            )
            inputs = int(golden[f"S_{case}_nverts"])
            for index, level in enumerate(levels):
                np.testing.assert_array_equal(level.mask.sum(axis=1), golden[f"S_{case}_down{index}_count"])
                # The tool's up table is the transpose of the down table.
                up = golden[f"S_{case}_up{index}_ids"]
                reads = [np.flatnonzero((level.ids == v).any(axis=1)).tolist() for v in range(inputs)]
                assert [row[row < len(level.sampled)].tolist() for row in up] == reads
                inputs = len(level.sampled)


@pytest.mark.parametrize("stride, radius", [(1, 1), (2, 2), (2, 1), (3, 2)])
def test_sampled_vertices_are_spaced_and_read_exactly_their_surroundings(stride, radius):
    faces = np.concatenate([sheet(7, 9), 63 + sheet(5, 5)])
    (level,) = mesh_hierarchy.hierarchy(faces, 90, [stride], [radius])  # two vertices are in no face
    hops = distances(90, topology.edges(faces))
    between = hops[np.ix_(level.sampled, level.sampled)]
    assert (between[~np.eye(len(between), dtype=bool)] >= stride).all()
    assert (hops[:, level.sampled].min(axis=1) < stride).all()
    for centre, ids, mask in zip(level.sampled, level.ids, level.mask):
        assert set(ids[mask].tolist()) == set(np.flatnonzero(hops[centre] <= radius).tolist())
        assert (ids[~mask] == 90).all() and (np.diff(hops[centre, ids[mask]]) >= 0).all()


def test_restart_samples_every_component(tables):
    faces, count = tables["S_two_faces"].astype(int), int(tables["S_two_nverts"])
    unread = []
    for restart in (False, True):
        levels = mesh_hierarchy.hierarchy(faces, count, [2, 2], [2, 2], restart=restart)
        unread.append(count - len(np.unique(levels[0].ids[levels[0].mask])))
    assert unread == [30, 0]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (dict(strides=[2], radii=[2, 2]), "1 strides but 2 radii"),
        (dict(strides=[3], radii=[1]), "stride 3 with radius 1"),
        (dict(strides=[0], radii=[1]), "stride 0"),
        (dict(strides=[2], radii=[2], seeds=[99]), r"seeds \[99\].*0 to 8"),
    ],
)
def test_a_wrong_hierarchy_says_what_is_wrong(arguments, words):
    with pytest.raises(ValueError, match=words):
        mesh_hierarchy.hierarchy(sheet(3, 3), 9, **arguments)


def test_a_wrong_centre_or_depth_says_what_is_wrong():
    with pytest.raises(ValueError, match=r"centre is 9.*0 to 8"):
        mesh_hierarchy.coarse_levels(sheet(3, 3), 1, centre=9)
    with pytest.raises(ValueError, match="levels is -1"):
        mesh_hierarchy.coarse_levels(sheet(3, 3), -1)
