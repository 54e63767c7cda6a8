"""Edges, hinges, components and boundaries on meshes small enough to count by hand, and on random ones."""

from itertools import combinations

import numpy as np
import pytest

from clothjax.geometry import topology

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def sheet(rows: int, columns: int) -> np.ndarray:
    """Faces of a rows x columns grid of vertices."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def tube(rows: int, around: int) -> np.ndarray:
    """Faces of a cylinder without lids: `rows` rings of `around` vertices."""
    faces = sheet(rows, around + 1)
    row, column = np.divmod(faces, around + 1)
    return row * around + column % around


def test_counts_of_a_sheet():
    rows, columns = 4, 6
    mesh = topology.mesh(sheet(rows, columns))
    edges = topology.edges(mesh.faces)
    inner = (rows - 2) * (columns - 1) + (columns - 2) * (rows - 1) + (rows - 1) * (columns - 1)
    assert len(mesh.hinges) == inner
    assert len(edges) == inner + 2 * (rows - 1 + columns - 1)
    assert rows * columns - len(edges) + len(mesh.faces) == 1  # Euler
    assert mesh.faces.dtype == mesh.hinges.dtype == edges.dtype == np.int32


def test_hinges_against_a_search_over_pairs_of_faces():
    faces = np.random.default_rng(0).permutation(tube(5, 7))
    expected = set()
    for first, second in combinations(range(len(faces)), 2):
        shared = set(faces[first]) & set(faces[second])
        if len(shared) == 2:
            left, right = faces[first].tolist(), faces[second].tolist()
            corner = next(i for i in range(3) if left[i] not in shared)
            a, b, opposite = left[(corner + 1) % 3], left[(corner + 2) % 3], left[corner]
            expected.add((a, b, opposite, next(v for v in right if v not in shared)))
    hinges = topology.mesh(faces).hinges
    assert {tuple(h) for h in hinges.tolist()} == expected and len(hinges) == len(expected)
    ranked = np.sort(hinges[:, :2], axis=1).tolist()
    assert ranked == sorted(ranked)


def test_an_edge_of_three_faces_makes_one_hinge_of_the_first_two():
    faces = np.array([[7, 1, 0], [0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert topology.mesh(faces).hinges.tolist() == [[1, 0, 7, 2]]


def test_every_edge_of_a_closed_mesh_has_a_hinge():
    assert len(topology.mesh(TETRAHEDRON).hinges) == len(topology.edges(TETRAHEDRON)) == 6
    assert not topology.boundary_mask(TETRAHEDRON, 4).any() and topology.boundary_loops(TETRAHEDRON) == []


def test_edges_are_sorted_unique_and_those_of_the_faces():
    faces = np.random.default_rng(1).permutation(sheet(5, 5))
    pairs = {tuple(sorted(pair)) for face in faces.tolist() for pair in combinations(face, 2)}
    assert [tuple(edge) for edge in topology.edges(faces).tolist()] == sorted(pairs)


def test_directed_edges_hold_both_directions_sorted_by_receiver():
    edges = topology.edges(sheet(4, 3))
    senders, receivers = topology.directed(np.random.default_rng(2).permutation(edges))
    pairs = list(zip(receivers.tolist(), senders.tolist()))
    assert pairs == sorted({(a, b) for a, b in edges.tolist()} | {(b, a) for a, b in edges.tolist()})
    assert senders.dtype == receivers.dtype == np.int32
    assert topology.directed(np.zeros((0, 2), int))[0].shape == (0,)


def test_components_are_numbered_by_their_lowest_vertices():
    edges = np.array([[5, 0], [1, 4], [4, 6]])
    assert topology.components(8, edges).tolist() == [0, 1, 2, 3, 1, 0, 1, 4]
    assert topology.components(3, np.zeros((0, 2), int)).tolist() == [0, 1, 2]


def test_components_from_faces_are_those_from_edges():
    faces = np.concatenate([sheet(3, 3), sheet(2, 4) + 12])
    from_faces = topology.components(21, faces)
    np.testing.assert_array_equal(from_faces, topology.components(21, topology.edges(faces)))
    assert from_faces.tolist() == [0] * 9 + [1, 2, 3] + [4] * 8 + [5]


def test_boundaries_of_a_tube_are_its_rims():
    faces = np.random.default_rng(3).permutation(tube(4, 6))
    faces[1] = faces[1, ::-1]  # the direction of a face does not matter
    loops = topology.boundary_loops(faces)
    assert [loop.tolist() for loop in loops] == [list(range(6)), list(range(18, 24))]
    assert np.flatnonzero(topology.boundary_mask(faces, 25)).tolist() == [*range(6), *range(18, 24)]


def test_boundaries_that_share_a_vertex_are_one():
    faces = np.array([[0, 1, 2], [2, 3, 4], [5, 6, 7]])
    assert [loop.tolist() for loop in topology.boundary_loops(faces)] == [[0, 1, 2, 3, 4], [5, 6, 7]]


@pytest.mark.parametrize(
    "faces, count, words",
    [
        ([[0, 1, 2], [1, 2, 9]], 4, r"face 1 is \[1, 2, 9\].*0 to 3"),
        ([[0, 1, 2], [-1, 2, 0]], None, r"face 1 is \[-1, 2, 0\]"),
        ([[0, 1, 2], [3, 1, 3]], None, r"face 1 is \[3, 1, 3\].*differ"),
        ([[0, 1, 2, 3]], None, r"\[1, 4\].*triangulate"),
        ([0, 1, 2], None, r"\[3\]"),
        ([[0.0, 1.0, 2.0]], None, "float64"),
    ],
)
def test_broken_meshes_name_the_face(faces, count, words):
    with pytest.raises(ValueError, match=words):
        topology.mesh(np.array(faces), count)
