import struct

import numpy as np
import pygltflib
import pytest
import trimesh
from PIL import Image

from clothjax.render import gltf, point_cache, ray_cast, usd
from clothjax.render.performance import Part, Performance
from clothjax.render.ray_cast import Surface


def sheet(count: int = 12):
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, count), np.linspace(-0.5, 0.5, count), indexing="ij")
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    return np.stack([x, y, 0 * x], -1).reshape(-1, 3), faces


def test_what_is_in_front_hides_what_is_behind():
    vertices, faces = sheet()
    red = Surface(vertices + [0, 0, 0.01], faces, (1.0, 0.0, 0.0))
    blue = Surface(vertices - [0, 0, 0.01], faces, (0.0, 0.0, 1.0))
    camera = ray_cast.camera_for(vertices, "front")
    for order in ([red, blue], [blue, red]):
        centre = ray_cast.render(order, camera, (60, 60))[30, 30]
        assert centre[0] > 4 * centre[2].astype(int)
    centre = ray_cast.render([red, blue], ray_cast.camera_for(vertices, "back"), (60, 60))[30, 30]
    assert centre[2] > 4 * centre[0].astype(int)


def test_the_camera_frames_its_subject():
    vertices, faces = sheet()
    picture = ray_cast.render([Surface(vertices, faces)], ray_cast.camera_for(vertices, "front"), (100, 100))
    rows = np.flatnonzero((picture != picture[0, 0]).any(axis=(1, 2)))
    assert 2 <= rows[0] <= 12 and 87 <= rows[-1] <= 97


@pytest.mark.parametrize("view", ["front", "three-quarter", "side", "back"])
def test_the_camera_holds_a_wide_subject_where_it_is_told_the_aspect(view):
    vertices, faces = sheet()
    turn = {"three-quarter": 0.6, "side": np.pi / 2}.get(view, 0.0)
    wide = vertices * [1.0, 0.2, 1.0]
    wide = wide @ np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    camera = ray_cast.camera_for(wide, view, aspect=0.5)
    picture = ray_cast.render([Surface(wide, faces)], camera, (50, 100))
    assert (picture[:, [0, -1]] == picture[0, 0]).all() and (picture != picture[0, 0]).any()


def test_the_lights_go_around_with_the_camera():
    """So that a subject that turns with it looks the same."""
    vertices, faces = sheet()
    bent = vertices + [0, 0, 0.1] * np.sin(6 * vertices[:, :1])
    pictures = []
    for view, angle in (("front", 0.0), ("side", np.pi / 2)):
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        turned = bent @ turn.T
        camera = ray_cast.camera_for(turned, view)._replace(target=np.zeros(3))
        pictures.append(ray_cast.render([Surface(turned, faces)], camera, (60, 60)).astype(int))
    assert np.abs(pictures[0] - pictures[1]).mean() < 1.5 and np.ptp(pictures[0]) > 60


def test_an_unknown_view_is_refused():
    with pytest.raises(ValueError, match="view 'top' is not one of"):
        ray_cast.camera_for(np.zeros((3, 3)), "top")


def test_a_shadow_falls_on_the_floor():
    vertices, faces = sheet()
    camera = ray_cast.camera_for(np.concatenate([vertices, vertices + [0, 0, -2.0]]), "three-quarter", 2.5)
    plain = ray_cast.render([Surface(vertices + 50, faces)], camera, (80, 80), floor=-0.6).astype(int)
    dark = ray_cast.render([Surface(vertices, faces)], camera, (80, 80), floor=-0.6).astype(int)
    below = (plain.sum(-1) - dark.sum(-1))[60:]
    assert (below > 60).any()


def test_a_valley_is_darker_than_a_plain_and_a_far_wall_hides_nothing():
    vertices, faces = sheet(40)
    camera = ray_cast.camera_for(vertices, "front")

    def middle(*others):
        return ray_cast.render([Surface(vertices, faces), *others], camera, (60, 60))[20:40, 30].astype(int).sum()

    # walls at right angles beside the middle, edge-on to the camera, on the side that the key light does not come from
    wall = vertices[:, [2, 1, 0]]
    near, far = (Surface(wall + [-x, 0, 0.5], faces) for x in (0.06, 0.3))
    assert middle(near) < 0.93 * middle() and middle(far) == middle()


