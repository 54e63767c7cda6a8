"""Garments with thickness, linings, sewing patterns and open fronts: told, and made one sheet where that is asked."""

import re

import igl
import numpy as np
import pytest
from samples import icosphere
from scipy.spatial import cKDTree

from clothjax.files import storage
from clothjax.geometry.topology import boundary_loops, boundary_mask, components, edges
from data_prep import layers
from data_prep.mesh import compact, edge_table, zero_set
from data_prep.seams import check_seams, seams
from data_prep.user_mesh import Answers, bring

OPENINGS = {"tshirt": 4, "skirt": 2}
TIGHT = Answers(loose=False)  # its skinning takes no samples, which is faster


@pytest.fixture(scope="module")
def surface(body):
    return np.asarray(body.vertices, np.float64), np.asarray(body.faces, np.int64)


@pytest.fixture(scope="module", params=OPENINGS)
def kind(request):
    return request.param


def load(name, body):
    made = storage.load_garment(name, body)
    return np.asarray(made.vertices, np.float64), np.asarray(made.faces, np.int64)


@pytest.fixture(scope="module")
def sheet(kind, body):
    return load(f"{kind}_1000", body)


@pytest.fixture
def save(tmp_path):
    """Writes an OBJ file of pieces (vertices, faces), each a group of its own; returns its path."""

    def write(*pieces):
        lines, count = [], 1
        for number, (vertices, faces) in enumerate(pieces):
            lines += [f"g piece_{number}", f"usemtl cloth_{number}"]
            lines += [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices]
            lines += [f"f {a} {b} {c}" for a, b, c in faces + count]
            count += len(vertices)
        (tmp_path / "mine.obj").write_text("\n".join(lines))
        return tmp_path / "mine.obj"

    return write


def solid(vertices, faces, apart, out=0.0):
    """The sheet as the outer side of a closed mesh, `apart` m thick, moved `out` m outwards; and its inner side [V]."""
    normal = igl.per_vertex_normals(vertices, faces)
    outer, inner = vertices + out * normal, vertices + (out - apart) * normal
    half = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, of_face, count = edge_table(faces)
    a, b = half[count[of_face.reshape(-1)] == 1].T
    across = len(vertices)
    strip = np.concatenate([np.stack([b, a, a + across], 1), np.stack([b, a + across, b + across], 1)])
    return np.concatenate([outer, inner]), np.concatenate([faces, faces[:, ::-1] + across, strip]), inner


def halves(vertices, faces, gap=0.0, front=False):
    """The left and the right half, `gap` m apart along the seams between them, or only along the one in front."""
    left = vertices[faces].mean(axis=1)[:, 0] > 0
    shared = np.intersect1d(faces[left], faces[~left])
    pieces = []
    for side, own in ((1, left), (-1, ~left)):
        used, moved = np.unique(faces[own]), vertices.copy()
        at = shared[vertices[shared, 2] > 0.01] if front else shared
        moved[at, 0] += side * gap / 2
        pieces.append((moved[used], compact(moved, faces[own])[1]))
    return pieces


def joined(*pieces):
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
    faces = np.concatenate([faces + start for (_, faces), start in zip(pieces, starts)])
    return np.concatenate([vertices for vertices, _ in pieces]), faces


def area(vertices, faces):
    return igl.doublearea(np.asarray(vertices, np.float64), np.asarray(faces, np.int64)).sum() / 2


def lengths(vertices, faces):
    a, b = np.asarray(vertices)[edges(faces)].swapaxes(0, 1)
    return np.sort(np.linalg.norm(a - b, axis=1))


def farthest(vertices, others):
    return cKDTree(others).query(vertices)[0].max()


def off(made, vertices, faces):
    """The largest distance in m between two surfaces, from the vertices of each."""
    own, triangles = made.vertices.astype(np.float64), made.faces.astype(np.int64)
    there, back = ((own, vertices, faces), (vertices, own, triangles))
    return max(np.sqrt(igl.point_mesh_squared_distance(*query)[0].max()) for query in (there, back))


