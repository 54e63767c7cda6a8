"""A skinned glTF, read and posed by the rules of glTF 2.0 alone, is what the runtime shows."""

import json
import re
import shutil
import subprocess

import jax.numpy as jnp
import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from clothjax.body import joint_names, skinning
from clothjax.commands import render
from clothjax.evaluation import pictures, rollouts
from clothjax.render import skinned_gltf
from clothjax.render.performance import SkinnedPart, SkinnedPerformance
from clothjax.render.skinned_gltf import to_skinned_glb
from clothjax.runtime import inference, loading, trained
from clothjax.simulation import assembly
from clothjax.types import Motion, Pose

FRAMES = 60
SAMPLED = (0, 17, 41, FRAMES - 1)
REQUIRED = {  # by VRM 1.0: each bone's nearest ancestor among them
    "hips": None,
    "spine": "hips",
    "head": "spine",
    "leftUpperArm": "spine",
    "leftLowerArm": "leftUpperArm",
    "leftHand": "leftLowerArm",
    "rightUpperArm": "spine",
    "rightLowerArm": "rightUpperArm",
    "rightHand": "rightLowerArm",
    "leftUpperLeg": "hips",
    "leftLowerLeg": "leftUpperLeg",
    "leftFoot": "leftLowerLeg",
    "rightUpperLeg": "hips",
    "rightLowerLeg": "rightUpperLeg",
    "rightFoot": "rightLowerLeg",
}


class Reader:
    """A binary glTF of skinned meshes that its own animation poses."""

    def __init__(self, path):
        self.file = pygltflib.GLTF2().load(str(path))
        self.nodes = self.file.nodes
        self.parents = {child: node for node, each in enumerate(self.nodes) for child in each.children}
        self.channels = [c for animation in self.file.animations for c in animation.channels]

    def read(self, index):
        accessor = self.file.accessors[index]
        view = self.file.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        kind = {5126: "<f4", 5125: "<u4", 5123: "<u2", 5121: "<u1"}[accessor.componentType]
        values = np.frombuffer(self.file.binary_blob(), kind, accessor.count * width, view.byteOffset)
        values = values.reshape(-1, width)
        if accessor.min:
            np.testing.assert_array_equal([values.min(0), values.max(0)], [accessor.min, accessor.max])
        return values

    def animated(self, node, path, frame, default):
        """The value of a property at a key of the animation."""
        for channel in self.channels:
            if (channel.target.node, channel.target.path) == (node, path):
                sampler = self.file.animations[0].samplers[channel.sampler]
                return self.read(sampler.output).reshape(len(self.read(sampler.input)), -1)[frame]
        return default

    def place(self, node, frame):
        """The global matrix [4, 4] of a node."""
        given, local = self.nodes[node], np.eye(4)
        turn = self.animated(node, "rotation", frame, given.rotation or [0, 0, 0, 1])
        local[:3, :3] = Rotation.from_quat(turn).as_matrix()
        local[:3, 3] = self.animated(node, "translation", frame, given.translation or [0, 0, 0])
        return local if node not in self.parents else self.place(self.parents[node], frame) @ local

    def node(self, name):
        return next(index for index, node in enumerate(self.nodes) if node.name == name)

    def primitive(self, name):
        return self.file.meshes[self.nodes[self.node(name)].mesh].primitives[0]

    def bind(self):
        """The inverse bind matrices [J, 4, 4], row-major."""
        return self.read(self.file.skins[0].inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)

    def vertices(self, name, frame):
        """The vertices [N, 3] m of a mesh: morphed, then skinned."""
        node = self.node(name)
        primitive, skin = self.primitive(name), self.file.skins[self.nodes[node].skin]
        points = self.read(primitive.attributes.POSITION).astype(float)
        weights, targets = self.animated(node, "weights", frame, ()), primitive.targets or ()
        assert len(weights) == len(targets)
        for weight, target in zip(weights, targets):
            assert abs(weight) <= 1.0
            points = points + weight * self.read(target["POSITION"])
        matrices = np.stack([self.place(joint, frame) for joint in skin.joints]) @ self.bind()
        blended = np.zeros((len(points), 4, 4))
        for k in range(2):
            if getattr(primitive.attributes, f"JOINTS_{k}", None) is not None:
                joints = self.read(getattr(primitive.attributes, f"JOINTS_{k}"))
                amounts = self.read(getattr(primitive.attributes, f"WEIGHTS_{k}"))
                blended += np.einsum("nk,nkab->nab", amounts, matrices[joints])
        np.testing.assert_allclose(blended[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (len(points), 1)), atol=1e-6)
        return np.einsum("nab,nb->na", blended[:, :3, :3], points) + blended[:, :3, 3]


