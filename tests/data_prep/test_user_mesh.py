"""A mesh that somebody brings becomes a garment, or is refused with what to do about it."""

import re

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from clothjax.files import storage
from clothjax.geometry.topology import boundary_mask
from data_prep import dressing, garment, placement, user_mesh
from data_prep.placement import Placement
from data_prep.program import METRES
from data_prep.user_mesh import Answers, bring


@pytest.fixture(scope="module")
def skirt(body):
    """Vertices and faces of the embedded skirt."""
    made = storage.load_garment("skirt_1000", body)
    return np.asarray(made.vertices, np.float64), np.asarray(made.faces, np.int64)


@pytest.fixture
def save(tmp_path):
    """Writes a mesh; returns its path."""

    def write(vertices, faces, name="skirt.obj", colours=None):
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        if colours is not None:
            mesh.visual.vertex_colors = colours
        mesh.export(tmp_path / name)
        return tmp_path / name

    return write


def nearest(points, others):
    return np.linalg.norm(points[:, None] - others[None], axis=-1).min(axis=1)


def test_a_mesh_that_fits_is_left_as_it_is(skirt, body, names, save):
    vertices, _ = skirt
    made, said = bring(save(*skirt), body, names, Answers(pin="highest"))
    assert len(made.vertices) == len(vertices) and nearest(made.vertices, vertices).max() < 1e-5
    assert made.vertices[made.pinned, 1].min() > vertices[:, 1].max() - 0.05 and made.pinned.sum() > 20
    assert any(line.startswith("loose") for line in said)
    # the skirt follows the hips and legs, not the hands that hang beside it
    arms = [i for i, name in enumerate(names) if re.search("ForeArm|Hand|Thumb|Finger", name)]
    assert made.weights[:, arms].max() < 0.05
    np.testing.assert_allclose(made.weights.sum(axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("units, up", [("cm", "y"), ("mm", "z"), ("m", "z"), ("in", "y")])
def test_units_and_axes_are_asked_for(skirt, body, names, save, units, up):
    vertices, faces = skirt
    path = save(vertices @ placement.TO_Y_UP[up] / METRES[units], faces)
    with pytest.raises(ValueError, match=rf"skirt\.obj.*--units {units} --up {up}\?"):
        bring(path, body, names, Answers())
    made, _ = bring(path, body, names, Answers(Placement(units, up)))
    assert nearest(made.vertices, vertices).max() < 1e-4


def test_what_is_nowhere_near_the_body_is_refused(skirt, body, names, save):
    vertices, faces = skirt
    with pytest.raises(ValueError, match="move the mesh onto the body"):
        bring(save(vertices + [3.0, 0, 0], faces), body, names, Answers())


def test_seams_are_welded_and_faces_turned(skirt, body, names, save):
    vertices, faces = skirt
    torn = vertices[faces].reshape(-1, 3)  # every face for itself
    apart = np.arange(len(torn)).reshape(-1, 3)
    apart[::3] = apart[::3, ::-1]
    apart = np.concatenate([apart, apart[:2], [[0, 0, 1]]])
    made, said = bring(save(torn, apart, "torn.stl"), body, names, Answers())
    assert len(made.vertices) == len(vertices) and len(made.faces) == len(faces)
    assert any(line.startswith("welded") for line in said) and any(line.startswith("turned") for line in said)
    corners = made.vertices[made.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal * (corners.mean(axis=1) - body.joints[0]) * [1, 0, 1]).sum() > 0
    inward, _ = bring(save(torn, apart, "torn.stl"), body, names, Answers(flip=True))
    corners = inward.vertices[inward.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normal * (corners.mean(axis=1) - body.joints[0]) * [1, 0, 1]).sum() < 0


def test_pins_by_colour_and_by_object(skirt, body, names, save, tmp_path):
    vertices, faces = skirt
    top = vertices[:, 1] > vertices[:, 1].max() - 0.03
    colours = np.where(top[:, None], [200, 10, 10, 255], [180, 180, 180, 255])
    made, _ = bring(save(vertices, faces, "painted.ply", colours), body, names, Answers(pin="red"))
    assert nearest(made.vertices[made.pinned], vertices[top]).max() < 1e-5 and made.pinned.sum() == top.sum()
    band, rest = (np.all(top[faces], axis=1), ~np.all(top[faces], axis=1))
    scene = trimesh.Scene()
    for name, part in (("band", band), ("cloth", rest)):
        scene.add_geometry(trimesh.Trimesh(vertices, faces[part], process=False), geom_name=name)
    for name in ("parts.obj", "parts.glb"):
        scene.export(tmp_path / name)
        made, said = bring(tmp_path / name, body, names, Answers(pin="object:band"))
        assert len(made.vertices) == len(vertices) and any(line.startswith("welded") for line in said)
        of_band = np.zeros(len(vertices), bool)
        of_band[faces[band]] = True
        assert made.pinned.sum() == of_band.sum()
    placed = trimesh.Scene()
    for name, part in (("waistband", band), ("below", rest)):
        shape = trimesh.Trimesh(vertices, faces[part], process=False)
        placed.add_geometry(shape, node_name=name, geom_name=f"mesh_of_{name}")
    placed.export(tmp_path / "placed.glb")
    made, _ = bring(tmp_path / "placed.glb", body, names, Answers(pin="object:waistband"))
    assert made.pinned.sum() == of_band.sum()
    with pytest.raises(ValueError, match=r"no object 'hem'.*band, cloth|no object 'hem'.*cloth, band"):
        bring(tmp_path / "parts.glb", body, names, Answers(pin="object:hem"))
    with pytest.raises(ValueError, match="painted red"):
        bring(save(*skirt), body, names, Answers(pin="red"))


def test_parts_of_other_cloth(skirt, body, names, save, tmp_path):
    vertices, faces = skirt
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    hem, top = vertices[:, 1] < low + 0.05, vertices[:, 1] > high - 0.03
    colours = np.where(top[:, None], [200, 10, 10, 255], [180, 180, 180, 255])
    painted = save(vertices, faces, "painted.ply", colours)
    assert bring(painted, body, names, Answers())[0].cloth is None
    made, said = bring(painted, body, names, Answers(cloth=("red=1.5,4,20",)))
    of_band = made.vertices[:, 1] > high - 0.03
    np.testing.assert_array_equal(made.cloth[of_band], np.tile([1.5, 4, 20], (of_band.sum(), 1)))
    np.testing.assert_array_equal(made.cloth[~of_band], np.ones(((~of_band).sum(), 3)))
    assert any("red: " in line and "1.5 times the weight" in line for line in said)
    scene = trimesh.Scene()
    for name, part in (("hem", np.all(hem[faces], axis=1)), ("rest", ~np.all(hem[faces], axis=1))):
        scene.add_geometry(trimesh.Trimesh(vertices, faces[part], process=False), geom_name=name)
    scene.export(tmp_path / "parts.glb")
    finer = Answers(cloth=("object:rest=1,2,2", "object:hem=3,1,1"), vertices=2000)
    made, _ = bring(tmp_path / "parts.glb", body, names, finer)
    of_hem = (made.cloth == [3, 1, 1]).all(axis=1)
    assert of_hem[made.vertices[:, 1] < low + 0.03].all() and not of_hem[made.vertices[:, 1] > low + 0.07].any()
    for wrong, said in (
        ("red=1,4", "red=1,4: give WHAT=DENSITY"),
        ("red=1,4,1e9", "from 0.01 to 100"),
        ("highest=1,1,1", "--cloth highest: choose red"),
        ("object:cuff=1,1,1", "no object 'cuff' for --cloth"),
    ):
        with pytest.raises(ValueError, match=re.escape(said)):
            bring(painted, body, names, Answers(cloth=(wrong,)))


def test_it_is_pushed_out_of_the_body_and_remeshed(skirt, body, names, save):
    import igl

    vertices, faces = skirt
    tight = vertices * [0.82, 1, 0.82] + [0, 0, 0.01]
    made, said = bring(save(tight, faces), body, names, Answers(vertices=600))
    assert abs(len(made.vertices) / 600 - 1) < 0.1
    signed = igl.signed_distance(
        made.vertices.astype(float), np.asarray(body.vertices, float), np.asarray(body.faces, np.int64),
        sign_type=user_mesh.WINDING,
    )[0]  # fmt: skip
    assert signed.min() > 0.9 * dressing.CLEARANCE
    middles = made.vertices[made.faces].mean(axis=1).astype(float)
    surface = np.asarray(body.vertices, float), np.asarray(body.faces, np.int64)
    assert dressing.outward(middles, *surface)[0].min() > 0.4 * dressing.CLEARANCE
    assert any("pushed out" in line for line in said) and any("remeshed" in line for line in said)
    with pytest.raises(ValueError, match=r"inside the body, at most \d+, at \["):
        bring(save(vertices * [0.4, 1, 0.4], faces), body, names, Answers())


def test_a_second_skin_is_pushed_out(body):
    surface = np.asarray(body.vertices, float), np.asarray(body.faces, np.int64)
    trunk = np.flatnonzero(np.abs(surface[0][:, 1] - body.joints[0][1]) < 0.1)  # on the skin itself
    moved = dressing.clear_vertices(surface[0][trunk], *surface, attempts=10)
    signed = dressing.outward(moved, *surface)[0]  # but where legs or fingers leave no room
    assert signed.min() > 0 and np.mean(signed > 0.99 * dressing.CLEARANCE) > 0.98
    assert np.linalg.norm(moved - surface[0][trunk], axis=1).max() < 3 * dressing.CLEARANCE


def test_what_is_no_cloth_is_refused_by_place(skirt, body, names, save, tmp_path):
    vertices, faces = skirt
    border = boundary_mask(faces, len(vertices))
    a, b, _ = faces[np.flatnonzero(~border[faces].any(axis=1))[0]]
    fin = np.concatenate([vertices, vertices[[a]] + [0, 0, 0.05]])
    with pytest.raises(ValueError, match="1 edges have more than two faces, the first at"):
        bring(save(fin, np.concatenate([faces, [[a, b, len(vertices)]]])), body, names, Answers())
    with pytest.raises(ValueError, match=r"give --vertices"):
        bring(save(*trimesh.remesh.subdivide_loop(vertices, faces, 3)), body, names, Answers())
    path = save(*skirt)
    path.write_text(_with_nan(path.read_text()))
    with pytest.raises(ValueError, match=r"vertex 5 of \d+ is not finite"):
        bring(path, body, names, Answers())
    for name, text in {
        "empty.obj": "",
        "points.obj": "v 0 0 0\nv 1 0 0\n",
        "junk.glb": "glTF",
        "odd.xyz9": "1",
    }.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match=name):
            bring(tmp_path / name, body, names, Answers())
    with pytest.raises(ValueError, match=r"none\.obj: no such file"):
        bring(tmp_path / "none.obj", body, names, Answers())
    with pytest.raises(ValueError, match="--pin sideways"):
        bring(save(*skirt), body, names, Answers(pin="sideways"))


def _with_nan(text: str) -> str:
    lines = text.splitlines()
    fifth = [i for i, line in enumerate(lines) if line.startswith("v ")][4]
    lines[fifth] = "v nan 0.1 0.1"
    return "\n".join(lines)


def test_a_moebius_strip_is_refused(body, names, save):
    around = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    middle = body.joints[0] + 0.3 * np.stack([np.cos(around), 0 * around, np.sin(around)], axis=1)
    across = np.stack([np.cos(around) * np.cos(around / 2), np.sin(around / 2), np.sin(around) * np.cos(around / 2)], 1)
    rows = np.stack([middle - 0.05 * across, middle + 0.05 * across], axis=1).reshape(-1, 3)
    quads = []
    for i in range(60):
        a, b, c, d = 2 * i, 2 * i + 1, (2 * i + 2) % 120, (2 * i + 3) % 120
        if i == 59:
            c, d = d, c
        quads += [[a, b, c], [b, d, c]]
    with pytest.raises(ValueError, match=r"one side.*along the edge at \["):
        bring(save(rows, np.array(quads)), body, names, Answers())


def test_what_does_not_go_together_is_refused(tmp_path):
    out, mesh = tmp_path / "mine.h5", tmp_path / "mine.obj"
    for more, said in (
        ({}, "either --template or --mesh"),
        ({"template": "skirt", "mesh": mesh}, "either --template or --mesh"),
        ({"template": "skirt", "pin": "red"}, "--pin is an option of --mesh"),
        ({"template": "skirt", "loose": False}, "--loose is an option of --mesh"),
        ({"template": "skirt", "outer": True}, "--outer is an option of --mesh"),
        ({"template": "skirt", "vertices": 0}, "--vertices 0: 100 to 20000"),
    ):
        with pytest.raises(ValueError, match=said):
            garment.main(garment.Arguments(out, **more))
    assert not out.exists()


def test_the_program_writes_a_garment_and_its_picture(skirt, body, save, tmp_path, capsys):
    path = save(100 * skirt[0], skirt[1])
    garment.main(garment.Arguments(tmp_path / "mine.h5", mesh=path, units="cm", pin="highest"))
    assert storage.load_garment(tmp_path / "mine.h5", body).pinned.sum() > 20
    assert (tmp_path / "mine.garment.png").stat().st_size > 1e4 and "openings" in capsys.readouterr().out


def seamed(skirt, fronts=20, backs=20, gap=0.0, both=True):
    """A skirt of a front and a back with a number of vertices along their side seams, both or one of them open."""
    vertices, _ = skirt
    top, low = vertices[:, 1].max(), vertices[:, 1].min()
    rows = []
    for start, count in ((0.0, fronts), (np.pi, backs)):
        around, height = np.meshgrid(np.linspace(start, start + np.pi, 17), np.linspace(top, low, count), indexing="ij")
        wide = 0.24 + 0.3 * (top - height)
        side = np.sign(np.sin(start + 1.0)) * 0.5 * gap * (1.0 if both else (1 - np.cos(around)) / 2)
        points = np.stack([wide * np.cos(around), height, 0.8 * wide * np.sin(around) + side], axis=-1)
        number = np.arange(17 * count).reshape(17, count)
        a, b, c, d = (
            number[x, y].reshape(-1) for x in (slice(-1), slice(1, None)) for y in (slice(-1), slice(1, None))
        )
        rows.append((points.reshape(-1, 3), np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])))
    (front, one), (back, other) = rows
    return np.concatenate([front, back]), np.concatenate([one, other + len(front)])


