"""A rigged character in a glTF file becomes a body, and its animations motions, whatever program it is from."""

import copy
import json
import re

import h5py
import igl
import numpy as np
import pytest
import rigged
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from clothjax.body.plausibility import joint_positions
from clothjax.files import storage
from data_prep import character, gltf, gltf_file, gltf_motion, procedural, retarget, skeleton, templates, wrap

QUARTER = Rotation.from_euler("x", -90, degrees=True).as_matrix()
HALF = np.diag([-1.0, 1.0, -1.0])


@pytest.fixture(scope="module")
def rig():
    return storage.load_rig("body")


@pytest.fixture(scope="module")
def walk(rig):
    clip = storage.load_motion("walk_3", rig.names)
    return clip._replace(rotations=clip.rotations[:40], translation=clip.translation[:40])


@pytest.fixture(scope="module")
def axes(rig):
    return Rotation.random(len(rig.names), rng=np.random.default_rng(0)).as_matrix()


def dialect(name, rig, axes):
    """Return the names of the joints and what else is written."""
    numbered = tuple(f"Bone.{j:03}" for j in range(len(rig.names)))
    bones = [{"bone": bone, "node": rig.names.index(joint)} for joint, bone in rigged.VRM.items()]
    new = {bone["bone"]: {"node": bone["node"]} for bone in bones}
    return {
        "ours": (rig.names, {}),
        "mixamo": (
            tuple(f"mixamorig:{rigged.MIXAMO.get(joint, joint)}" for joint in rig.names),
            {"axes": axes, "armature": (np.eye(3), 0.01)},
        ),
        "unreal": (
            tuple(rigged.UNREAL.get(joint, joint) for joint in rig.names),
            {"axes": axes, "unit": 0.01, "armature": (QUARTER, 1.0), "ends": True, "carriers": 3},
        ),
        "vrm 0": (
            numbered,
            {"turn": HALF, "extensions": {"VRM": {"humanoid": {"humanBones": bones}}}},
        ),
        "vrm 1": (numbered, {"axes": axes, "extensions": {"VRMC_vrm": {"humanoid": {"humanBones": new}}}}),
        "z up": (rig.names, {"turn": QUARTER.T, "axes": axes}),
        "no skin": (rig.names, {"axes": axes, "armature": (np.eye(3), 0.01), "skinned": False}),
        "posed": (rig.names, {"axes": axes, "shown": 30, "unit": 0.01, "armature": (QUARTER, 0.1)}),
    }[name]


@pytest.mark.parametrize("name", ["ours", "mixamo", "unreal", "vrm 0", "vrm 1", "z up", "posed"])
def test_a_character_is_the_body_and_the_motion_that_it_was_made_of(name, rig, walk, axes, tmp_path):
    names, options = dialect(name, rig, axes)
    rigged.write(tmp_path / "c.glb", rig.body, names, walk, **options)
    found = character.read(tmp_path / "c.glb")
    body, order = found.rig.body, [found.bound.names.index(each) for each in renamed(name, names, rig)]
    placed = np.asarray(body.joints[0]) - np.asarray(rig.body.joints[0])  # a scene in another pose says it alone
    assert np.abs(placed).max() < (1e-5 if name != "posed" else 2.0)
    body = body._replace(vertices=body.vertices - placed, joints=body.joints - placed)
    np.testing.assert_allclose(body.vertices, rig.body.vertices, atol=2e-5)
    np.testing.assert_array_equal(body.faces, rig.body.faces)
    np.testing.assert_allclose(body.joints[order], rig.body.joints, atol=2e-5)
    np.testing.assert_allclose(body.weights[:, order], rig.body.weights, atol=2e-3)
    clips, *_ = gltf.motions(found, walk.fps)
    places, expected = joint_positions(clips["a_walk"], body)[:, order], joint_positions(walk, rig.body)
    np.testing.assert_allclose(places - places[:1, :1], expected - expected[:1, :1], atol=1e-4)
    assert set(found.rig.names) == set(renamed(name, names, rig))
    known = skeleton.landmarks(found.rig.names, body.parents)
    for joint in ("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Head", "LeftForeArm", "RightFoot"):
        assert known[joint] == order[rig.names.index(joint)]
    assert len(found.log) >= 1 and ("turned" in " ".join(found.log)) == (name in ("vrm 0", "z up"))