@pytest.mark.parametrize("apart", [0.001, 0.005, 0.015])
def test_thickness_is_refused_and_its_outer_side_is_the_garment(apart, kind, sheet, body, names, save):
    vertices, faces, inner = solid(*sheet, apart)
    path = save((vertices, faces))
    with pytest.raises(ValueError, match=r"mine\.obj: it has thickness.* mm apart, as at \[.*\] m.*--outer") as refusal:
        bring(path, body, names, TIGHT)
    told = float(re.search(r"([\d.]+) mm apart", str(refusal.value))[1])
    assert told == pytest.approx(1e3 * apart, rel=0.02, abs=0.05)
    made, said = bring(path, body, names, TIGHT._replace(outer=True))
    assert len(boundary_loops(made.faces)) == OPENINGS[kind] and any("left out" in line for line in said)
    assert area(made.vertices, made.faces) == pytest.approx(area(*sheet), rel=0.02)
    assert farthest(made.vertices, sheet[0]) < 1e-5 and len(made.vertices) == len(sheet[0])
    assert cKDTree(inner).query(made.vertices)[0].min() > 0.5 * apart
    np.testing.assert_allclose(lengths(made.vertices, made.faces), lengths(*sheet), atol=1e-5)
    _, said = bring(path, body, names, TIGHT._replace(allow=True))
    assert any("it has thickness" in line for line in said)


@pytest.mark.parametrize("seed", range(4))
def test_a_garment_with_and_without_thickness_is_the_same_sheet(seed, sheet, body, names, save):
    """Whatever the thickness, the order of vertices and faces, and the way that faces are turned."""
    random = np.random.default_rng(seed)
    vertices, faces, _ = solid(*sheet, random.uniform(5e-4, 0.018), out=random.uniform(0, 5e-4))
    order = random.permutation(len(vertices))
    faces = np.argsort(order)[random.permutation(faces)]
    faces = np.where(random.random(len(faces))[:, None] < 0.5, faces, faces[:, ::-1])
    thick, _ = bring(save((vertices[order], faces)), body, names, TIGHT._replace(outer=True))
    thin, _ = bring(save(sheet), body, names, TIGHT)
    assert off(thick, thin.vertices.astype(np.float64), thin.faces.astype(np.int64)) < 1e-3
    assert len(boundary_loops(thick.faces)) == len(boundary_loops(thin.faces))


def test_sides_that_meet_without_a_strip(kind, sheet, body, names, save):
    vertices = solid(*sheet, 0.004)[0]
    count, border = len(sheet[0]), boundary_mask(sheet[1], len(sheet[0]))
    inner = np.where(border, np.arange(count), np.arange(count) + count)[sheet[1]][:, ::-1]
    path = save(compact(vertices, np.concatenate([sheet[1], inner])))
    with pytest.raises(ValueError, match="it has thickness"):
        bring(path, body, names, TIGHT)
    made, _ = bring(path, body, names, TIGHT._replace(outer=True))
    assert off(made, *sheet) < 1e-5 and len(boundary_loops(made.faces)) == OPENINGS[kind]


def test_the_outer_side_of_a_rounded_solid(kind, sheet, surface):
    """All that is within 6 mm of the sheet, meshed anew: its rims are round, its sides have other vertices."""
    low, high = sheet[0].min(axis=0) - 0.02, sheet[0].max(axis=0) + 0.02
    places = low + 0.006 * np.stack(np.indices(np.ceil((high - low) / 0.006).astype(int)), axis=-1)
    distance = np.sqrt(igl.point_mesh_squared_distance(places.reshape(-1, 3), *sheet)[0])
    vertices, faces = zero_set(places, distance.reshape(places.shape[:3]) - 0.006)
    sides = layers.sides(vertices, faces)
    assert sides.thick.all() and sides.apart == pytest.approx(0.012, abs=0.001)
    kept = layers.outer_side("mine.obj", vertices, sides, surface)
    normal = igl.per_vertex_normals(*sheet)
    around = area(sheet[0] + 0.006 * normal, sheet[1])
    assert area(vertices, faces[kept]) == pytest.approx(around, rel=0.02)
    whole = [loop for loop in boundary_loops(faces[kept]) if len(loop) > 20]
    assert len(whole) == OPENINGS[kind]


def test_a_part_without_two_sides_alike_is_refused_by_place(sheet, body, names, save):
    """A button is no cloth: its rim is as large as its sides."""
    button = 0.006 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1.5, 1.5)])
    around = np.array([0, sheet[0][:, 1].mean(), 0.25])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    path = save(sheet, (button + around, faces))
    with pytest.raises(ValueError, match=r"mine\.obj: the part at \[.*0\.2\d\] m has no outer side.*--object"):
        bring(path, body, names, TIGHT._replace(outer=True))