def test_a_seam_whose_sides_have_other_vertices_is_sewn(skirt, body, names, save):
    made, said = bring(save(*seamed(skirt, 20, 39)), body, names, Answers(pin="highest"))
    assert any(line.startswith("sewn: 38 vertices lay on edges") for line in said)
    assert made.pinned.sum() == 32 and np.ptp(made.vertices[made.pinned, 1]) < 0.03
    assert any("1 part, 2 openings" in line for line in said)


def test_a_seam_that_is_open_is_refused_or_sewn(skirt, body, names, save):
    path = save(*seamed(skirt, gap=5e-4))
    with pytest.raises(ValueError, match=r"two borders run 0\.5 mm beside each other, as at .*--sew 1 sews it"):
        bring(path, body, names, Answers())
    made, said = bring(path, body, names, Answers(pin="highest", sew=1.0))
    assert made.pinned.sum() == 32 and any("1 part, 2 openings" in line for line in said)
    _, said = bring(path, body, names, Answers(allow=True))
    assert any("2 parts, 2 openings" in line for line in said)


@pytest.mark.parametrize("gap", [3e-3, 4.5e-3])
def test_borders_farther_apart_than_a_seam_are_told(gap, skirt, body, names, save):
    path = save(*seamed(skirt, gap=gap))
    made, said = bring(path, body, names, Answers(loose=False))
    (line,) = [line for line in said if "beside each other" in line]
    assert f"{1e3 * gap:.1f} mm" in line and "stay open" in line and f"--sew {int(1e3 * gap) + 1} sews" in line
    assert any("2 parts, 2 openings" in line for line in said)
    place = np.array(re.search(r"as at \[(.*)\] m", line)[1].split(), float)
    border = made.vertices[boundary_mask(made.faces, len(made.vertices))]
    seam = border[np.abs(border[:, 2]) < 0.6 * gap]  # its two sides are at the middle of left and right
    assert nearest(place[None], seam)[0] < 0.02