def renamed(name, names, rig):
    """Names as the body has them: joints of no scheme, if they are parts of a body, are called as CMU's."""
    known = set(rigged.VRM) - {"Neck"} if name.startswith("vrm") else set()
    return [joint if joint in known else own for own, joint in zip(names, rig.names)]


@pytest.mark.parametrize("name", ["ours", "mixamo", "unreal", "vrm 0", "vrm 1", "z up", "no skin", "posed"])
def test_an_animation_is_retargeted_to_another_body(name, rig, walk, axes, tmp_path):
    names, options = dialect(name, rig, axes)
    rigged.write(tmp_path / "c.glb", rig.body, names, walk, **options)
    capture = gltf_motion.read_gltf(tmp_path / "c.glb", walk.fps)
    found = retarget.retarget(capture, rig.body, rig.names, freeze=False, about="c.glb")
    places, expected = joint_positions(found, rig.body), joint_positions(walk, rig.body)
    turn = HALF if name == "vrm 0" else np.eye(3)  # a figure keeps its heading
    apart = np.linalg.norm((places - places[:, :1]) @ turn - (expected - expected[:, :1]), axis=-1)
    assert apart.max() < 1e-4
    assert np.abs(found.translation @ turn - walk.translation).max() < 0.005  # where the ground is


def test_an_animation_is_named_where_there_are_several(rig, walk, tmp_path):
    path = tmp_path / "c.glb"
    rigged.write(path, rig.body, rig.names, walk)
    with pytest.raises(ValueError, match=r"c\.glb: which of its animations \(--animation\)\? There are a walk"):
        gltf_motion.read_gltf(path, 30.0, "a run")
    assert gltf_motion.read_gltf(path, 60.0, "a walk").rotations.shape[0] == 79
    trimesh.creation.icosphere().export(tmp_path / "ball.glb")
    with pytest.raises(ValueError, match=r"ball\.glb: it has no animation"):
        gltf_motion.read_gltf(tmp_path / "ball.glb", 30.0)


def written(tmp_path, body, names, walk, **options):
    mixamo = tuple(f"mixamorig:{rigged.MIXAMO.get(joint, joint)}" for joint in names)
    rigged.write(tmp_path / "c.glb", body, options.pop("joints", mixamo), walk, **options)
    return tmp_path / "c.glb"


def heights(rig, name):
    """The height of a joint, and those of the middles of the body's faces."""
    middles = np.asarray(rig.body.vertices)[rig.body.faces].mean(axis=1)
    return rig.body.joints[rig.names.index(name), 1], middles[:, 1]


def test_objects_that_meet_are_one_body_and_others_are_wrapped(rig, walk, tmp_path):
    faces, (neck, height) = np.asarray(rig.body.faces), heights(rig, "Neck")
    pieces = {"Head": faces[height > neck], "Body": faces[height <= neck]}
    whole = character.read(written(tmp_path, rig.body, rig.names, walk, objects=pieces))
    assert whole.rig.body.faces.shape == faces.shape and "wrapped" not in " ".join(whole.log)
    legs = height < heights(rig, "LeftLeg")[0]
    found = character.read(written(tmp_path, rig.body, rig.names, walk, objects={"Body": faces[~legs]}))
    body, points = found.rig.body, np.float64(rig.body.vertices)[np.unique(faces[~legs])]
    assert "wrapped" in " ".join(found.log) and "not one closed surface" in " ".join(found.log)
    assert wrap.is_closed(np.float64(body.vertices), np.int64(body.faces))
    distance = np.sqrt(igl.point_mesh_squared_distance(points, np.float64(body.vertices), np.int64(body.faces))[0])
    assert np.median(distance) < 0.004
    np.testing.assert_allclose(body.weights.sum(axis=1), 1.0, atol=1e-5)
    assert np.percentile(distance, 95) < 0.010
    without = faces[(height > neck + 0.08) | (height < neck - 0.02)]
    pieces = character.read(written(tmp_path, rig.body, rig.names, walk, objects={"Body": without})).rig.body
    assert pieces.vertices[:, 1].max() == pytest.approx(rig.body.vertices[:, 1].max(), abs=0.01)
    nearest = KDTree(points).query(body.vertices)[1]
    weights = np.asarray(rig.body.weights)[np.unique(faces[~legs])][nearest]
    assert np.abs(weights - body.weights).max(axis=1).mean() < 0.05