def test_a_lining_is_refused_or_left_out(kind, sheet, body, names, save):
    """Its mesh is another one, four times as fine, and the file has it first."""
    fine, triangles = load(f"{kind}_4000", body)
    lining = fine - 0.006 * igl.per_vertex_normals(fine, triangles), triangles
    path = save(lining, sheet)
    with pytest.raises(ValueError, match=r"mine\.obj: a layer lies [567]\.\d mm inside another, as at \[.*--outer"):
        bring(path, body, names, TIGHT)
    made, said = bring(path, body, names, TIGHT._replace(outer=True))
    assert off(made, *sheet) < 1e-5 and any(f"{len(triangles)} faces of layers" in line for line in said)
    assert len(boundary_loops(made.faces)) == OPENINGS[kind]
    both, said = bring(path, body, names, TIGHT._replace(allow=True))
    assert len(both.vertices) == len(sheet[0]) + len(fine) and any("a layer lies" in line for line in said)


def test_of_three_layers_the_outermost_remains(sheet, surface):
    normal = igl.per_vertex_normals(*sheet)
    pieces = [(sheet[0] + out * normal, sheet[1]) for out in (-0.004, 0.004, 0.0)]
    within, apart = layers.inside(*joined(*pieces), surface)
    count = len(sheet[1])
    np.testing.assert_array_equal(within, np.repeat([True, False, True], count))
    assert apart == pytest.approx(0.004, abs=2e-4)


def test_layers_that_are_far_from_each_other_are_told(body, names, save):
    vertices, faces = load("skirt_1000", body)
    middle = vertices.mean(axis=0) * [1, 0, 1]
    path = save((vertices, faces), (middle + (vertices - middle) * [1.15, 1, 1.15], faces))
    made, said = bring(path, body, names, TIGHT)
    assert len(made.vertices) == 2 * len(vertices)
    assert any("a layer lies" in line and "--outer" in line for line in said)


def test_what_lies_on_a_garment_stays(sheet, body, names, save):
    vertices, faces = sheet
    middle, normal = vertices[faces].mean(axis=1), igl.per_vertex_normals(vertices, faces)
    patch = faces[(middle[:, 2] > 0) & (np.abs(middle[:, 0]) < 0.08) & (middle[:, 1] < np.median(middle[:, 1]))]
    pocket = compact(vertices + 0.003 * normal, patch)
    for outer in (False, True):
        made, said = bring(save(sheet, pocket), body, names, TIGHT._replace(outer=outer))
        assert len(made.vertices) == len(vertices) + len(pocket[0]) and not any("layer lies" in line for line in said)
    assert any("single layer" in line for line in said)


@pytest.mark.parametrize("name", ["tshirt_1000", "dress_1000", "skirt_4000", "pants_1000"])
def test_one_layer_is_not_taken_for_more(name, body, surface):
    for pieces in ([load(name, body)], halves(*load(name, body))):
        vertices, faces = joined(*pieces)
        assert not layers.sides(vertices, faces).thick.any() and not layers.inside(vertices, faces, surface)[0].any()


def test_panels_that_face_each_other_are_no_layers():
    """The inner sides of two legs, each a panel of its own."""
    ball, triangles = icosphere(radius=0.1)
    legs = joined(*((ball + [x, 0, 0], triangles) for x in (-0.15, 0.15)))
    square = np.array([[0, y, z] for y in (-0.05, 0.05) for z in (-0.05, 0.05)])
    faces = np.array([[0, 1, 3], [0, 3, 2]])
    facing, stacked = ([(square + [x, 0, 0], faces) for x in places] for places in ((-0.03, 0.03), (-0.03, -0.01)))
    assert not layers.inside(*joined(*facing), legs)[0].any()
    np.testing.assert_array_equal(layers.inside(*joined(*stacked), legs)[0], [True, True, False, False])


