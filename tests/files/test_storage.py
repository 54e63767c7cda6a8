"""Files: round trips, and what is refused on opening and how."""

import h5py
import numpy as np
import pytest
from samples import spin as _spin
from samples import three_joints as _body
from samples import two_faces as _garment

from clothjax.body import plausibility
from clothjax.files import hdf5, storage


def _save(tmp_path, posed: bool = False):
    path = tmp_path / "body.h5"
    storage.save_body(path, _body(posed), ["root", "mid", "top"], name="b", source="test", licence="CC0-1.0")
    return path


@pytest.mark.parametrize("posed", [False, True])
def test_body_round_trip(tmp_path, posed):
    path = _save(tmp_path, posed)
    for wanted, found in zip(_body(posed), storage.load_body(path)):
        if wanted is None:
            assert found is None
        else:
            np.testing.assert_allclose(found, wanted, rtol=1e-6)
            assert found.dtype in (np.float32, np.int32)
    assert storage.joint_names(path) == ("root", "mid", "top")
    np.testing.assert_array_equal(storage.canonical_rotation(path), np.tile(np.eye(3), (3, 1, 1)))
    assert [p.name for p in tmp_path.iterdir()] == ["body.h5"]  # no partial file is left


def test_a_vertex_without_a_face_is_refused(tmp_path):
    body = _body()
    garment = _garment(body)._replace(faces=np.array([[0, 1, 2]], np.int32))
    storage.save_garment(tmp_path / "g.h5", garment, "abc", name="g", body="b", source="test", licence="CC0-1.0")
    with pytest.raises(ValueError, match=r"g\.h5: vertex 3 has no face"):
        storage.load_garment(tmp_path / "g.h5", body)


@pytest.mark.parametrize("cloth", [None, np.linspace(0.5, 20, 12, dtype=np.float32).reshape(4, 3)])
def test_garment_round_trip(tmp_path, cloth):
    body = _body()
    garment = _garment(body)._replace(cloth=cloth)
    storage.save_garment(tmp_path / "g.h5", garment, "abc", name="g", body="b", source="test", licence="CC0-1.0")
    loaded = storage.load_garment(tmp_path / "g.h5", body)
    assert (loaded.cloth is None) == (cloth is None)
    for wanted, found in zip(garment, loaded):
        if wanted is not None:
            np.testing.assert_allclose(found, wanted, rtol=1e-6)
    if cloth is not None:
        _edit(tmp_path / "g.h5", "cloth", _put((2, 1), 1e6))
        with pytest.raises(ValueError, match=r"g\.h5: dataset 'cloth' is 1e\+06 at \(2, 1\): a factor from 0\.01"):
            storage.load_garment(tmp_path / "g.h5", body)


def test_motion_round_trip(tmp_path):
    motion = _spin()
    storage.save_motion(tmp_path / "m.h5", motion, "abc", name="m", source="test", licence="CC0-1.0")
    found = storage.load_motion(tmp_path / "m.h5", ("a", "b", "c"))
    np.testing.assert_allclose(found.rotations, motion.rotations, atol=1e-6)
    np.testing.assert_array_equal(found.translation, motion.translation)
    assert found.fps == 30.0 and found.translation.dtype == np.float64 and found.rotations.dtype == np.float32


def _edit(path, name, value=None):
    with h5py.File(path, "r+") as file:
        old = file[name][()]
        del file[name]
        if value is not None:
            file[name] = value(old)


def _put(index, value):
    def change(array):
        array[index] = value
        return array

    return change


@pytest.mark.parametrize(
    "dataset, change, words",
    [
        ("shapedirs", None, ["shapedirs", "missing"]),
        ("shapedirs", lambda a: a[:5], ["shapedirs", "(5, 3, 2)", "B = 6"]),
        ("joint_shapedirs", lambda a: a[..., :1], ["joint_shapedirs", "S = 2"]),
        ("vertices", _put((4, 1), np.nan), ["vertices", "nan at (4, 1)"]),
        ("vertices", lambda a: a * 100, ["centimetres", "100"]),
        ("vertices", lambda a: a * 1000, ["millimetres", "1000"]),
        ("vertices", lambda a: a * 10, ["body height", "allowed"]),
        ("faces", _put((1, 2), 6), ["faces", "6 at (1, 2)", "0 to 5"]),
        ("faces", _put((1, 2), 3), ["face 1", "[3, 4, 3]"]),
        ("faces", lambda a: a.astype(np.float32), ["faces", "integers"]),
        ("weights_index", _put((2, 0), 3), ["weights_index", "3 at (2, 0)"]),
        ("weights_value", lambda a: a * 0.9, ["weights_value", "row 0", "sum to 1"]),
        ("weights_value", lambda a: a + np.float32([-2, 2]), ["weights_value", ">= 0"]),
        ("parents", _put(1, 2), ["parents", "joint 1"]),
        ("parents", _put(2, -1), ["parents", "joint 2"]),
    ],
)
def test_damaged_body_is_refused(tmp_path, dataset, change, words):
    path = _save(tmp_path)
    _edit(path, dataset, change)
    with pytest.raises(ValueError) as error:
        storage.load_body(path)
    for word in [str(path), *words]:
        assert word in str(error.value)