def test_clothes_in_the_file_are_left_out_by_object(rig, walk, tmp_path):
    body, faces = rig.body, np.asarray(rig.body.faces)
    outer = np.float64(body.vertices) + 0.01 * igl.per_vertex_normals(np.float64(body.vertices), np.int64(faces))
    both = body._replace(
        vertices=np.concatenate([body.vertices, outer]), weights=np.concatenate([body.weights, body.weights])
    )
    (waist, height), neck = heights(rig, "LowerBack"), heights(rig, "Neck")[0]
    shirt = faces[(height > waist) & (height < neck)] + len(outer)
    path = written(tmp_path, both, rig.names, walk, objects={"Skin": faces, "Shirt": shirt})
    alone = character.read(path, objects=("Skin",))
    assert alone.rig.body.vertices.shape == body.vertices.shape
    assert any("left out, not of the body: Shirt" in line for line in alone.log)
    assert "wrapped" in " ".join(character.read(path).log)
    with pytest.raises(ValueError, match="no skinned object is called Sknn; there are Skin, Shirt"):
        character.read(path, objects=("Sknn",))


def test_morph_targets_that_move_more_than_the_head_are_shapes(rig, walk, tmp_path):
    body, wide = rig.body, np.asarray(rig.body.shapedirs)[..., 1]
    of_head = np.asarray(body.weights)[:, rig.names.index("Head")] > 0.9
    morphs = {"wide": 3 * wide, "smile": 0.02 * of_head[:, None] * np.ones(3), "breath": np.full_like(wide, 0.002)}
    path = written(tmp_path, body, rig.names, walk, morphs=morphs, turn=HALF, armature=(np.eye(3), 0.01))
    shaped = character.read(path).rig.body
    np.testing.assert_allclose(shaped.shapedirs[..., 0], wide, atol=1e-5)
    assert (
        shaped.shapedirs.shape[-1] == 1
        and character.read(path, shapes=("smile", "wide")).rig.body.shapedirs.shape[-1] == 2
    )
    with pytest.raises(ValueError, match=r"c\.glb: no morph target is called wide2; there are wide, smile, breath"):
        character.read(path, shapes=("wide2",))


def test_vertices_that_no_joint_carries_follow_the_hips(rig, walk, tmp_path):
    weights = np.array(rig.body.weights)
    weights[100:120] = 0.0
    body = character.read(written(tmp_path, rig.body._replace(weights=weights), rig.names, walk)).rig.body
    assert (body.weights[100:120, 0] == 1.0).all() and body.weights[99, 0] < 1.0


def exchanged(names):
    """Names with left and right exchanged."""
    return tuple(re.sub("^(Left|Right)", lambda m: {"Left": "Right", "Right": "Left"}[m[0]], n) for n in names)


