"""Bodies of the SMPL family and motions of AMASS, written here in the layout that they are published in."""

import collections
import gzip
import pickle
import shutil
import sys
import types

import numpy as np
import pytest
import recorded
import scipy.sparse
import trimesh
from samples import PARENTS, recording, smpl_regressor
from scipy.spatial.transform import Rotation

from clothjax.body import plausibility, skinning
from clothjax.files import storage
from clothjax.types import Pose
from data_prep import amass, skeleton, smpl


@pytest.fixture(scope="module")
def model():
    """A body of 24 joints with SMPL's arrays: an ellipsoid as high as a person."""
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.asarray(mesh.vertices) * [0.5, 0.85, 0.2]
    count = len(vertices)
    weights = np.zeros((count, 24))
    weights[np.arange(count)[:, None], rng.integers(0, 24, (count, 4))] = 1.0
    table = np.array([PARENTS, range(24)])
    table[0, 0] = 2**32 - 1
    return {
        "v_template": vertices,
        "f": np.asarray(mesh.faces, np.uint32),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "shapedirs": 0.01 * rng.normal(size=(count, 3, 12)),
        "posedirs": 0.01 * rng.normal(size=(count, 3, 207)),
        "J_regressor": smpl_regressor(vertices),
        "kintree_table": table,
        "bs_type": "lrotmin",
    }


class Ch:
    """What chumpy's class is to pickle."""

    def __init__(self, x):
        self.x, self._dirty_vars = x, "x"


@pytest.fixture
def published(model, tmp_path, monkeypatch):
    """The file as it is published: pickled, partly of chumpy, which is then not there to read it."""
    module = types.ModuleType("chumpy.ch")
    module.Ch = Ch
    monkeypatch.setattr(Ch, "__module__", "chumpy.ch")
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    path = tmp_path / "SMPL_FEMALE.pkl"
    path.write_bytes(pickle.dumps(model | {key: Ch(model[key]) for key in ("shapedirs", "v_template")}, protocol=2))
    monkeypatch.setitem(sys.modules, "chumpy", None)
    monkeypatch.setitem(sys.modules, "chumpy.ch", None)
    return path


def assert_is(body, model):
    np.testing.assert_allclose(body.vertices, model["v_template"], atol=1e-6)
    np.testing.assert_array_equal(body.faces, model["f"])
    np.testing.assert_allclose(body.joints, model["J_regressor"] @ model["v_template"], atol=1e-6)
    np.testing.assert_allclose(body.shapedirs, model["shapedirs"][..., :10], atol=1e-6)
    np.testing.assert_allclose(body.posedirs, model["posedirs"], atol=1e-6)
    np.testing.assert_allclose(body.weights, model["weights"], atol=1e-6)
    assert tuple(body.parents) == PARENTS


def test_a_pickled_body_becomes_a_body_file(published, model, tmp_path):
    smpl.main(smpl.Arguments(published, tmp_path / "body.h5"))
    body = storage.load_body(tmp_path / "body.h5")
    assert_is(body, model)
    names = storage.joint_names(tmp_path / "body.h5")
    assert names[:3] == ("pelvis", "left_hip", "right_hip") and len(names) == 24
    # joints of another shape are those that the regressor gives for its vertices
    betas = np.linspace(-2, 2, 10).astype(np.float32)
    regressed = model["J_regressor"] @ np.asarray(skinning.shaped_vertices(body, betas), np.float64)
    np.testing.assert_allclose(skinning.shaped_joints(body, betas), regressed, atol=1e-5)


@pytest.mark.parametrize("protocol", [2, 4, 5])
@pytest.mark.parametrize("sparse", ["csc_matrix", "csr_matrix", "csc_array", "csr_array"])
@pytest.mark.parametrize("kind", [dict, collections.OrderedDict])
def test_a_body_that_was_saved_anew_is_read(protocol, sparse, kind, model, tmp_path):
    regressor = getattr(scipy.sparse, sparse)(model["J_regressor"])
    saved = kind(model | {"J_regressor": regressor, "weights": np.asfortranarray(model["weights"])})
    (tmp_path / "SMPL.pkl").write_bytes(pickle.dumps(saved, protocol=protocol))
    assert_is(smpl.body(tmp_path / "SMPL.pkl")[0], model)