def test_a_seam_of_one_border_with_itself_is_noticed(skirt, body, names, save):
    """A tube that is cut once has one border: down one side of the seam and up the other."""
    path = save(*seamed(skirt, gap=5e-4, both=False))
    with pytest.raises(ValueError, match=r"beside each other, as at .*--sew 1 sews it"):
        bring(path, body, names, Answers())
    _, said = bring(path, body, names, Answers(sew=1.0))
    assert any("1 part, 2 openings" in line for line in said)


@pytest.mark.parametrize("fronts, backs, gap", [(20, 39, 5e-4), (5, 150, 0.0)])
def test_sides_of_a_seam_may_have_very_different_vertices(fronts, backs, gap, skirt, body, names, save):
    made, said = bring(save(*seamed(skirt, fronts, backs, gap)), body, names, Answers(pin="highest", sew=1.0))
    assert any("1 part, 2 openings" in line for line in said) and made.pinned.sum() == 32
    assert "sewn: 2 pieces along 2 seams" in said


def test_what_is_marked_is_pinned_after_a_seam_is_sewn(skirt, body, names, save):
    vertices, faces = seamed(skirt, gap=5e-4)
    top = vertices[:, 1] > vertices[:, 1].max() - 1e-6
    colours = np.where(top[:, None], [255, 0, 0, 255], [255, 255, 255, 255]).astype(np.uint8)
    path = save(vertices, faces, "painted.ply", colours)
    answers = Answers(pin="red", sew=1.0, cloth=("red=2,3,4",))
    made, _ = bring(path, body, names, answers)
    high = made.vertices[:, 1] > vertices[:, 1].max() - 0.01
    np.testing.assert_array_equal(made.pinned, high)
    np.testing.assert_array_equal((made.cloth == [2, 3, 4]).all(axis=1), high)