def test_what_is_no_character_is_refused_with_what_to_do(rig, walk, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"c\.glb: its left foot points backwards: it is mirrored, or the names"):
        character.read(written(tmp_path, rig.body, rig.names, walk, joints=exchanged(rig.names)))
    with pytest.raises(ValueError, match=r"c\.glb: it was not bound to its skeleton standing: bind it in a T-pose"):
        slope = Rotation.from_euler("x", -45, degrees=True).as_matrix()
        character.read(written(tmp_path, rig.body, rig.names, walk, turn=slope))
    with pytest.raises(ValueError, match=r"c\.glb: .*18\.\d+ units tall, 0\.3 to 3 m is expected: give its unit"):
        character.read(written(tmp_path, rig.body, rig.names, walk, unit=0.1))
    numbered = tuple(f"Bone.{j:03}" for j in range(len(rig.names)))
    thumb = rig.names.index("LThumb")
    numbered = (*numbered[:thumb], "LeftArm", *numbered[thumb + 1 :])  # a name that is needed for another
    path = written(tmp_path, rig.body, rig.names, walk, joints=numbered)
    with pytest.raises(ValueError, match=r"c\.glb: no joint is known as .*c_joints\.yaml is a first guess of one"):
        character.read(path)
    known = skeleton.landmarks(rig.names, rig.body.parents)
    rows = {part: numbered[known[skeleton.cmu_name(part)]] for part in skeleton.SIDED}
    rows |= {"head": numbered[known["Head"]], "hips": numbered[known["Hips"]]}
    (tmp_path / "map.yaml").write_text("\n".join(f"{part}: {joint}" for part, joint in rows.items()))
    found = character.read(path, joints=tmp_path / "map.yaml")
    assert found.rig.names[known["LeftArm"]] == "LeftArm" and found.rig.names[thumb] == "LeftArm of the file"
    assert any(f"joint {numbered[known['LeftArm']]} is called LeftArm" in line for line in found.log)
    trimesh.creation.icosphere().export(tmp_path / "ball.glb")
    with pytest.raises(ValueError, match=r"ball\.glb: no mesh is skinned: export the character with its skeleton"):
        character.read(tmp_path / "ball.glb")
    far = rig.body._replace(vertices=np.array(rig.body.vertices))
    far.vertices[7, 0] = 9.0
    with pytest.raises(ValueError, match=r"c\.glb: a vertex at .*9\.0.* is \d\.\d m from the hips: leave out"):
        character.read(written(tmp_path, far, rig.names, walk))
    with pytest.raises(ValueError, match=r"none\.glb: no such file"):
        character.read(tmp_path / "none.glb")
    for content, reason in (
        (b"", "an empty file: copy or"),
        (b"<html>", "damaged, or not glTF: JSON"),
        (b"\xff\xfe", "not glTF"),
    ):
        (tmp_path / "page.glb").write_bytes(content)
        with pytest.raises(ValueError, match=rf"page\.glb: .*{reason}"):
            character.read(tmp_path / "page.glb")


def test_bones_that_an_animation_stretches_are_told(rig, walk, tmp_path):
    body = rig.body
    longer = body._replace(joints=np.asarray(body.joints) * np.array([1.0, 1.1, 1.0]))
    path = written(tmp_path, body, rig.names, walk)
    found = character.read(path)
    moved = found._replace(rig=found.rig._replace(body=longer))
    assert any("bones keep their lengths" in line for line in gltf.motions(moved, 30.0)[1])
    assert gltf.motions(found, 30.0)[1] == []


def test_garments_and_motions_are_made_for_a_character_of_other_names(rig, walk, tmp_path):
    """The command line, on a character of Unreal's names: its body, a template, a generated motion."""
    names = tuple(rigged.UNREAL.get(joint, joint) for joint in rig.names)
    path = written(tmp_path, rig.body, rig.names, walk, joints=names)
    gltf.main(gltf.Arguments(path, tmp_path / "body.h5", motions=tmp_path / "motions"))
    body, found = storage.load_rig(tmp_path / "body.h5")
    order = [found.index(name) for name in names]
    clip = storage.load_motion(tmp_path / "motions" / "a_walk.h5", found)
    turns = Rotation.from_matrix(clip.rotations[:, order].reshape(-1, 3, 3)).inv() * Rotation.from_matrix(
        np.asarray(walk.rotations).reshape(-1, 3, 3)
    )
    assert np.degrees(turns.magnitude()).max() < 0.1
    ours, theirs = (procedural.generate("walk", 3, 2.0, body=each) for each in ("body", tmp_path / "body.h5"))
    np.testing.assert_allclose(theirs.rotations[:, order], ours.rotations, atol=1e-4)
    made = templates.build("skirt", 300, body, found)
    expected = templates.build("skirt", 300, rig.body, rig.names)
    assert abs(len(made.vertices) - len(expected.vertices)) < 5
    surface = np.float64(made.vertices), np.int64(made.faces)
    apart = np.sqrt(igl.point_mesh_squared_distance(np.float64(expected.vertices), *surface)[0])
    assert apart.mean() < 0.002 and np.percentile(apart, 95) < 0.01  # rounding turns an edge here or there