def apart(found, expected):
    """The largest distance of vertices [N, 3], in their unit."""
    return np.linalg.norm(found - np.asarray(expected), axis=-1).max()


@pytest.fixture(scope="module")
def run():
    return trained.find("skirt")


@pytest.fixture(scope="module")
def experiment(run):
    return rollouts.load_run(run)[0]


@pytest.fixture(scope="module")
def clip(experiment):
    """The frames of dance_3 that are shown, from the origin."""
    motion = assembly.motion(experiment, "dance_3")
    root = np.asarray(motion.translation[1 : FRAMES + 1])
    return Motion(np.asarray(motion.rotations[1 : FRAMES + 1], np.float32), root - root[0], motion.fps)


@pytest.fixture(scope="module")
def dancing(tmp_path_factory):
    path = tmp_path_factory.mktemp("dancing") / "skirt.glb"
    render.main(["skirt", "--motions", "dance_3", "--out", str(path), "--frames", str(FRAMES), "--skinned"])
    return Reader(path)


@pytest.fixture(scope="module")
def resting(tmp_path_factory):
    path = tmp_path_factory.mktemp("resting") / "skirt.glb"
    render.main(["skirt", "--out", str(path), "--skinned"])
    return Reader(path)


def test_the_garment_is_what_the_runtime_shows(dancing, run, clip):
    shown, _ = inference.animate(loading.load(run), clip)
    assert apart(shown[17], shown[0]) > 0.05
    assert getattr(dancing.primitive("garment").attributes, "JOINTS_1", None) is None  # not every engine reads it
    for frame in SAMPLED:
        assert apart(dancing.vertices("garment", frame), shown[frame]) < 1.5e-3


def test_the_body_is_that_of_the_rig(dancing, experiment, clip):
    body = experiment.body
    for frame in SAMPLED:
        pose = Pose(jnp.asarray(clip.rotations[frame]), jnp.asarray(clip.translation[frame], jnp.float32))
        assert apart(dancing.vertices("body", frame), skinning.pose_body(body, body.vertices, body.joints, pose)) < 1e-4


def test_the_motion_has_its_times_and_turns_without_jumps(dancing, clip):
    paths = [channel.target.path for channel in dancing.channels]
    assert paths.count("rotation") == clip.rotations.shape[1]
    assert paths.count("translation") == paths.count("weights") == 1
    for channel in dancing.channels:
        sampler = dancing.file.animations[0].samplers[channel.sampler]
        np.testing.assert_allclose(dancing.read(sampler.input)[:, 0], np.arange(FRAMES) / 30, atol=1e-6)
        if channel.target.path == "rotation":
            turns = dancing.read(sampler.output)
            assert (np.sum(turns[1:] * turns[:-1], axis=1) > 0.5).all()


def test_quaternions_do_not_change_their_sign():
    turning = Rotation.from_euler("y", np.linspace(0, 8 * np.pi, 100)[:, None]).as_matrix()
    found = skinned_gltf._quaternions(turning[:, None])[:, 0]
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), turning, atol=1e-6)
    assert (np.sum(found[1:] * found[:-1], axis=1) > 0.9).all()


def test_the_skeleton_is_that_of_the_rig(dancing, experiment):
    body, joints = experiment.body, dancing.file.skins[0].joints
    assert [dancing.nodes[joint].name for joint in joints] == list(experiment.names)
    for joint, parent in zip(joints, np.asarray(body.parents)):
        assert dancing.parents.get(joint) == (joints[parent] if parent >= 0 else None)
        assert dancing.nodes[joint].rotation is None and dancing.nodes[joint].scale is None
    assert sorted(dancing.file.scenes[0].nodes) == sorted([joints[0], dancing.node("body"), dancing.node("garment")])