def test_an_open_front_is_pinned_above_a_height(skirt, body, names, save):
    vertices, faces = seamed(skirt)
    coat = faces[:, 0] < 17 * 20 - 40  # without a strip along one seam, from top to hem
    path = save(vertices, faces[coat | (faces[:, 0] >= 17 * 20)])
    top = vertices[:, 1].max()
    with pytest.raises(ValueError, match=r"highest border runs from .* as of an open front.*--pin above:"):
        bring(path, body, names, Answers(pin="highest"))
    made, _ = bring(path, body, names, Answers(pin=f"above:{top - 0.02}"))
    assert made.pinned.sum() > 20 and made.vertices[made.pinned, 1].min() > top - 0.03
    for wrong, told in ((f"above:{top + 1}", "no border is above"), ("above:neck", "give a height in m")):
        with pytest.raises(ValueError, match=told):
            bring(path, body, names, Answers(pin=wrong))


def test_where_it_is_worn_is_told(skirt, body):
    vertices, faces = skirt
    for shift, told in (
        ((0, 0.04, 0), r"worn from 0\.\d\d to 1\.\d\d m above the soles, at -0\.\d\d to 0\.\d\d m$"),
        ((0, 0, 0.6), "goes around no part of the body: is it worn elsewhere"),
        ((0, -0.9, 0), "reaches below the soles: is it worn elsewhere"),
    ):
        assert re.search(told, placement.worn(vertices + np.array(shift), faces, body))