@pytest.mark.parametrize("how", ["STEP", "LINEAR", "CUBICSPLINE"])
def test_keys_are_interpolated_as_the_standard_says(how):
    keys, values = np.array([0.0, 1.0, 3.0]), np.array([[0.0], [2.0], [0.0]])
    times = np.array([-1.0, 0.0, 0.5, 1.0, 2.0, 3.0, 4.0])
    if how == "CUBICSPLINE":  # x^2 (3 - x) on [0, 1], with slopes 0, 3 and 0
        spline = np.array([[0], [0], [0], [3], [2], [0], [0], [0], [0]], float)
        found = gltf_file._sampled(times, keys, spline, how)[:, 0]
        np.testing.assert_allclose(found, [0, 0, 0.625, 2, 1, 0, 0])
    else:
        expected = {"STEP": [0, 0, 0, 2, 2, 0, 0], "LINEAR": [0, 0, 1, 2, 1, 0, 0]}[how]
        np.testing.assert_allclose(gltf_file._sampled(times, keys, values, how)[:, 0], expected)


# What else is in a file


def changed(path, change):
    """Change the JSON of a .glb, with a function that adds numbers to its data."""
    data = path.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    document, binary = json.loads(data[20 : 20 + size]), bytearray(data[28 + size :])

    def add(array, kind="VEC4"):
        array = np.ascontiguousarray(array, np.float32)
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes}
        binary.extend(array.tobytes())
        document["bufferViews"].append(view)
        entry = {"bufferView": len(document["bufferViews"]) - 1, "componentType": rigged.FLOAT, "count": len(array)}
        document["accessors"].append(entry | {"type": kind})
        return len(document["accessors"]) - 1

    def read(index):
        entry = document["accessors"][index]
        view = document["bufferViews"][entry["bufferView"]]
        flat = np.frombuffer(bytes(binary), np.float32, view["byteLength"] // 4, view["byteOffset"])
        return flat.reshape(entry["count"], -1).copy()

    change(document, add, read)
    document["buffers"][0]["byteLength"] = len(binary)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = [len(text).to_bytes(4, "little") + b"JSON" + text, len(binary).to_bytes(4, "little") + b"BIN\0" + binary]
    whole = 12 + sum(map(len, chunks))
    path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + whole.to_bytes(4, "little") + b"".join(chunks))
    return path


def doubled(document, add, read):
    """Put a second figure that stands still first in the scene, which the animation has keys for."""
    count, animation = len(document["nodes"]), document["animations"][0]
    for node in copy.deepcopy(document["nodes"]):
        node["children"] = [child + count for child in node.get("children", ())]
        document["nodes"].append({key: node[key] for key in node if key not in ("mesh", "skin")})
    document["scenes"][0]["nodes"] = [node + count for node in document["scenes"][0]["nodes"]] + document["scenes"][0][
        "nodes"
    ]
    for channel in list(animation["channels"]):
        node = channel["target"]["node"]
        if channel["target"]["path"] == "rotation" and "rotation" in document["nodes"][node]:
            frames = document["accessors"][animation["samplers"][0]["input"]]["count"]
            output = add(np.tile(document["nodes"][node]["rotation"], (frames, 1)))
            animation["samplers"].append({"input": animation["samplers"][0]["input"], "output": output})
            target = {"node": node + count, "path": "rotation"}
            animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})


def with_a_camera(document, add, read):
    """Put a camera that turns first in the scene."""
    document["nodes"].append({"name": "Camera"})
    node, animation = len(document["nodes"]) - 1, document["animations"][0]
    document["scenes"][0]["nodes"].insert(0, node)
    animation["channels"].append({"sampler": 0, "target": {"node": node, "path": "rotation"}})