def test_bind_matrices_undo_the_rest_pose(resting, experiment):
    places = np.stack([resting.place(joint, 0) for joint in resting.file.skins[0].joints])
    np.testing.assert_allclose(places[:, :3, 3], experiment.body.joints, atol=1e-6)
    np.testing.assert_allclose(places @ resting.bind(), np.tile(np.eye(4), (len(places), 1, 1)), atol=1e-6)


def test_without_a_motion_there_is_the_canonical_pose_alone(resting, experiment):
    assert not resting.channels and not resting.primitive("garment").targets
    for name, expected in (("body", experiment.body), ("garment", experiment.garment)):
        assert apart(resting.vertices(name, 0), expected.vertices) < 1e-6
        faces = resting.read(resting.primitive(name).indices).reshape(-1, 3)
        np.testing.assert_array_equal(faces, expected.faces)


def test_another_body_has_another_skeleton(tmp_path, run, experiment, clip, capsys):
    betas = np.zeros(10, np.float32)
    betas[:2] = 2.0, -1.0
    command = ["skirt", "--motions", "dance_3", "--frames", "18", "--skinned", "--betas", "2", "-1"]
    render.main([*command, "--out", str(tmp_path / "a.glb")])
    assert 0.1 < float(re.search(r"err by (\S+) mm at most", capsys.readouterr().out)[1]) <= 1.0
    reader, model = Reader(tmp_path / "a.glb"), loading.load(run, betas=betas)
    places = np.linalg.inv(reader.bind())[:, :3, 3]
    np.testing.assert_allclose(places, model.wearer.joints, atol=1e-6)
    assert apart(places, experiment.body.joints) > 0.01
    shown = inference.animate(model, Motion(clip.rotations[:18], clip.translation[:18], clip.fps))[0]
    assert apart(reader.vertices("garment", 17), shown[17]) < 1.5e-3


def test_at_rest_the_garment_keeps_all_of_its_joints(resting, experiment, clip):
    """An engine poses it: four joints of a vertex would not be enough."""
    for joint, turn in enumerate(clip.rotations[17]):
        resting.nodes[joint].rotation = Rotation.from_matrix(turn).as_quat().tolist()
    transforms = skinning.joint_transforms(
        jnp.asarray(clip.rotations[17]), experiment.body.joints, experiment.body.parents
    )
    weights = np.asarray(experiment.garment.weights)
    for count, least, most in ((4, 1e-3, 1.0), (8, 0.0, 1e-5)):
        kept = jnp.asarray(skinned_gltf.largest(weights, count), jnp.float32)
        expected = skinning.apply(skinning.blend(kept, transforms), experiment.garment.vertices)
        assert least <= apart(resting.vertices("garment", 0), expected) < most
    for joint in range(len(clip.rotations[17])):
        resting.nodes[joint].rotation = None


def test_the_root_is_moved_from_where_it_rests(tmp_path):
    joints = np.array([[0, 1, 0], [0, 1.5, 0]], np.float32)
    part = SkinnedPart("flag", joints[None, [0, 1, 1]], np.array([[0, 1, 2]]), np.eye(2)[[0, 1, 1]], (0.5, 0.5, 0.5))
    motion = Motion(np.tile(np.eye(3, dtype=np.float32), (3, 2, 1, 1)), np.arange(9.0).reshape(3, 3), 30.0)
    to_skinned_glb(tmp_path / "f.glb", SkinnedPerformance((part,), ("a", "b"), np.array([-1, 0]), joints, {}, motion))
    flag = Reader(tmp_path / "f.glb")
    np.testing.assert_allclose(flag.place(0, 0)[:, 3], [0, 2, 2, 1], atol=1e-6)
    np.testing.assert_allclose(flag.place(0, 2)[:, 3], [6, 8, 8, 1], atol=1e-6)
    np.testing.assert_allclose(flag.place(1, 2)[:, 3], [6, 8.5, 8, 1], atol=1e-6)