@pytest.mark.parametrize("gap", [0.0, 5e-4])
def test_panels_are_sewn_and_their_seams_told(gap, kind, sheet, body, names, save):
    path = save(*halves(*sheet, gap))
    if gap:
        with pytest.raises(ValueError, match=r"mine\.obj: two borders run 0\.\d mm beside.*--sew 1 sews it"):
            bring(path, body, names, TIGHT)
    made, said = bring(path, body, names, TIGHT._replace(sew=0.6 if gap else 0.1))
    assert "sewn: 2 pieces along 2 seams" in said and off(made, *sheet) < gap / 2 + 1e-5
    assert len(boundary_loops(made.faces)) == OPENINGS[kind] and components(len(made.vertices), made.faces).max() == 0
    np.testing.assert_allclose(lengths(made.vertices, made.faces), lengths(*sheet), atol=gap + 1e-5)


def test_the_place_of_an_open_seam_is_on_it():
    """A slit of 1 mm, 20 cm into a square of 40 cm; the border is one line, which begins far from it."""
    x, y = (0.02 * part.reshape(-1) for part in np.meshgrid(np.arange(21), np.arange(21)))
    points = np.stack([x, y, 0 * x], axis=1)
    corner = np.arange(441).reshape(21, 21)
    a, b, c, d = (corner[i : i + 20, j : j + 20].reshape(-1) for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    lip = np.flatnonzero((y == 0.2) & (x > 0.2))
    above = points[faces].mean(axis=1)[:, 1] > 0.2
    upper = np.full(441, -1)
    upper[lip] = 441 + np.arange(len(lip))
    moved = above[:, None] & (upper[faces] >= 0)
    points, faces = np.concatenate([points, points[lip] + [0, 0.001, 0]]), np.where(moved, upper[faces], faces)
    with pytest.raises(ValueError, match=r"two borders run 1\.0 mm beside each other") as refused:
        check_seams("mine.obj", points, faces, 1e-4, False)
    place = np.array(re.search(r"as at \[(.*?)\] m", str(refused.value))[1].split(), float)
    assert place[0] > 0.19 and place[1] == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("upper, expected", [(2, 4), (1, 3)])
def test_seams_end_where_others_meet_them(upper, expected):
    """Of two panels below and one or two above: a cross of four seams, or a T of three."""
    panels, above = [], [(-1, 0, 1), (0, 0, 1)] if upper == 2 else [(-1, 0, 2)]
    for left, low, wide in [(-1, -1, 1), (0, -1, 1), *above]:
        x, y = np.meshgrid(np.arange(4 * wide + 1), np.arange(5))
        corner = np.arange(x.size).reshape(x.shape)
        a, b, c, d = (corner[i : i + 4, j : j + 4 * wide].reshape(-1) for i in (0, 1) for j in (0, 1))
        points = np.stack([left + x.reshape(-1) / 4, low + y.reshape(-1) / 4, np.zeros(x.size)], axis=1)
        panels.append((points, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])))
    torn = joined(*panels)
    _, first, welded = np.unique(np.round(torn[0], 6), axis=0, return_index=True, return_inverse=True)
    assert seams(torn, torn[0][first], welded.reshape(-1)[torn[1]], 1e-4) == (len(panels), expected)


def test_a_seam_is_sewn_where_one_side_has_twice_as_many_vertices(kind, sheet, body, names, save):
    left, right = halves(*sheet)
    fine = igl.upsample(*left)
    made, said = bring(save(fine, right), body, names, TIGHT)
    assert "sewn: 2 pieces along 2 seams" in said and off(made, *sheet) < 1e-5
    assert len(boundary_loops(made.faces)) == OPENINGS[kind] and components(len(made.vertices), made.faces).max() == 0
    assert farthest(fine[0], made.vertices) < 1e-5 and area(made.vertices, made.faces) == pytest.approx(area(*sheet))
    along = cKDTree(fine[0]).query(right[0])[0] < 1e-6  # the seam's ends and inner vertices, as of the coarse side
    assert len(made.vertices) == len(fine[0]) + len(right[0]) - along.sum()


def test_a_front_whose_edges_overlap_stays_open(kind, sheet, body, names, save):
    left, right = halves(*sheet, -0.03, front=True)
    over = (left[0][:, 0] < 0) & (left[0][:, 2] > 0.01)  # the left edge, laid on the right one
    left[0][over, 2] += 0.01
    made, said = bring(save(left, right), body, names, TIGHT)
    assert "sewn: 2 pieces along 1 seam" in said and len(boundary_loops(made.faces)) == OPENINGS[kind] - 1
    assert farthest(joined(left, right)[0], made.vertices) < 1e-5