@pytest.mark.parametrize("axis", ["x", "-x", "-y", "z", "-z"])
@pytest.mark.parametrize("turn", [0, 90, 180])
def test_any_quarter_turn_is_found(axis, turn, shirt, body, names, save):
    """What the message proposes puts a shirt back, however it is turned."""
    vertices, faces = shirt
    about = Rotation.from_euler("y", -turn, degrees=True).as_matrix()
    path = save(vertices @ about.T @ placement.TO_Y_UP[axis], faces)
    with pytest.raises(ValueError, match=f"--units m --up {axis}" + f" --turn {turn}" * bool(turn) + r"\?"):
        bring(path, body, names, Answers())
    made, _ = bring(path, body, names, Answers(Placement("m", axis, turn=turn)))
    assert nearest(made.vertices, vertices).max() < 1e-4


def test_a_garment_that_is_pushed_a_little_is_told_a_better_place(body, names, save):
    made = storage.load_garment("pants_1000", body)
    vertices, faces = np.asarray(made.vertices, np.float64), np.asarray(made.faces)
    _, said = bring(save(vertices - np.array([0, 0.05, 0]), faces), body, names, Answers())
    assert "It would be nearer with --shift 0.00 0.05 0.00" in said
    assert not any("nearer" in line for line in bring(save(vertices, faces), body, names, Answers())[1])