def test_expressions_are_no_shapes(model, tmp_path):
    """SMPL-X of 2019: ten of shape, then ten of expression."""
    count, random = len(model["v_template"]), np.random.default_rng(0)
    table = np.array([np.maximum(np.arange(55) - 1, 0), range(55)])
    whole = {key: model[key] for key in ("v_template", "f")} | {
        "weights": random.dirichlet(np.ones(55), count),
        "J_regressor": random.dirichlet(np.ones(count), 55),
        "shapedirs": random.normal(size=(count, 3, 20)),
        "kintree_table": table,
    }
    np.savez(tmp_path / "SMPLX.npz", **whole)
    assert smpl.body(tmp_path / "SMPLX.npz")[0].shapedirs.shape[-1] == 10
    with pytest.raises(ValueError, match=r"has 10 shape parameters \(the other 10 are of expressions\); --shapes 16"):
        smpl.body(tmp_path / "SMPLX.npz", shapes=16)


def test_an_npz_is_read_like_a_pickle(model, tmp_path):
    plain = model | {"J_regressor": model["J_regressor"].toarray()}
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **plain)
    body, _ = smpl.body(tmp_path / "SMPL_NEUTRAL.npz")
    assert_is(body, model)
    shutil.copy(tmp_path / "SMPL_NEUTRAL.npz", tmp_path / "CAPITALS.NPZ")
    assert_is(smpl.body(tmp_path / "CAPITALS.NPZ")[0], model)
    assert smpl.body(tmp_path / "SMPL_NEUTRAL.npz", shapes=12)[0].shapedirs.shape[-1] == 12
    with pytest.raises(ValueError, match=r"has 12 shape parameters; --shapes 13"):
        smpl.body(tmp_path / "SMPL_NEUTRAL.npz", shapes=13)
    assert len(smpl.NAMES[52]) == 52 and len(smpl.NAMES[55]) == 55


class Evil:
    def __init__(self, call, *arguments):
        self.reduced = (call, arguments)

    def __reduce__(self):
        return self.reduced


@pytest.mark.parametrize("call", [exec, eval, __import__, getattr, open])
def test_a_hostile_pickle_is_refused_and_not_run(call, model, tmp_path):
    path, trap = tmp_path / "evil.pkl", tmp_path / "trap"
    path.write_bytes(pickle.dumps(model | {"v_template": Evil(call, f"open({str(trap)!r}, 'w')")}))
    with pytest.raises(ValueError, match=r"evil\.pkl: not a body model .* do not trust it"):
        smpl.body(path)
    assert not trap.exists()


def test_a_pickle_that_wants_all_memory_is_refused(model, tmp_path):
    path = tmp_path / "huge.pkl"
    path.write_bytes(pickle.dumps(model | {"v_template": Evil(np.ndarray, (2**58,))}))
    with pytest.raises(ValueError, match=r"huge\.pkl"):
        smpl.body(path)


def test_a_sparse_array_that_reaches_out_of_itself_is_refused(model, tmp_path):
    path = tmp_path / "far.pkl"
    regressor = model["J_regressor"].copy()
    regressor.indices = regressor.indices + 2**24
    path.write_bytes(pickle.dumps(model | {"J_regressor": regressor}))
    with pytest.raises(ValueError, match=r"far\.pkl: .*ind"):
        smpl.body(path)


def test_a_truncated_file_is_refused_wherever_it_ends(published):
    whole = published.read_bytes()
    for end in np.linspace(0, len(whole) - 1, 40).astype(int):
        published.write_bytes(whole[:end])
        with pytest.raises(ValueError, match=r"SMPL_FEMALE\.pkl"):
            smpl.body(published)


@pytest.mark.parametrize(
    "key, value, said",
    [
        ("weights", np.ones((642, 7)) / 7, "has 7 joints"),
        ("weights", None, "has no weights"),
        ("v_template", np.ones((642, 2)), r"v_template has shape \(642, 2\)"),
        ("v_template", np.full((642, 3), np.nan), "v_template has an entry that is not finite"),
        ("f", np.full((5, 3), 642), "a face names vertex 642 of 642"),
        ("f", np.zeros((0, 3)), "f is empty"),
        ("kintree_table", np.array([range(24), range(24)]), "a parent does not come before its child"),
        ("J_regressor", np.ones((23, 642)), "J_regressor has shape"),
        ("shapedirs", np.array("x"), "shapedirs is not of numbers"),
    ],
)
def test_what_is_wrong_with_a_body_is_said(key, value, said, model, tmp_path):
    wrong = model | {"J_regressor": model["J_regressor"].toarray(), key: value}
    np.savez(tmp_path / "model.npz", **{k: v for k, v in wrong.items() if v is not None})
    with pytest.raises(ValueError, match=rf"model\.npz: .*{said}"):
        smpl.body(tmp_path / "model.npz")


