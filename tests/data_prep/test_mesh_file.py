"""Files of meshes as programs write them: what is moved, grouped, quantised or skinned comes out where it is shown."""

import base64
import inspect
import json
import re

import numpy as np
import pytest
import samples

from data_prep import garment, gltf_file, mesh_file, polygon_file
from data_prep.gltf_file import DTYPES

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]])
PLACE = np.array([[0.0, -2, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])  # twice as large, a quarter turned


def test_the_endings_are_the_same_wherever_they_are_told():
    table = (samples.ROOT / "data_prep" / "README.md").read_text()
    (told,) = re.findall(r"\| `garment` \| a mesh (\(.*?\))", table)
    assert told in inspect.getsource(garment) and told in mesh_file.read.__doc__


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
        (far, "joint 'in no scene' of a skin is not in the scene"),
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


def area(mesh):
    a, b, c = mesh.vertices[mesh.faces].swapaxes(0, 1)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


# an L of three squares; its corners in turn are also those of a fan that folds over
L = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]])


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply"])
def test_concave_polygons_are_cut_without_folds(first, suffix, tmp_path):
    corners = [(first + k) % 6 for k in range(6)]
    rows = "\n".join(" ".join(map(str, row)) for row in L)
    text = {
        ".obj": "\n".join(f"v {row}" for row in rows.splitlines()) + "\nf " + " ".join(str(c + 1) for c in corners),
        ".off": f"OFF\n6 1 0\n{rows}\n6 " + " ".join(map(str, corners)),
        ".ply": "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face 1\nproperty list uchar int vertex_index\nend_header\n{rows}\n6 " + " ".join(map(str, corners)),
    }[suffix]
    (tmp_path / f"a{suffix}").write_text(text)
    mesh = mesh_file.read(tmp_path / f"a{suffix}")
    assert len(mesh.faces) == 4
    np.testing.assert_allclose(area(mesh), 3.0, rtol=1e-12)


def test_triangles_of_any_polygon_cover_it_once():
    """Stars of random radii, turned in space, some corners on the line between others."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        count = int(rng.integers(4, 12))
        angle = np.sort(rng.uniform(0, 2 * np.pi, count))
        if np.diff(angle, append=angle[0] + 2 * np.pi).max() > 3.0:
            continue  # the middle is outside
        flat = rng.uniform(0.3, 1.0, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        middle = (flat + np.roll(flat, -1, axis=0)) / 2
        flat = np.stack([flat, middle], axis=1).reshape(-1, 2) if rng.random() < 0.3 else flat
        x, y = flat.T
        true = 0.5 * abs(x @ np.roll(y, -1) - y @ np.roll(x, -1))
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        points = np.pad(flat, ((0, 0), (0, 1))) @ turn.T
        faces = polygon_file.triangles(points, [list(range(len(points)))])
        assert len(faces) == len(points) - 2
        a, b, c = points[faces].swapaxes(0, 1)
        sizes = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        np.testing.assert_allclose(sizes.sum(), true, rtol=1e-9)


@pytest.mark.parametrize("first", range(6))
def test_no_triangle_is_a_line_where_corners_lie_on_a_side(first):
    """Such a triangle would be left out, and its long side would have other ends than those of the faces beside it."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [1, 1, 0], [0, 1, 0]])
    a, b, c = points[polygon_file.triangles(points, [[(first + k) % 6 for k in range(6)]])].swapaxes(0, 1)
    assert (np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0.5).all()