def test_each_side_of_a_sheet_has_its_own_sky():
    """A wall behind it hides the sky of its back alone."""
    vertices, faces = sheet(40)
    wall = Surface(vertices[:, [2, 1, 0]] + [0.06, 0, -0.5], faces)

    def middle(view, *others):
        camera = ray_cast.camera_for(vertices, view)
        return ray_cast.render([Surface(vertices, faces), *others], camera, (60, 60))[20:40, 30].astype(int).sum()

    assert middle("front", wall) == middle("front") and middle("back", wall) < 0.93 * middle("back")


def test_a_check_has_fields_of_one_size_on_the_cloth_at_rest():
    vertices, faces = sheet(40)
    camera = ray_cast.camera_for(vertices, "front")
    for stretch, count in ((1.0, 40), (2.0, 20)):  # what is shown twice as large as it is at rest has half the fields
        checked = Surface(vertices, faces, checked=vertices / stretch + 1e-4)
        row = ray_cast.render([checked], camera, (400, 400), samples=1)[203, :, 2].astype(int)
        inside = row[30:370]
        changes = np.count_nonzero(np.abs(np.diff(inside)) > 15)
        assert count * 0.75 <= changes <= count


def test_pictures_beside_each_other_keep_their_order_and_have_names():
    first, second = (np.full((60, 80, 3), grey, np.uint8) for grey in (200, 100))
    both = ray_cast.beside({"Psi": first, "solver": second})
    assert both.shape == (60, 160, 3)
    np.testing.assert_array_equal(both[40:, :80], first[40:])
    np.testing.assert_array_equal(both[40:, 80:], second[40:])
    assert (both[:40, :80] == 0).any() and (both[:40, 80:] == 0).any()


def test_comparison_and_webp_hold_every_picture(tmp_path):
    pictures = [np.full((20, 30, 3), 40 * k, np.uint8) for k in range(4)]
    ray_cast.comparison(tmp_path / "c.png", {"one": pictures[:2], "two": pictures[2:]}, ["a", "b"])
    sheet_picture = np.asarray(Image.open(tmp_path / "c.png"))
    assert all((sheet_picture == 40 * k).all(-1).sum() >= 20 * 30 for k in range(4))
    ray_cast.webp(tmp_path / "w.webp", pictures, 30)
    with Image.open(tmp_path / "w.webp") as film:
        assert film.n_frames == 4


@pytest.fixture
def flag():
    """A waving sheet before a nearly still one, both moving along x."""
    vertices, faces = sheet()
    time = np.linspace(0, 2 * np.pi, 20)[:, None, None]
    waving = vertices + np.array([0, 0, 0.1]) * np.sin(time + 4 * vertices[:, :1])
    still = np.repeat(vertices[None] - [0, 0, 0.5], 20, axis=0) + 1e-3 * np.sin(time)
    root = np.stack([np.linspace(0, 1, 20), np.zeros(20), np.zeros(20)], -1)
    parts = (Part("body", still, faces, ray_cast.SKIN), Part("garment", waving, faces, ray_cast.CLOTH))
    return Performance(parts, root, 30.0)


def test_glb_holds_the_animation(tmp_path, flag):
    waving, path = flag.parts[1].vertices, tmp_path / "g.glb"
    errors = gltf.to_glb(path, flag)
    assert max(errors.values()) <= 1e-3
    document = pygltflib.GLTF2().load(str(path))
    blob = document.binary_blob()

    def read(index):
        accessor = document.accessors[index]
        view = document.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3}[accessor.type]
        kind = {5126: np.float32, 5125: np.uint32}[accessor.componentType]
        assert view.byteOffset % 4 == 0
        return np.frombuffer(blob, kind, accessor.count * width, view.byteOffset).reshape(-1, width)

    mesh = document.meshes[1]
    primitive = mesh.primitives[0]
    targets = np.stack([read(target["POSITION"]) for target in primitive.targets])
    channel = next(c for c in document.animations[0].channels if c.target.node == 1 and c.target.path == "weights")
    weights = read(document.animations[0].samplers[channel.sampler].output).reshape(20, len(targets))
    rebuilt = read(primitive.attributes.POSITION) + np.einsum("tk,kvc->tvc", weights, targets)
    np.testing.assert_allclose(rebuilt, waving, atol=1.1e-3)
    assert len(trimesh.load(path).geometry) == 2