HALF = np.diag([-1.0, 1, -1])
Z_UP = Rotation.from_euler("x", 90, degrees=True).as_matrix()
QUARTER, TILTED = (Rotation.from_euler(axis, 60, degrees=True).as_matrix() for axis in "yz")


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda model: {"v_template": 100 * model["v_template"]}, "it is 170 tall, which is not in m: scale"),
        (lambda model: {"v_template": model["v_template"] @ Z_UP.T}, "its head is not above its pelvis along .y: turn"),
        (lambda model: {"v_template": model["v_template"] @ HALF}, "it faces -z: turn"),
        (lambda model: {"v_template": model["v_template"] @ QUARTER.T}, "its hips are not along x: turn"),
        (
            lambda model: {"v_template": model["v_template"] @ TILTED.T},
            "its head is not above its pelvis along .y: turn",
        ),
        (lambda model: {"v_template": model["v_template"] * [-1, 1, 1]}, "its left is not at .x.*: it is mirrored"),
        (lambda model: {"f": model["f"][:, ::-1]}, "its faces are seen from inside: turn each around"),
        (lambda model: {"J_regressor": 2 * model["J_regressor"]}, "joint .*is outside of v_template"),
        (lambda model: {"weights": 2 * model["weights"]}, "weights of vertex .* sum to 2.*sum to 1"),
        (lambda model: {"weights": model["weights"] - 0.05}, "weights of vertex .* the least is -0.05"),
    ],
)
def test_what_is_no_body_in_our_axes_and_metres_is_not_written(change, said, model, tmp_path):
    model = model | {"J_regressor": model["J_regressor"].toarray()}
    np.savez(tmp_path / "model.npz", **(model | change(model)))
    with pytest.raises(ValueError, match=rf"model\.npz: {said}"):
        smpl.main(smpl.Arguments(tmp_path / "model.npz", tmp_path / "body.h5"))
    assert not (tmp_path / "body.h5").exists()


def test_a_packed_model_is_refused(model, tmp_path):
    (tmp_path / "model.pkl").write_bytes(gzip.compress(pickle.dumps(model)))
    with pytest.raises(ValueError, match=r"model\.pkl: .*it is packed by gzip: unpack it"):
        smpl.body(tmp_path / "model.pkl")


# Motion


def test_a_recording_moves_an_smpl_body_as_it_is(model, tmp_path):
    np.savez(tmp_path / "model.npz", **(model | {"J_regressor": model["J_regressor"].toarray()}))
    smpl.main(smpl.Arguments(tmp_path / "model.npz", tmp_path / "body.h5"))
    data = recording()
    np.savez(tmp_path / "clip.npz", **data)
    amass.main(amass.Arguments(tmp_path / "clip.npz", tmp_path / "out.h5", body=str(tmp_path / "body.h5")))
    motion = storage.load_motion(tmp_path / "out.h5", storage.joint_names(tmp_path / "body.h5"))
    assert motion.fps == 30 and len(motion.translation) == 31
    poses = data["poses"].reshape(121, 52, 3)[::4]
    for joint in (1, 2, 16, 17):
        found = Rotation.from_matrix(motion.rotations[:, joint]).as_rotvec()
        np.testing.assert_allclose(found, poses[:, joint], atol=1e-5)
    # up in z becomes up in y, and ahead in y becomes ahead in -z
    np.testing.assert_allclose(motion.rotations[:, 0], np.broadcast_to(np.eye(3), (31, 3, 3)), atol=1e-5)
    path = motion.translation - motion.translation[0]
    assert path[-1, 2] < -0.5 and abs(path[-1, 0]) < 1e-6 and np.ptp(path[:, 1]) < 0.1