def without_hips(document, add, read):
    """Leave out the channel that turns the hips."""
    animation = document["animations"][0]
    kept = [c for c in animation["channels"] if (c["target"]["node"], c["target"]["path"]) != (0, "rotation")]
    animation["channels"] = kept


def test_the_figure_is_found_among_other_nodes_that_turn(rig, walk, tmp_path):
    path, lines = written(tmp_path, rig.body, rig.names, walk), []
    wanted = gltf_motion.read_gltf(path, walk.fps)
    found = gltf_motion.read_gltf(changed(path, with_a_camera), walk.fps, tell=lines.append)
    assert found.names == wanted.names and lines == []
    np.testing.assert_allclose(found.rotations, wanted.rotations)
    found = gltf_motion.read_gltf(changed(path, without_hips), walk.fps)
    assert found.names == wanted.names
    np.testing.assert_allclose(found.rotations[:, 1:], wanted.rotations[:, 1:], atol=1e-6)
    gltf_motion.read_gltf(changed(path, doubled), walk.fps, tell=lines.append)
    assert len(lines) == 1 and "there are two figures: that of node " in lines[0]


def test_names_of_a_humanoid_win(rig, walk, tmp_path):
    """The bone of the lower back is called as an arm."""
    names, options = dialect("vrm 0", rig, None)
    rigged.write(tmp_path / "c.glb", rig.body, names, walk, **options)
    wanted = gltf_motion.read_gltf(tmp_path / "c.glb", walk.fps)
    other = tuple("LeftArm" if joint == "LowerBack" else own for own, joint in zip(names, rig.names))
    rigged.write(tmp_path / "c.glb", rig.body, other, walk, **options)
    found = gltf_motion.read_gltf(tmp_path / "c.glb", walk.fps)
    assert found.names.index("LeftArm") == wanted.names.index("LeftArm") == rig.names.index("LeftArm")


def test_steps_at_the_rate_of_the_result_are_its_frames():
    keys = np.float32(np.arange(200) / np.float32(30.0)).astype(np.float64)
    found = gltf_file._sampled(np.arange(200) / 30, keys, np.arange(200.0)[:, None], "STEP")[:, 0]
    np.testing.assert_array_equal(found, np.arange(200))


@pytest.mark.parametrize("wrong, told", [("frames", "its 40 keys are 1 s apart: are its times in seconds"),
                                         ("ms", "its 40 keys are 33.3 s apart"),
                                         ("twice", "the rotation of mixamorig:Hips: key 10 is not after key 9"),
                                         ("zero", "the rotation of .* is no rotation at key 7"),
                                         ("nan", "the rotation of .* has a key that is not finite"),
                                         ("no file", "its data are in .*away.bin, which is not there"),
                                         ("old", "glTF of version 1, not 2")])  # fmt: skip
def test_keys_and_files_that_are_wrong_are_named(wrong, told, rig, walk, tmp_path):
    def change(document, add, read):
        samplers = document["animations"][0]["samplers"]
        times, output = read(samplers[0]["input"]), read(samplers[5]["output"])
        factor = {"frames": 30, "ms": 1000}.get(wrong, 1)
        times[10] = times[9] if wrong == "twice" else times[10]
        index = add(factor * times, "SCALAR")
        for sampler in samplers:
            sampler["input"] = index
        output[7] = {"zero": 0, "nan": np.nan}.get(wrong, output[7])
        samplers[5]["output"] = add(output)

    path = changed(written(tmp_path, rig.body, rig.names, walk), change)
    if wrong == "old":
        path.write_bytes(path.read_bytes()[:4] + (1).to_bytes(4, "little") + path.read_bytes()[8:])
    if wrong == "no file":
        changed(path, lambda document, add, read: document["buffers"][0].update(uri="away.bin"))
    with pytest.raises(ValueError, match=rf"c\.glb: {told}"):
        gltf_motion.read_gltf(path, 30.0)
    if wrong == "zero":
        _, _, (error,) = gltf.motions(character.read(path), 30.0)
        assert re.search(rf"c\.glb, animation a_walk: {told}", error)