def test_bones_of_a_humanoid_are_marked(resting):
    bones = {node.extras["humanoid"]: index for index, node in enumerate(resting.nodes) if node.extras}
    assert len(bones) == 22
    for bone, above in REQUIRED.items():
        node = resting.parents.get(bones[bone])
        while node is not None and resting.nodes[node].extras.get("humanoid") not in REQUIRED:
            node = resting.parents.get(node)
        assert (None if node is None else resting.nodes[node].extras["humanoid"]) == above, bone
        x = resting.place(bones[bone], 0)[0, 3]
        assert not bone.startswith("left") or x > 0.05
        assert not bone.startswith("right") or x < -0.05


def test_names_of_smpl_are_bones_too():
    expected = {"pelvis": "hips", "spine3": "upperChest", "left_ankle": "leftFoot", "right_foot": "rightToes"}
    assert joint_names.vrm_bones((*expected, "left_index1", "jaw")) == expected


def test_vertices_that_are_pushed_after_skinning_come_back(tmp_path, monkeypatch, run, experiment):
    """As a Psi with forces does: they are nowhere among the blend shapes."""
    pushed = []

    def psi_trajectory(model, motion):
        shown = rollouts.psi_trajectory(model, motion)
        shown[:, ::7] += 0.02 * np.sin(np.arange(len(shown)))[:, None, None] * np.array([0.6, 0.0, 0.8], np.float32)
        pushed.append(shown)
        return shown

    monkeypatch.setattr(pictures, "psi_trajectory", psi_trajectory)
    performance = pictures.perform_skinned(run, experiment, "dance_3", 20)
    assert to_skinned_glb(tmp_path / "a.glb", performance)["garment"] <= 1e-3
    reader, root = Reader(tmp_path / "a.glb"), performance.motion.translation
    for frame in (0, 8, 19):
        assert apart(reader.vertices("garment", frame), pushed[0][frame] + root[frame]) < 1.5e-3


def test_a_body_with_pose_blend_shapes_has_morph_targets(tmp_path, run, experiment):
    body = experiment.body
    random = np.random.default_rng(0).normal(size=(4, body.vertices.size))
    mixed = np.random.default_rng(1).normal(size=(9 * (len(body.joints) - 1), 4))
    posedirs = 2e-3 * np.einsum("kn,pk->np", random, mixed).reshape(*body.vertices.shape, -1)
    body = body._replace(posedirs=jnp.asarray(posedirs, jnp.float32))
    performance = pictures.perform_skinned(run, experiment._replace(body=body), "dance_3", 12)
    to_skinned_glb(tmp_path / "a.glb", performance)
    reader, motion = Reader(tmp_path / "a.glb"), performance.motion
    for frame in (0, 11):
        pose = Pose(jnp.asarray(motion.rotations[frame]), jnp.asarray(motion.translation[frame], jnp.float32))
        expected = skinning.pose_body(body, body.vertices, body.joints, pose)
        plain = skinning.pose_body(body._replace(posedirs=None), body.vertices, body.joints, pose)
        assert apart(plain, expected) > 5e-3
        assert apart(reader.vertices("body", frame), expected) < 1.1e-3


def test_a_second_set_of_joints_is_written_where_four_lose_a_hundredth():
    weights = np.zeros((2, 6))
    weights[0, 2] = 1.0
    weights[1] = [0.3, 0.3, 0.2, 0.192, 0.008, 0.0]
    found = skinned_gltf._influences(weights)
    assert found.keys() == {"JOINTS_0", "WEIGHTS_0"}
    np.testing.assert_array_equal(found["JOINTS_0"], [[2, 0, 0, 0], [0, 1, 2, 3]])
    np.testing.assert_allclose(found["WEIGHTS_0"][1], np.array([0.3, 0.3, 0.2, 0.192]) / 0.992, rtol=1e-6)
    weights[1, 3:5] = 0.188, 0.012
    found = skinned_gltf._influences(weights)
    assert found["JOINTS_1"].tolist() == [[0, 0, 0, 0], [4, 0, 0, 0]]
    np.testing.assert_allclose(found["WEIGHTS_1"][1], [0.012, 0, 0, 0], rtol=1e-6)
    few = skinned_gltf._influences(np.array([[0.4, 0.6]]))
    assert few["JOINTS_0"].tolist() == [[1, 0, 0, 0]]
    np.testing.assert_allclose(few["WEIGHTS_0"], [[0.6, 0.4, 0, 0]], rtol=1e-6)