@pytest.mark.parametrize("thick", [False, True])
def test_an_open_front_stays_open(thick, kind, sheet, body, names, save):
    """Top, front and hem are one opening; beside it there are the cuffs."""
    left, right = halves(*sheet, 0.04, front=True)
    coat, _ = bring(save(left, right), body, names, TIGHT)
    coat = coat.vertices.astype(np.float64), coat.faces.astype(np.int64)
    assert area(*coat) == pytest.approx(area(*joined(left, right)), rel=1e-4)
    assert farthest(joined(left, right)[0], coat[0]) < 1e-5
    if thick:
        path = save(solid(*coat, 0.004)[:2])
        made, _ = bring(path, body, names, TIGHT._replace(outer=True))
        assert off(made, *coat) < 1e-5 and len(made.vertices) == len(coat[0])
    assert len(boundary_loops(coat[1])) == OPENINGS[kind] - 1


def tube(heights, radius, count):
    """A tube of rings, each of `count` vertices."""
    angle = 2 * np.pi * np.arange(count) / count
    rings = [np.stack([radius * np.cos(angle), np.full(count, y), radius * np.sin(angle)], 1) for y in heights]
    at = np.arange(len(heights) * count).reshape(len(heights), count)
    a, b, c, d = at[:-1], np.roll(at[:-1], -1, 1), at[1:], np.roll(at[1:], -1, 1)
    faces = np.stack([np.stack(corners, -1) for corners in ((a, b, d), (a, d, c))]).reshape(-1, 3)
    return np.concatenate(rings), faces


@pytest.mark.parametrize("upper, lower", [(64, 128), (40, 80), (90, 120), (30, 60)])
def test_a_round_seam_whose_sides_have_other_vertices_is_noticed(upper, lower, body, names, save):
    """A yoke and a skirt on one circle: their sides meet at some vertices, and are up to a millimetre apart between."""
    path = save(tube(np.linspace(0.1, 0.0, 5), 0.22, upper), tube(np.linspace(0.0, -0.3, 10), 0.22, lower))
    with pytest.raises(ValueError, match=r"two borders run \d\.\d mm beside each other.*--sew [12] sews it"):
        bring(path, body, names, TIGHT)
    made, said = bring(path, body, names, TIGHT._replace(sew=2.0))
    assert len(boundary_loops(made.faces)) == 2 and "sewn: 2 pieces along 1 seam" in said


def test_a_seam_of_which_every_third_vertex_is_off_is_noticed(body, names, save):
    """All else is welded: what stays open are slits of two centimetres."""
    upper, faces = tube(np.linspace(0.1, 0.0, 10), 0.2, 120)
    seam = np.arange(len(upper) - 120, len(upper), 3)
    upper[seam, 1] += 5e-4
    path = save((upper, faces), tube(np.linspace(0.0, -0.3, 30), 0.2, 120))
    _, said = bring(path, body, names, TIGHT)
    assert any(re.match(r"40 slits are up to 0\.\d mm wide, as at \[.*\] m, and stay open", line) for line in said)
    made, said = bring(path, body, names, TIGHT._replace(sew=1.0))
    assert len(boundary_loops(made.faces)) == 2 and not any("slits" in line for line in said)


def test_small_holes_are_no_slits():
    vertices, faces = tube(np.linspace(0.0, 0.18, 61), 0.2, 400)  # edges of three millimetres
    kept = np.arange(len(faces)) % 137 != 50
    assert check_seams("a.obj", vertices, faces[kept], 1e-4, False) == []


def test_holes_of_a_scan_are_no_seams(body, names, save):
    vertices, faces = load("tshirt_4000", body)
    kept = np.ones(len(faces), bool)
    kept[::100] = False
    _, said = bring(save((vertices, faces[kept])), body, names, TIGHT)
    assert not any("beside" in line or "slits" in line for line in said)


@pytest.mark.parametrize("apart", [0.022, 0.03])
def test_what_has_no_opening_is_no_cloth(apart, sheet, body, names, save):
    """Thicker than layers are looked for."""
    vertices, faces, _ = solid(*sheet, apart, out=apart)
    for answers in (TIGHT, TIGHT._replace(outer=True)):
        with pytest.raises(ValueError, match=r"the part around \[.*\] m is closed, with no opening"):
            bring(save((vertices, faces)), body, names, answers)
    made, _ = bring(save((vertices, faces)), body, names, TIGHT._replace(allow=True))
    assert not boundary_loops(made.faces)
