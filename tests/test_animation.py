import numpy as np
import pygltflib
import pytest
import trimesh
from PIL import Image

from clothjax import animation
from clothjax.animation import Surface
from clothjax.export import gltf


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
    camera = animation.camera_for(vertices, "front")
    for order in ([red, blue], [blue, red]):
        centre = animation.render(order, camera, (60, 60))[30, 30]
        assert centre[0] > 4 * centre[2].astype(int)
    centre = animation.render([red, blue], animation.camera_for(vertices, "back"), (60, 60))[30, 30]
    assert centre[2] > 4 * centre[0].astype(int)


def test_the_camera_frames_its_subject():
    vertices, faces = sheet()
    picture = animation.render([Surface(vertices, faces)], animation.camera_for(vertices, "front"), (100, 100))
    rows = np.flatnonzero((picture != picture[0, 0]).any(axis=(1, 2)))
    assert 2 <= rows[0] <= 12 and 87 <= rows[-1] <= 97


def test_an_unknown_view_is_refused():
    with pytest.raises(ValueError, match="view 'top' is not one of"):
        animation.camera_for(np.zeros((3, 3)), "top")


def test_a_shadow_falls_on_the_floor():
    vertices, faces = sheet()
    camera = animation.camera_for(np.concatenate([vertices, vertices + [0, 0, -2.0]]), "three-quarter", 2.5)
    plain = animation.render([Surface(vertices + 50, faces)], camera, (80, 80), floor=-0.6).astype(int)
    dark = animation.render([Surface(vertices, faces)], camera, (80, 80), floor=-0.6).astype(int)
    below = (plain.sum(-1) - dark.sum(-1))[60:]
    assert (below > 60).any()


def test_comparison_and_webp_hold_every_picture(tmp_path):
    pictures = [np.full((20, 30, 3), 40 * k, np.uint8) for k in range(4)]
    animation.comparison(tmp_path / "c.png", {"one": pictures[:2], "two": pictures[2:]}, ["a", "b"])
    sheet_picture = np.asarray(Image.open(tmp_path / "c.png"))
    assert all((sheet_picture == 40 * k).all(-1).sum() >= 20 * 30 for k in range(4))
    animation.webp(tmp_path / "w.webp", pictures, 30)
    assert Image.open(tmp_path / "w.webp").n_frames == 4


def test_glb_holds_the_animation(tmp_path):
    vertices, faces = sheet()
    time = np.linspace(0, 2 * np.pi, 20)[:, None, None]
    waving = vertices + np.array([0, 0, 0.1]) * np.sin(time + 4 * vertices[:, :1])
    still = np.repeat(vertices[None] - [0, 0, 0.5], 20, axis=0) + 1e-3 * np.sin(time)
    root = np.stack([np.linspace(0, 1, 20), np.zeros(20), np.zeros(20)], -1)
    path = tmp_path / "g.glb"
    errors = gltf.to_glb(path, waving, faces, still, faces, root, 30.0)
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