@pytest.fixture(scope="module")
def shirt(body):
    made = storage.load_garment("tshirt_1000", body)
    return np.asarray(made.vertices, np.float64), np.asarray(made.faces, np.int64)


@pytest.mark.parametrize(
    "turn, shift, flag",
    [(0, (0, -0.3, 0), "--shift 0.00 0.30 0.00"), (0, (0.1, 0, 0), "--shift -0.10 0.00 0.00"),
     (90, (0, 0, 0), "--turn 270")],
)  # fmt: skip
def test_a_garment_that_is_worn_elsewhere_is_refused_with_the_place(turn, shift, flag, shirt, body, names, save):
    vertices, faces = shirt
    moved = vertices @ Rotation.from_euler("y", turn, degrees=True).as_matrix().T + np.array(shift)
    path = save(moved, faces)
    with pytest.raises(ValueError, match=rf"{flag}; --allow takes it as it is"):
        bring(path, body, names, Answers())
    words = flag.split()
    place = Placement(turn=float(words[1])) if "turn" in flag else Placement(shift=tuple(map(float, words[1:])))
    made, _ = bring(path, body, names, Answers(place))
    assert nearest(made.vertices, vertices).max() < 1e-3


def test_a_file_with_the_body_in_it_asks_for_the_garment(skirt, body, names, tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.Trimesh(*skirt, process=False), geom_name="skirt", node_name="skirt")
    figure = trimesh.Trimesh(np.asarray(body.vertices), np.asarray(body.faces), process=False)
    scene.add_geometry(figure, geom_name="Figure", node_name="Figure")
    scene.export(tmp_path / "dressed.glb")
    with pytest.raises(ValueError, match=r"object 'Figure' is the body itself.*--object skirt"):
        bring(tmp_path / "dressed.glb", body, names, Answers())
    made, _ = bring(tmp_path / "dressed.glb", body, names, Answers(objects=("skirt",)))
    assert len(made.vertices) == len(skirt[0])
    with pytest.raises(ValueError, match=r"no object 'hat'; there are"):
        bring(tmp_path / "dressed.glb", body, names, Answers(objects=("hat",)))