def test_a_recording_moves_the_embedded_body_possibly(tmp_path):
    np.savez(tmp_path / "clip.npz", **recording())
    motion, (body, names) = amass.retarget_amass(amass.read_amass(tmp_path / "clip.npz"), "body")
    assert names == storage.joint_names("body")
    assert plausibility.bad_frames(motion, body).size == 0
    places = plausibility.joint_positions(motion, body)
    head, foot, hand, shoulder = (
        places[:, skeleton.cmu_names(names).index(joint)] for joint in ("Head", "LeftFoot", "LeftHand", "LeftArm")
    )
    assert (head[:, 1] - foot[:, 1] > 1.2).all()
    # the arm of a T-pose, lowered by 1.2 rad
    arm = (hand - shoulder) / np.linalg.norm(hand - shoulder, axis=-1, keepdims=True)
    np.testing.assert_allclose(arm, np.broadcast_to([np.cos(1.2), -np.sin(1.2), 0], arm.shape), atol=0.2)
    poses = [Pose(*frame) for frame in zip(motion.rotations, np.float32(motion.translation))]
    lowest = [float(skinning.pose_body(body, body.vertices, body.joints, pose)[:, 1].min()) for pose in poses[::5]]
    assert -0.03 < min(lowest) < 0.03


@pytest.mark.parametrize("scheme", ["Mixamo", "Unreal", "VRM", "SMPL"])
def test_a_recording_moves_a_body_of_other_names_alike(scheme, tmp_path):
    rig = storage.load_rig("body")
    other = [recorded.SCHEMES[scheme].get(name, name) for name in rig.names]
    about = {"name": "b", "source": "test", "licence": "CC0-1.0"}
    turn = storage.canonical_rotation("body")
    storage.save_body(tmp_path / "body.h5", rig.body, other, **about, canonical_rotation=turn)
    np.savez(tmp_path / "clip.npz", **recording())
    capture = amass.read_amass(tmp_path / "clip.npz")
    (expected, _), (found, _) = (amass.retarget_amass(capture, each) for each in ("body", tmp_path / "body.h5"))
    np.testing.assert_allclose(found.rotations, expected.rotations, atol=1e-5)
    np.testing.assert_allclose(found.translation, expected.translation, atol=1e-5)


def test_a_body_that_stands_on_its_origin_is_moved_as_one_that_hangs_on_it(tmp_path):
    body, names = storage.load_rig("body")
    up = np.float32([0.1, 0.9, 0.2])
    body = body._replace(vertices=body.vertices + up, joints=body.joints + up)
    about = {"name": "b", "source": "test", "licence": "CC0-1.0"}
    turn = storage.canonical_rotation("body")
    storage.save_body(tmp_path / "body.h5", body, names, **about, canonical_rotation=turn)
    np.savez(tmp_path / "clip.npz", **recording())
    capture, doubts = amass.read_amass(tmp_path / "clip.npz"), []
    motion, _ = amass.retarget_amass(capture, tmp_path / "body.h5", tell=doubts.append)
    hanging, _ = amass.retarget_amass(capture, "body")
    np.testing.assert_allclose(motion.translation + up, hanging.translation, atol=1e-5)
    assert doubts == []


def test_a_recording_that_is_up_in_y_can_be_told(tmp_path):
    data = recording(joints=55)
    data["mocap_frame_rate"] = data.pop("mocap_framerate")  # as of SMPL-X
    turn = Rotation.from_euler("x", -90, degrees=True)
    first = Rotation.from_rotvec(data["poses"][:, :3])
    data["poses"][:, :3] = (turn * first).as_rotvec()
    np.savez(tmp_path / "y.npz", **(data | {"trans": data["trans"] @ turn.as_matrix().T}))
    np.savez(tmp_path / "z.npz", **recording())
    one, other = amass.read_amass(tmp_path / "y.npz", up="y"), amass.read_amass(tmp_path / "z.npz")
    np.testing.assert_allclose(one.rotations, other.rotations, atol=1e-6)
    np.testing.assert_allclose(one.translation, other.translation, atol=1e-6)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"poses": None}, "no poses in it"),
        ({"mocap_framerate": None}, "no mocap_framerate in it"),
        ({"poses": np.zeros((121, 30))}, r"poses \(121, 30\): expected axis-angle"),
        ({"trans": np.zeros((120, 3))}, r"trans \(120, 3\)"),
        ({"mocap_framerate": np.array(0.0)}, "not a rate in Hz"),
        (
            {"trans": np.where(np.arange(121)[:, None] == 7, np.nan, np.zeros((121, 3)))},
            "trans of frame 7 is not finite",
        ),
        ({"poses": np.array([{}], object)}, "not a motion of AMASS"),
    ],
)
def test_what_is_wrong_with_a_recording_is_said(change, said, tmp_path):
    data = recording() | change
    np.savez(tmp_path / "clip.npz", **{k: v for k, v in data.items() if v is not None})
    with pytest.raises(ValueError, match=rf"clip\.npz: .*{said}"):
        amass.read_amass(tmp_path / "clip.npz")