@pytest.mark.slow
def test_the_khronos_validator_finds_nothing(tmp_path, flag, khronos):
    gltf.to_glb(tmp_path / "g.glb", flag)
    issues = khronos(tmp_path / "g.glb")
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"][:5]


def test_usd_holds_the_animation(tmp_path, flag):
    from pxr import Usd, UsdGeom

    for name in ("c.usdc", "c.usda"):
        usd.to_usd(tmp_path / name, flag)
        stage = Usd.Stage.Open(str(tmp_path / name))
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 19, 30)
        assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
        for part in flag.parts:
            mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/character/{part.name}"))
            assert UsdGeom.Mesh.ValidateTopology(
                mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), part.vertices.shape[1]
            )[0]
            np.testing.assert_array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), part.faces)
            for t in (0, 7, 19):
                place = np.array(UsdGeom.XformCache(t).GetLocalToWorldTransform(mesh.GetPrim()))
                points = np.array(mesh.GetPointsAttr().Get(t)) @ place[:3, :3] + place[3, :3]
                np.testing.assert_allclose(points, flag.placed(part)[t], atol=1e-6)
                normals = np.array(mesh.GetNormalsAttr().Get(t))
                np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
                low, high = np.array(mesh.GetExtentAttr().Get(t))
                np.testing.assert_allclose([low, high], [part.vertices[t].min(0), part.vertices[t].max(0)], atol=1e-6)


def test_point_caches_hold_the_garment_in_the_world(tmp_path, flag):
    expected = flag.placed(flag.parts[1])
    count = expected.shape[1]
    point_cache.to_pc2(tmp_path / "g.pc2", flag)
    data = (tmp_path / "g.pc2").read_bytes()
    assert struct.unpack("<12siiffi", data[:32]) == (b"POINTCACHE2\0", 1, count, 0.0, 1.0, 20)
    np.testing.assert_array_equal(np.frombuffer(data[32:], "<f4").reshape(20, count, 3), expected)
    point_cache.to_mdd(tmp_path / "g.mdd", flag)
    data = (tmp_path / "g.mdd").read_bytes()
    assert struct.unpack(">ii", data[:8]) == (20, count)
    np.testing.assert_allclose(struct.unpack(">20f", data[8:88]), np.arange(20) / 30, rtol=1e-6)
    np.testing.assert_array_equal(np.frombuffer(data[88:], ">f4").reshape(20, count, 3), expected)
    mesh = trimesh.load(tmp_path / "g_mesh.obj", process=False)
    np.testing.assert_allclose(mesh.vertices, expected[0], atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, flag.parts[1].faces)


def test_obj_has_a_file_for_every_frame(tmp_path, flag):
    point_cache.to_obj(tmp_path / "c.obj", flag)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"c_{t:04d}.obj" for t in range(20)]
    scene = trimesh.load(tmp_path / "c_0007.obj", process=False, split_objects=True)
    assert scene.geometry.keys() == {"body", "garment"}
    for part in flag.parts:
        np.testing.assert_allclose(scene.geometry[part.name].vertices, flag.placed(part)[7], atol=1e-6)


def test_mp4_plays_what_was_drawn(tmp_path):
    import av

    pictures = [np.full((48, 64, 3), 20 * k, np.uint8) for k in range(12)]
    ray_cast.mp4(tmp_path / "f.mp4", pictures, 30.0)
    with av.open(str(tmp_path / "f.mp4")) as film:
        assert float(film.streams.video[0].average_rate) == 30
        found = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(found) == 12
    for picture, frame in zip(pictures, found, strict=True):
        assert frame.shape == picture.shape and np.abs(frame.astype(int) - picture).max() <= 6