@pytest.mark.parametrize("hem", [0.6, 1.0])
def test_a_gown_is_worn_though_its_hem_is_far_from_the_body(hem, body, names, save):
    angle, rows = 2 * np.pi * np.arange(60) / 60, np.linspace(0, 1, 25)
    radius = 0.24 + (hem - 0.24) * rows
    points = np.stack([
        radius[:, None] * np.cos(angle), np.broadcast_to(0.1 - 1.0 * rows[:, None], (25, 60)),
        radius[:, None] * np.sin(angle),
    ], axis=-1).reshape(-1, 3)  # fmt: skip
    at = np.arange(25 * 60).reshape(25, 60)
    a, b, c, d = at[:-1], np.roll(at[:-1], -1, 1), at[1:], np.roll(at[1:], -1, 1)
    faces = np.stack([np.stack(corners, -1) for corners in ((a, b, d), (a, d, c))]).reshape(-1, 3)
    made, _ = bring(save(points, faces), body, names, Answers(pin="highest", loose=False))
    np.testing.assert_allclose(made.vertices, points, atol=2e-3)


@pytest.mark.parametrize("wide, asked", [(1.0, False), (1.6, True)])
def test_a_garment_far_from_the_body_is_asked_about(wide, asked, body, names, tmp_path):
    skirt = storage.load_garment("skirt_1000", body)
    middle = skirt.vertices.mean(axis=0)
    trimesh.Trimesh(middle + (skirt.vertices - middle) * [wide, 1, wide], skirt.faces, process=False).export(
        tmp_path / "skirt.obj"
    )
    _, log = bring(tmp_path / "skirt.obj", body, names, Answers(pin="highest"))
    assert any("in the middle" in line and "is it worn elsewhere?" in line for line in log) == asked


def test_the_unit_alone_is_proposed_where_it_may_be_what_is_wrong(body, names, tmp_path):
    """Of a skirt beside the body: lying on its side it would be as near to it."""
    skirt = storage.load_garment("skirt_1000", body)
    trimesh.Trimesh(100 * (skirt.vertices - [0.2, 0, 0]), skirt.faces, process=False).export(tmp_path / "skirt.obj")
    with pytest.raises(ValueError, match=r"Is it meant to be --units cm --up y\?"):
        bring(tmp_path / "skirt.obj", body, names, Answers(pin="highest"))


@pytest.mark.parametrize("name", ["tshirt_1000", "dress_1000", "skirt_1000"])
@pytest.mark.parametrize("units, up", [("m", "y"), ("mm", "z")])
def test_a_garment_of_a_body_that_stands_on_zero_is_asked_about(name, units, up, body, names, save):
    made = storage.load_garment(name, body)
    soles = np.asarray(body.vertices)[:, 1].min()
    vertices = (np.asarray(made.vertices, np.float64) - [0, soles, 0]) @ placement.TO_Y_UP[up] / METRES[units]
    path = save(vertices, made.faces)
    with pytest.raises(ValueError, match=rf"--units {units} --up {up} --shift 0\.00 {soles:.2f} 0\.00\?"):
        bring(path, body, names, Answers())
    there, _ = bring(path, body, names, Answers(Placement(units, up, (0.0, float(soles), 0.0))))
    assert nearest(there.vertices, made.vertices).max() < 1e-4


def test_what_is_far_too_small_is_not_asked_for_the_flags_in_use(skirt, body, names, save):
    vertices, faces = skirt
    with pytest.raises(ValueError, match=r"0\.\d+ x 0\.\d+ x 0\.\d+ m, Y up: not around the body in any unit"):
        bring(save(0.05 * vertices, faces), body, names, Answers())


