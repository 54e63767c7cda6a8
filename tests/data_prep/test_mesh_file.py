"""Files of meshes as programs write them: what is moved, grouped, quantised or skinned comes out where it is shown."""

import base64
import json

import numpy as np
import pytest

from data_prep import gltf_file, mesh_file
from data_prep.gltf_file import DTYPES

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
PLACE = np.array([[0.0, -2, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])  # twice as large, a quarter turned


class File:
    """A glTF file in the making: one object of SQUARE, below a node that moves it."""

    def __init__(self):
        self.binary, self.views, self.accessors = b"", [], []
        self.primitive = {"attributes": {"POSITION": self.add(SQUARE.astype(np.float32))},
                          "indices": self.add(FACES.reshape(-1, 1).astype(np.uint16))}  # fmt: skip
        self.json = {
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "armature", "matrix": PLACE.T.reshape(-1).tolist(), "children": [1]},
                      {"name": "skirt", "mesh": 0}],
            "meshes": [{"name": "cloth", "primitives": [self.primitive]}],
        }  # fmt: skip

    def view(self, values, stride=None):
        size = values.dtype.itemsize * values.shape[1]
        rows = b"".join(row.tobytes() + b"\xee" * ((stride or size) - size) for row in values)
        self.views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(rows)})
        self.views[-1] |= {"byteStride": stride} if stride else {}
        self.binary += rows + b"\0" * (-len(rows) % 4)
        return len(self.views) - 1

    def add(self, values, kind=None, stride=None, **others):
        component = next(number for number, dtype in DTYPES.items() if dtype == values.dtype)
        kind = kind or {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[values.shape[1]]
        view = {"bufferView": self.view(values, stride)}
        self.accessors.append({"componentType": component, "type": kind, "count": len(values)} | view | others)
        return len(self.accessors) - 1

    def save(self, path):
        whole = self.json | {"accessors": self.accessors, "bufferViews": self.views}
        if path.suffix == ".gltf":
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.binary).decode()
            path.write_text(json.dumps(whole | {"buffers": [{"byteLength": len(self.binary), "uri": uri}]}))
            return path
        text = json.dumps(whole | {"buffers": [{"byteLength": len(self.binary)}]}).encode()
        text += b" " * (-len(text) % 4)
        chunks = len(text).to_bytes(4, "little") + b"JSON" + text
        chunks += len(self.binary).to_bytes(4, "little") + b"BIN\0" + self.binary
        path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunks)).to_bytes(4, "little") + chunks)
        return path


def moved(points):
    return points @ PLACE[:3, :3].T + PLACE[:3, 3]


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_an_object_stands_where_its_nodes_put_it(name, tmp_path):
    mesh = mesh_file.read(File().save(tmp_path / name))
    np.testing.assert_allclose(mesh.vertices, moved(SQUARE), atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, FACES)
    assert mesh.objects.keys() == {"skirt", "cloth"} and mesh.objects["skirt"].all() and not mesh.red.any()


def test_quantised_strided_and_sparse_numbers(tmp_path):
    file = File()
    short = np.round(SQUARE * 32767).astype(np.int16)
    file.primitive["attributes"]["POSITION"] = file.add(short, stride=8, normalized=True)
    file.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    np.testing.assert_allclose(mesh_file.read(file.save(tmp_path / "a.glb")).vertices, moved(SQUARE), atol=1e-6)
    indices, values = file.view(np.array([[2]], np.uint8)), file.view(np.array([[3.0, 4, 5]], np.float32))
    file.accessors.append({
        "componentType": 5126, "type": "VEC3", "count": 4,
        "sparse": {"count": 1, "indices": {"bufferView": indices, "componentType": 5121},
                   "values": {"bufferView": values}},
    })  # fmt: skip
    file.primitive["attributes"]["POSITION"] = len(file.accessors) - 1
    expected = np.zeros((4, 3))
    expected[2] = 3, 4, 5
    np.testing.assert_allclose(mesh_file.read(file.save(tmp_path / "a.glb")).vertices, moved(expected), atol=1e-6)


def test_default_morph_weights_are_applied(tmp_path):
    file = File()
    file.primitive["targets"] = [{"POSITION": file.add(np.full((4, 3), 2.0, np.float32))}]
    file.json["meshes"][0]["weights"] = [0.25]
    np.testing.assert_allclose(mesh_file.read(file.save(tmp_path / "a.glb")).vertices, moved(SQUARE + 0.5), atol=1e-6)