def test_a_text_that_is_cut_short_is_refused(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(header + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(ValueError, match=r"a\.ply: .*cut short: face 1 of 2"):
        mesh_file.read(tmp_path / "a.ply")
    (tmp_path / "a.off").write_text("OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    with pytest.raises(ValueError, match=r"a\.off: .*cut short: 4 lines for 3 vertices and 2 faces"):
        mesh_file.read(tmp_path / "a.off")


@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_polygons_of_any_size_and_type(order, tmp_path):
    kind = "little" if order == "<" else "big"
    header = f"ply\nformat binary_{kind}_endian 1.0\nelement vertex 5\nproperty double x\nproperty double y\n"
    header += "property double z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement edge 1\n"
    header += "property int vertex1\nproperty int vertex2\nelement face 2\nproperty list ushort ushort vertex_index\n"
    header += "property uchar flags\nend_header\n"
    rows = np.zeros(5, np.dtype([("at", f"{order}f8", 3), ("colour", "u1", 3)]))
    rows["at"] = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.5, 0]]
    rows["colour"] = [[200, 10, 10]] + 4 * [[10, 10, 10]]
    body = rows.tobytes() + np.array([0, 1], f"{order}i4").tobytes()
    for corners in ([0, 1, 2, 3], [1, 4, 2]):
        body += np.array([len(corners), *corners], f"{order}u2").tobytes() + b"\7"
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    mesh = mesh_file.read(tmp_path / "a.ply")
    assert len(mesh.faces) == 3 and area(mesh) == pytest.approx(1.5)
    assert mesh.vertices[mesh.red].tolist() == [[0, 0, 0]]
    (tmp_path / "a.ply").write_bytes(header.encode() + body[:-3])
    with pytest.raises(ValueError, match=r"cut short: face 1 of 2"):
        mesh_file.read(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-8-sig"])
def test_an_obj_file_as_programs_write_it(encoding, tmp_path):
    """Tabs, indents, colours of some vertices, faces in two groups, a line that goes on, vertices without a face."""
    text = "v\t0 0 0 200 10 10\n  v 1 0 0\nv 1 1 0\nv 0 1 0\nv 9 9 9\ng waist skirt\n\tf 1/1 2/1 \\\n 3/1\nf 1 3 4\n"
    (tmp_path / "a.obj").write_text(text, encoding=encoding)
    mesh = mesh_file.read(tmp_path / "a.obj")
    assert len(mesh.vertices) == 4 and area(mesh) == pytest.approx(1.0)
    assert mesh.objects["waist"].all() and mesh.objects["skirt"].all()
    assert mesh.vertices[mesh.red].tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("text", [
    "OFF # a mesh\n4 2 # counts\n# points\n0 0 0\n1 0 0 # x\n1 1 0\n0 1 0\n3 0 1 2\n2 0 1\n",
    "4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 255 0 0\n",
])  # fmt: skip
def test_off_files_as_programs_write_them(text, tmp_path):
    (tmp_path / "a.off").write_text(text)
    mesh = mesh_file.read(tmp_path / "a.off")
    assert mesh.faces.shape == (1, 3) and area(mesh) == pytest.approx(0.5)


@pytest.mark.parametrize("suffix, text, told", [
    (".off", "OFF BINARY\n\0\0", "export it as text"),
    (".ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n0\n", "numbers of type half"),
    (".ply", "ply\nformat ascii 1.0\nelement vertex 1\nproperty float X\nend_header\n0\n", "no x, y and z"),
    (".obj", "v 0 0 0 # here\nv 1 0 0\n# there \\\nv 0 1 0\nf 1 2 3 4 # four\n", "names vertex 4 of 3"),
])  # fmt: skip
def test_what_another_program_means_is_named(suffix, text, told, tmp_path):
    (tmp_path / f"a{suffix}").write_text(text)
    with pytest.raises(ValueError, match=rf"a\{suffix}: .*{told}"):
        mesh_file.read(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("most", [1.0, 255])
def test_colours_of_an_off_file(most, tmp_path):
    colours = [[most, 0, 0, most], [most, most, most, most], [0, 0, 0, most]]
    rows = [" ".join(map(str, (*point, *colour))) for point, colour in zip(SQUARE, colours)]
    (tmp_path / "a.off").write_text("\n".join(["COFF", "3 1 0", *rows, "3 0 1 2"]))
    mesh = mesh_file.read(tmp_path / "a.off")
    assert mesh.red.tolist() == [True, False, False]
    np.testing.assert_array_equal(mesh.vertices, SQUARE[:3])


@pytest.mark.parametrize("line, told", [
    ("f 0 1 2", "line 4: a face names vertex 0, but OBJ counts from 1"),
    ("v 0,5 0 0", "line 4: '0,5 0 0' should be numbers with a point in place of the comma"),
    ("f 1 2 x", "line 4: 'x' names no vertex"),
    ("f 1 2 4", "a face names vertex 4 of 3"),
    ("f -1 -2 -4", "a face names vertex 0 of 3"),
    ("v 1 2", "line 4: a vertex of 2 numbers"),
])  # fmt: skip
def test_a_line_that_is_wrong_is_named(line, told, tmp_path):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{line}\n")
    with pytest.raises(ValueError, match=rf"a\.obj: .*{told}"):
        mesh_file.read(tmp_path / "a.obj")


def test_what_is_not_as_the_scene_shows_it_is_refused_or_told(tmp_path):
    copies, absent, old, posed = File(), File(), File(), File()
    copies.json["nodes"][1]["extensions"] = {gltf_file.COPIES: {}}
    absent.json["scenes"][0]["nodes"] = []
    old.json["asset"]["version"] = "1.0"
    for file, told in (
        (copies, "copies of one object"),
        (absent, r"its objects \(skirt\) are not in its scene"),
        (old, r"glTF of version 1\.0"),
    ):
        with pytest.raises(ValueError, match=rf"a\.glb: .*{told}"):
            mesh_file.read(file.save(tmp_path / "a.glb"))
    weights = np.array([[1.0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0]], np.float32)
    joints = np.tile(np.array([[0, 1, 0, 0]], np.uint8), (4, 1))
    posed.primitive["attributes"] |= {"JOINTS_0": posed.add(joints), "WEIGHTS_0": posed.add(weights)}
    posed.json["skins"] = [{"joints": [2, 3]}]
    posed.json["nodes"][1]["skin"] = 0
    turned = [0.0, 0.0, np.sin(np.radians(5.0)), np.cos(np.radians(5.0))]
    posed.json["nodes"] += [{"rotation": turned, "children": [3]}, {}]
    posed.json["scenes"][0]["nodes"] = [0, 2]
    assert not mesh_file.read(posed.save(tmp_path / "a.glb")).notes  # as a whole
    posed.json["nodes"][3]["rotation"] = turned
    (note,) = mesh_file.read(posed.save(tmp_path / "a.glb")).notes
    assert "10 degrees from the pose that it was bound in" in note
    posed.primitive["attributes"]["WEIGHTS_0"] = posed.add(weights * np.array([[1], [1], [1], [0]], np.float32))
    with pytest.raises(ValueError, match=r"a\.glb: .*1 vertices of skirt cloth follow no joint"):
        mesh_file.read(posed.save(tmp_path / "a.glb"))


def test_colours_of_gltf_are_linear(tmp_path):
    file = File()
    shown = np.array([[200, 10, 10], [180, 120, 120], [255, 90, 90], [120, 10, 10]]) / 255
    file.primitive["attributes"]["COLOR_0"] = file.add((shown**2.2).astype(np.float32))
    assert mesh_file.read(file.save(tmp_path / "a.glb")).red.tolist() == [True, False, True, False]