def test_the_body_in_the_object_of_the_garment_is_refused(body, names, save):
    figure = np.asarray(body.vertices, np.float64), np.asarray(body.faces, np.int64)
    fine = storage.load_garment("skirt_4000", body)  # of more vertices than the body
    both = np.concatenate([figure[0], fine.vertices]), np.concatenate([figure[1], fine.faces + len(figure[0])])
    for mesh in (figure, both):
        with pytest.raises(ValueError, match=r"it holds the body itself.*delete it from the file"):
            bring(save(*mesh), body, names, Answers())


def test_panels_that_lie_flat_are_refused(skirt, body, names, save):
    """As before they are sewn: in front of the body and behind it, or beside each other on a table."""
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 20), np.linspace(-0.3, 0.1, 20), indexing="ij")
    panel = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    at = np.arange(400).reshape(20, 20)
    a, b, c, d = (at[i, j].reshape(-1) for i in (slice(-1), slice(1, None)) for j in (slice(-1), slice(1, None)))
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    for move in ([0, 0, 0.4], [0.6, 0, 0]):
        both = np.concatenate([panel - np.multiply(0.5, move), panel + np.multiply(0.5, move)])
        with pytest.raises(ValueError, match=r"skirt\.obj: 100 % of it lies in flat parts, as a sewing pattern"):
            bring(save(both, np.concatenate([faces, faces + 400])), body, names, Answers())
    edge = np.concatenate([at[0], at[-1]])  # of both panels, joined by walls
    walls = np.stack([edge[:-1], edge[1:], edge[1:] + 400], 1)
    walls = walls[np.abs(np.diff(walls[:, :2], axis=1))[:, 0] == 1]
    walls = np.concatenate([walls, np.stack([walls[:, 0], walls[:, 2], walls[:, 0] + 400], 1)])
    box = np.concatenate([panel - [0, 0, 0.2], panel + [0, 0, 0.2]])
    with pytest.raises(ValueError, match=r"skirt\.obj: 100 % of it lies in flat parts"):
        bring(save(box, np.concatenate([faces, faces + 400, walls])), body, names, Answers(pin="highest"))
    bring(save(panel - [0, 0, 0.2], faces), body, names, Answers(loose=False))  # one may be a cape
    with_patch = np.concatenate([skirt[0], 0.1 * panel + [0, 0, 0.25]])  # a label on a skirt
    bring(save(with_patch, np.concatenate([skirt[1], faces + len(skirt[0])])), body, names, Answers(loose=False))


def test_what_is_pinned_is_some_of_the_garment(skirt, body, names, tmp_path):
    vertices, faces = skirt
    scene = trimesh.Scene()
    for name, which in (("skirt", vertices), ("spare", vertices * [1.2, 1, 1.2])):
        shape = trimesh.Trimesh(which, faces, process=False)
        scene.add_geometry(shape, node_name=name, geom_name=f"mesh_of_{name}")
    scene.export(tmp_path / "two.glb")
    for pin, some in (("object:spare", "none"), ("object:skirt", "all")):
        with pytest.raises(ValueError, match=rf"two\.glb: --pin {pin} pins {some} of the garment's 1009 vertices"):
            bring(tmp_path / "two.glb", body, names, Answers(pin=pin, objects=("skirt",)))
    _, said = bring(tmp_path / "two.glb", body, names, Answers(pin="highest", allow=True, loose=False))
    assert "1 of 2 parts have no pinned vertex: nothing but the body holds them" in said
    _, said = bring(tmp_path / "two.glb", body, names, Answers(allow=True, loose=False))
    assert not any("no pinned vertex" in line for line in said)


@pytest.mark.parametrize("sew", ["-1", "nan", "51"])
def test_a_seam_is_so_wide(sew, tmp_path, skirt, save):
    with pytest.raises(ValueError, match=rf"--sew {sew}: 0 to 50 mm"):
        garment.main(garment.Arguments(tmp_path / "a.h5", mesh=save(*skirt), sew=float(sew)))