def test_joints_move_a_skinned_object_and_its_node_does_not(tmp_path):
    file = File()
    weights = np.array([[1.0, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [0, 1, 0, 0]], np.float32)
    joints = np.tile(np.array([[0, 1, 0, 0]], np.uint8), (4, 1))
    file.primitive["attributes"] |= {"JOINTS_0": file.add(joints), "WEIGHTS_0": file.add(weights)}
    inverse = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    inverse[1, :3, 3] = 0, -1, 0
    bound = file.add(inverse.swapaxes(1, 2).reshape(2, 16).copy())
    file.json["skins"] = [{"joints": [2, 3], "inverseBindMatrices": bound}]
    file.json["nodes"][1]["skin"] = 0
    file.json["nodes"] += [{"translation": [10, 0, 0], "children": [3]}, {"translation": [0, 1, 1]}]
    file.json["scenes"][0]["nodes"] = [0, 2]
    expected = SQUARE + [10, 0, 0] + weights[:, 1:2] * [0, 0, 1]
    np.testing.assert_allclose(mesh_file.read(file.save(tmp_path / "a.glb")).vertices, expected, atol=1e-6)


@pytest.mark.parametrize("dtype, most", [(np.float32, 1), (np.uint8, 255)])
def test_colours(dtype, most, tmp_path):
    file = File()
    colours = np.array([[1, 0, 0], [1, 1, 1], [0, 1, 0], [1, 0.1, 0.1]]) * most
    whole = file.add(colours.astype(dtype), normalized=dtype == np.uint8)
    file.primitive["attributes"]["COLOR_0"] = whole
    assert mesh_file.read(file.save(tmp_path / "a.glb")).red.tolist() == [True, False, False, True]


def test_what_is_compressed_is_refused_by_name(tmp_path):
    file = File()
    file.json["extensionsRequired"] = ["KHR_draco_mesh_compression"]
    with pytest.raises(ValueError, match=r"a\.glb: .*KHR_draco_mesh_compression.*export it without"):
        mesh_file.read(file.save(tmp_path / "a.glb"))


def test_what_would_be_left_out_is_refused(tmp_path):
    strip, far, huge = File(), File(), File()
    strip.primitive["mode"] = 5
    far.json["nodes"][1]["skin"] = 0
    far.json["skins"] = [{"joints": [2]}]
    far.json["nodes"].append({"name": "in no scene"})
    weights = np.tile(np.array([[1.0, 0, 0, 0]], np.float32), (4, 1))
    joints = far.add(np.zeros((4, 4), np.uint8))
    far.primitive["attributes"] |= {"JOINTS_0": joints, "WEIGHTS_0": far.add(weights)}
    huge.accessors[0] = {"componentType": 5126, "type": "VEC3", "count": 10**12}
    for file, told in (
        (strip, "as triangles"),
        (far, "not a mesh that can be read"),
        (huge, "1000000000000"),
    ):
        with pytest.raises(ValueError, match=rf"a\.glb: .*({told})"):
            mesh_file.read(file.save(tmp_path / "a.glb"))


def test_damaged_files_are_refused(tmp_path):
    file = File()
    whole = file.save(tmp_path / "a.glb").read_bytes()
    for cut in (3, 40, len(whole) - 30):
        (tmp_path / "b.glb").write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=r"b\.glb: "):
            mesh_file.read(tmp_path / "b.glb")
    file.json["nodes"][1]["children"] = [0]  # a circle
    with pytest.raises(ValueError, match="two parents"):
        gltf_file.Document(file.save(tmp_path / "a.glb")).places()


OBJ = """o shirt
v 0 0 0
v 1 0 0
v 1 1 0
g body
usemtl linen
f 1 2 3
g collar
v 0 1 0
f -4 -2 -1
"""


def test_groups_and_materials_are_objects_and_indices_may_count_back(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    mesh = mesh_file.read(tmp_path / "a.obj")
    triangles = {tuple(sorted(map(tuple, corners))) for corners in mesh.vertices[mesh.faces].tolist()}
    assert triangles == {((0, 0, 0), (1, 0, 0), (1, 1, 0)), ((0, 0, 0), (0, 1, 0), (1, 1, 0))}
    assert {"shirt", "body", "collar", "linen"} <= mesh.objects.keys()
    assert mesh.objects["shirt"].sum() == mesh.objects["linen"].sum() == len(mesh.vertices)
    assert mesh.vertices[mesh.objects["collar"]].tolist().count([0.0, 1.0, 0.0]) == 1
    assert mesh.objects["collar"].sum() == mesh.objects["body"].sum() == 3