@pytest.mark.parametrize(
    "key, value, word",
    [
        ("format", "clothjax/garment", "clothjax/body"),
        ("version", 2, "version"),
        ("units", "cm", "units"),
        ("up", "+Z", "up"),
    ],
)
def test_wrong_attribute_is_refused(tmp_path, key, value, word):
    path = _save(tmp_path)
    with h5py.File(path, "r+") as file:
        file.attrs[key] = value
    with pytest.raises(ValueError, match=word):
        storage.load_body(path)


def test_other_makers_format_is_read(tmp_path):
    path = _save(tmp_path)
    with h5py.File(path, "r+") as file:
        file.attrs["format"] = "someone/body"
    assert storage.load_body(path).parents.tolist() == [-1, 0, 1]


def test_unreadable_files(tmp_path):
    path = _save(tmp_path)
    whole = path.read_bytes()
    for broken in (whole[: len(whole) // 2], b"", b"a text file"):
        path.write_bytes(broken)
        with pytest.raises(ValueError, match=r"body\.h5: not a readable HDF5 file"):
            storage.load_body(path)
    with pytest.raises(ValueError, match="no such file"):
        storage.load_body(tmp_path / "none.h5")


def test_failed_write_leaves_the_old_file(tmp_path):
    path = _save(tmp_path)
    before = path.read_bytes()
    with pytest.raises(ValueError):
        storage.save_body(path, _body()._replace(faces=[[0], [1, 2]]), "abc", name="b", source="t", licence="t")
    with pytest.raises(TypeError):  # fails inside HDF5, after the first datasets
        hdf5.write(path, "body", {"a": np.zeros(3), "b": np.array([object()])}, name="b")
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["body.h5"]


@pytest.mark.parametrize(
    "change, word",
    [
        (lambda g: g._replace(vertices=g.vertices + np.float32([0, 2, 0])), "align"),
        (lambda g: g._replace(vertices=g.vertices * 100), "centimetres"),
        (lambda g: g._replace(shapedirs=g.shapedirs[..., :1]), "S = 2"),
        (lambda g: g._replace(weights=np.eye(4, dtype=np.float32)), "weights_index"),
    ],
)
def test_garment_that_does_not_fit_its_body(tmp_path, change, word):
    body = _body()
    path = tmp_path / "g.h5"
    storage.save_garment(path, change(_garment(body)), "abc", name="g", body="b", source="test", licence="CC0-1.0")
    with pytest.raises(ValueError, match=word):
        storage.load_garment(path, body)


@pytest.mark.parametrize(
    "names, words",
    [
        ("ab", r"garment lacks \['c'\] and also has \[\]"),
        ("bac", "garment has another order"),
        (None, None),  # as files of before
    ],
)
def test_a_garment_of_another_skeleton_is_refused(tmp_path, names, words):
    body, path = _body(), tmp_path / "g.h5"
    storage.save_garment(path, _garment(body), names or "abc", name="g", body="b", source="test", licence="CC0-1.0")
    if words is None:
        _edit(path, "joint_names")
        storage.load_garment(path, body, "abc")
    else:
        storage.load_garment(path, body)  # whose names nobody knows
        with pytest.raises(ValueError, match=words):
            storage.load_garment(path, body, "abc")


@pytest.mark.parametrize(
    "motion, names, word",
    [
        (_spin(0), "abc", "no frames"),
        (_spin(fps=0.0), "abc", "fps"),
        (_spin(fps=np.nan), "abc", "fps"),
        (_spin()._replace(translation=np.full((5, 3), 95.0)), "abc", "centimetres"),
        (_spin(), "abd", r"lacks \['c'\] and also has \['d'\]"),
        (_spin(), "bac", "another order"),
    ],
)
def test_motion_that_is_refused(tmp_path, motion, names, word):
    path = tmp_path / "m.h5"
    storage.save_motion(path, motion, names, name="m", source="test", licence="CC0-1.0")
    with pytest.raises(ValueError, match=word):
        storage.load_motion(path, ("a", "b", "c"))


def test_asset_names_and_paths():
    assert storage.asset("walk_0").is_file() and storage.asset("body").is_file()
    assert str(storage.asset("my/own.h5")) == "my/own.h5"
    with pytest.raises(ValueError, match="tshirt_1000"):
        storage.asset("tshirt_999")


def test_every_asset_loads():
    body, names = storage.load_rig("body")
    assert storage.asset_names("body") == ("body",)
    for name in storage.asset_names("garment"):
        garment = storage.load_garment(name, body)
        assert garment.pinned.any() == name.startswith(("skirt", "pants"))
    assert {n.rpartition("_")[0] for n in storage.asset_names("motion")} >= {"walk", "run", "jump", "dance"}
    for name in storage.asset_names("motion"):
        motion = storage.load_motion(name, names)
        assert plausibility.bad_frames(motion, body).size == 0
    # canonical_rotation takes the A-pose's upper arm into the horizontal
    arm, elbow = names.index("LeftArm"), names.index("LeftForeArm")
    bone = storage.canonical_rotation("body")[arm] @ (body.joints[elbow] - body.joints[arm])
    np.testing.assert_allclose(bone / np.linalg.norm(bone), [1, 0, 0], atol=0.05)