def test_animations_that_are_refused_leave_the_others(rig, walk, tmp_path):
    """A whole one comes after one that is damaged, and one that no body can make."""
    wild = np.tile(np.array([[0.0, 0, 0, 1], [1.0, 0, 0, 0]]), (20, 1))

    def change(document, add, read):
        whole = document["animations"].pop()
        for name, row in (("damaged", np.zeros((40, 4))), ("wild", wild)):
            document["animations"].append(json.loads(json.dumps(whole)) | {"name": name})
            document["animations"][-1]["samplers"][0]["output"] = add(row)
        document["animations"].append(whole)

    path = changed(written(tmp_path, rig.body, rig.names, walk), change)
    arguments = gltf.Arguments(path, tmp_path / "body.h5", motions=tmp_path / "motions", bad="repair")
    with pytest.raises(ValueError, match="2 of the animations are not written: ") as refused:
        gltf.main(arguments)
    damaged, wild = re.findall(rf"{re.escape(str(path))}, animation (\w+: [^;]*)", str(refused.value))
    assert re.match("damaged: the rotation of .*Hips is no rotation", damaged)
    assert re.match("wild: .* frames are implausible", wild)
    assert [file.name for file in (tmp_path / "motions").iterdir()] == ["a_walk.h5"]
    with h5py.File(tmp_path / "motions" / "a_walk.h5") as file:
        assert (file.attrs["name"], file.attrs["source"]) == (b"a_walk", b"c.glb, animation a_walk")


def test_objects_that_were_bound_in_other_poses_are_put_together(rig, walk, tmp_path):
    """The left arm was bound hanging down, the rest in a T-pose."""
    body = rigged.coarse(rig.body)
    faces, vertices = np.asarray(body.faces), 100 * np.asarray(body.vertices)
    outer = np.abs(vertices[faces].mean(axis=1)[:, 0]) > 30
    path = written(tmp_path, body, rig.names, walk, objects={"Body": faces[~outer], "Arms": faces[outer]})
    wanted, shoulder = character.read(path).bound.vertices, rig.names.index("LeftArm")
    arm = [shoulder in skeleton.ancestors(j, body.parents) for j in range(len(rig.names))]
    of_arm = np.asarray(body.weights)[:, arm].sum(axis=1)
    turn, place = np.eye(4), 100 * np.asarray(body.joints)[shoulder]
    turn[:3, :3] = Rotation.from_euler("z", -60, degrees=True).as_matrix()
    turn[:3, 3] = place - turn[:3, :3] @ place

    def change(document, add, read):
        inverse = read(document["skins"][0]["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
        inverse[arm] = inverse[arm] @ np.linalg.inv(turn)
        index = add(inverse.swapaxes(1, 2).reshape(-1, 16), "MAT4")
        document["skins"].append({"joints": document["skins"][0]["joints"], "inverseBindMatrices": index})
        moved = vertices @ turn[:3, :3].T + turn[:3, 3]
        points = add(of_arm[:, None] * moved + (1 - of_arm)[:, None] * vertices, "VEC3")
        node = next(node for node in document["nodes"] if node.get("name") == "Arms")
        node["skin"] = 1
        document["meshes"][node["mesh"]]["primitives"][0]["attributes"]["POSITION"] = points

    found = character.read(changed(path, change))
    assert any("bound in another pose than the largest one" in line for line in found.log)
    whole = np.tile((of_arm < 0.01) | (of_arm > 0.99), 2)  # of others a mean of two places is not undone
    np.testing.assert_allclose(found.bound.vertices[whole], wanted[whole], atol=5e-3)


def test_a_mesh_elsewhere_than_its_joints_is_refused(rig, walk, tmp_path):
    path = written(tmp_path, rig.body, rig.names, walk)
    changed(path, lambda document, add, read: document["skins"][0].pop("inverseBindMatrices"))
    with pytest.raises(ValueError, match=r"c\.glb: its joints, .* tall, are not in its mesh, .*: bind the mesh"):
        character.read(path)