def test_another_format_has_no_skeleton(tmp_path):
    with pytest.raises(ValueError, match=r"a\.webp: --skinned is of \.glb, not of \.webp"):
        render.main(["skirt", "--out", str(tmp_path / "a.webp"), "--skinned"])
    with pytest.raises(ValueError, match="--betas is of --skinned"):
        render.main(["skirt", "--out", str(tmp_path / "a.glb"), "--betas", "1"])


@pytest.mark.slow
@pytest.mark.parametrize("motions", [[], ["--motions", "dance_3", "--frames", "12"]])
def test_the_khronos_validator_finds_nothing(tmp_path, khronos, motions):
    render.main(["skirt", *motions, "--out", str(tmp_path / "g.glb"), "--skinned"])
    issues = khronos(tmp_path / "g.glb")
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"][:5]


PLAY = """
import { readFileSync } from "node:fs";
import * as three from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
globalThis.self = globalThis;
const [path, time] = process.argv.slice(2);
const gltf = await new GLTFLoader().parseAsync(Uint8Array.from(readFileSync(path)).buffer, "");
const mixer = new three.AnimationMixer(gltf.scene);
mixer.clipAction(gltf.animations[0]).play();
mixer.setTime(Number(time));
gltf.scene.updateMatrixWorld(true);
const garment = gltf.scene.getObjectByName("garment");
const point = new three.Vector3(), vertices = [];
for (let i = 0; i < garment.geometry.attributes.position.count; i++) {
  garment.getVertexPosition(i, point);
  vertices.push(point.applyMatrix4(garment.matrixWorld).toArray());
}
console.log(JSON.stringify(vertices));
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npm") is None, reason="needs Node")
def test_three_js_shows_what_the_runtime_shows(tmp_path, run, clip):
    """Also between two frames, for it blends joints and morph targets."""
    subprocess.run(["npm", "install", "--silent", "three"], check=True, cwd=tmp_path)
    (tmp_path / "play.mjs").write_text(PLAY)
    render.main(["skirt", "--motions", "dance_3", "--frames", "60", "--out", str(tmp_path / "a.glb"), "--skinned"])
    shown = np.asarray(inference.animate(loading.load(run), clip)[0])
    for frame in (17, 40.5):
        command = ["node", "play.mjs", "a.glb", str(frame / 30)]
        done = subprocess.run(command, check=True, cwd=tmp_path, capture_output=True, text=True)
        between = shown[int(frame)] + frame % 1 * (shown[int(frame) + 1] - shown[int(frame)])
        assert apart(np.array(json.loads(done.stdout)), between) < 1.5e-3


@pytest.mark.slow
@pytest.mark.parametrize("garment", ["skirt", "tshirt"])
def test_every_garment_in_a_run(tmp_path, garment):
    """Also how far from singular the transforms are that are undone."""
    run = trained.find(garment)
    experiment, _ = rollouts.load_run(run)
    performance = pictures.perform_skinned(run, experiment, "run_3", 120)
    assert to_skinned_glb(tmp_path / "a.glb", performance)["garment"] <= 1e-3
    model, motion, reader = loading.load(run), performance.motion, Reader(tmp_path / "a.glb")
    shown = rollouts.psi_trajectory(model, assembly.motion(experiment, "run_3"))  # without the root's translation
    for frame in (0, 60, 119):
        assert apart(reader.vertices("garment", frame) - motion.translation[frame], shown[frame]) < 1.1e-3
        transforms = skinning.joint_transforms(motion.rotations[frame], model.wearer.joints, experiment.body.parents)
        blended = skinning.blend(jnp.asarray(performance.parts[-1].weights), transforms)
        assert np.linalg.det(blended[:, :, :3]).min() > 0.3
