"""Recordings as programs write them: one walk in many dialects comes out as the same walk, or is refused."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from recorded import CROSSED, KEPT, Take, joints, named, other_side, take, with_axes, write_bvh
from samples import AMC, ASF
from scipy.spatial.transform import Rotation

from clothjax.body.joint_names import CMU_FROM_SMPL
from clothjax.body.plausibility import body_kinematics, joint_positions, kinematics
from clothjax.files import storage
from data_prep import amass, asf_amc, bvh, procedural, program, rest_pose, retarget, skeleton
from data_prep.recording import Capture, resample
from data_prep.smpl import BODY

CASES = Path(__file__).parents[3] / "shared" / "cases"
CHESTS = {"Spine": "Chest", "Spine1": "Chest2"}
PELVIS = {"Hips": "pelvis", "Spine": "spine_01", "Spine1": "spine_02", "Neck": "neck_01", "Head": "head"}
SPINES = {"Hips": "spine", "Spine": "spine.001", "Spine1": "spine.002", "Neck": "neck", "Head": "head"}
LIMBS = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
XSENS = dict(zip(LIMBS, ("Collar", "Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle", "Toe")))
UNREAL = dict(zip(LIMBS, ("clavicle", "upperarm", "lowerarm", "hand", "thigh", "calf", "foot", "ball")))
UNITY = dict(zip(LIMBS, ("Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes")))
RIGIFY = dict(zip(LIMBS, ("shoulder", "upper_arm", "forearm", "hand", "thigh", "shin", "foot", "toe")))
BIPED = dict(zip(LIMBS, ("Clavicle", "UpperArm", "Forearm", "Hand", "Thigh", "Calf", "Foot", "Toe0")))


def skeleton_of(name):
    """A figure in a T-pose, in cm, +y up: (names, parents, offsets), its joints called by `name(side, part)`."""
    rows = [(name("", part), parent, offset) for part, parent, offset in (
        ("Hips", -1, (0, 0, 0)), ("Spine", 0, (0, 10, 0)), ("Spine1", 1, (0, 13, 0)), ("Neck", 2, (0, 27, 0)),
        ("Head", 3, (0, 10, 0)))]  # fmt: skip
    for side, sign in (("Left", 1), ("Right", -1)):
        for chain in (
            (("Shoulder", 2, (3, 22, 0)), ("Arm", 0, (14, 0, 0)), ("ForeArm", 0, (28, 0, 0)), ("Hand", 0, (25, 0, 0))),
            (("UpLeg", 0, (9, -4, 0)), ("Leg", 0, (0, -42, 0)), ("Foot", 0, (0, -40, 0)), ("ToeBase", 0, (0, -6, 13))),
        ):
            for k, (part, parent, (x, y, z)) in enumerate(chain):
                rows.append((name(side, part), parent if k == 0 else len(rows) - 1, (sign * x, y, z)))
    names, parents, offsets = zip(*rows)
    return names, np.array(parents), np.array(offsets, float)


def walk(frames=40, fps=30.0):
    """A walk of that figure: local rotations [T, n, 3, 3] from the T-pose, and a path [T, 3] in cm."""
    names, _, _ = skeleton_of(lambda side, part: side + part)
    phase = 2 * np.pi * np.arange(frames) / fps
    angles = {name: np.zeros((frames, 3)) for name in names}
    for side, sign in (("Left", 1), ("Right", -1)):
        swing = np.sin(phase) * sign
        angles[f"{side}UpLeg"][:, 0] = -30 * swing
        angles[f"{side}Leg"][:, 0] = 25 + 20 * np.cos(phase) * sign
        angles[f"{side}Foot"][:, 0] = -8 - 6 * swing
        angles[f"{side}Arm"] = np.stack([0 * phase, 15 * swing, np.full(frames, -60.0 * sign)], axis=1)
        angles[f"{side}ForeArm"][:, 1] = -sign * (35 + 15 * swing)
    angles["Spine"][:, 1], angles["Hips"][:, 1] = 6 * np.sin(phase), 20 - 6 * np.sin(phase)
    angles["Spine1"][:, 0], angles["Neck"][:, 0] = 4.0, -3.0
    rotations = np.stack([Rotation.from_euler("zyx", a[:, ::-1], degrees=True).as_matrix() for a in angles.values()], 1)
    path = np.stack([4 * np.sin(phase), 92 + 2 * np.cos(2 * phase), 110 * np.arange(frames) / fps], axis=1)
    return rotations, path


def write(path, names, parents, offsets, rotations, translation, *, fps=30.0, order="zxy", top="", moving=False):
    """Write a BVH file; `top` is a joint above the hips, and with `moving` all joints have channels of position."""
    places = np.tile(offsets, (len(translation), 1, 1))
    places[:, 0] = translation
    channels = np.full(len(names), moving) | (parents < 0)
    if top:
        names, parents, channels = (top, *names), np.array([-1, *(parents + 1)]), np.array([True, *channels])
        places = np.concatenate([0 * places[:, :1], places], axis=1)
        rotations = np.concatenate([np.tile(np.eye(3), (len(places), 1, 1, 1)), rotations], axis=1)
    taken = Take(names, parents, places, rotations, channels)
    write_bvh(path, taken, f"{1 / fps:.7f}", [order] * len(names))


def dialect(path, *, turn=None, own=None, name=lambda side, part: side + part, scale=1.0, fps=30.0, **written):
    """Write the walk in other world axes (a rotation), other axes of each joint (rotations [n, 3, 3]), names, units."""
    names, parents, offsets = skeleton_of(name)
    rotations, translation = walk(int(40 * fps / 30), fps)
    turn = np.eye(3) if turn is None else turn
    own = np.tile(np.eye(3), (len(names), 1, 1)) if own is None else own
    rotations[:, 0] = turn @ rotations[:, 0]
    before = np.where((parents < 0)[:, None, None], np.eye(3), own[np.maximum(parents, 0)])
    rotations = np.swapaxes(before, -1, -2) @ rotations @ own
    offsets = np.einsum("nba,nb->na", before, offsets)
    write(path, names, parents, scale * offsets, rotations, scale * translation @ turn.T, fps=fps, **written)
    return path


def own_axes(random=None):
    """Axes of joints whose bones lie along their own x; with `random`, any axes at all."""
    names, parents, offsets = skeleton_of(lambda side, part: side + part)
    if random is not None:
        return Rotation.random(len(names), random_state=random).as_matrix()
    axes = np.tile(np.eye(3), (len(names), 1, 1))
    for j, name in enumerate(names):
        children = [c for c, p in enumerate(parents) if p == j]
        trunk = not name.startswith(("Left", "Right"))
        end = np.array([0.0, 1, 0]) if trunk else offsets[children[0]] if children else None
        if end is not None:
            axes[j] = np.roll(Rotation.align_vectors(end[None], [[0, 0, 1.0]])[0].as_matrix(), 1, axis=1)
        elif parents[j] >= 0:
            axes[j] = axes[parents[j]]
    return axes


def retargeted(path, rig, **options):
    """Joint positions [T, J, 3] m of a file's motion on a body."""
    capture = bvh.read_bvh(path)
    motion = retarget.retarget(capture, *rig, about=str(path), **options)
    return joint_positions(motion, rig.body), motion


def beyond(rig):
    """Fingers and toes, which stay as they are on hands and feet."""
    return [j for j, name in enumerate(rig.names) if any(part in name for part in ("Finger", "Thumb", "Toe"))]


@pytest.fixture(scope="module")
def rig():
    return storage.load_rig("body")


@pytest.fixture(scope="module")
def plain(rig, tmp_path_factory):
    return retargeted(dialect(tmp_path_factory.mktemp("plain") / "walk.bvh"), rig)[0]


Z_UP = Rotation.from_euler("x", 90, degrees=True).as_matrix()
DIALECTS = {
    "z up": {"turn": Z_UP},
    "x up": {"turn": Rotation.from_euler("z", -90, degrees=True).as_matrix()},
    "y down": {"turn": np.diag([1.0, -1, -1])},
    "metres": {"scale": 0.01},
    "inches": {"scale": 1 / 2.54},
    "120 Hz": {"fps": 120.0},
    "rotations in another order": {"order": "xyz"},
    "Mixamo": {"name": lambda side, part: f"mixamorig1:{side}{part}"},
    "Xsens": {"name": lambda side, part: side + (XSENS | CHESTS).get(part, part)},
    "Unreal": {"name": lambda side, part: f"{UNREAL[part]}_{side[0].lower()}" if side else PELVIS[part]},
    "Bandai-Namco": {"name": lambda side, part: f"{UNITY[part]}_{side[0]}" if side else part,
                     "top": "joint_Root", "moving": True},
    "VRoid": {"name": lambda side, part: f"J_Bip_{side[0]}_{UNITY[part]}" if side else f"J_Bip_C_{part}"},
    "Rigify": {"name": lambda side, part: f"DEF-{RIGIFY[part]}.{side[0]}" if side else f"DEF-{SPINES[part]}"},
    "Biped": {"name": lambda side, part: f"Bip01 {side[0]} {BIPED[part]}" if side else f"Bip01 {part}"},
    "a root above the hips": {"top": "reference", "moving": True},
    "places without offsets": {"moving": True},
    "bones along x": {"own": own_axes()},
    "bones along x, z up": {"own": own_axes(), "turn": Z_UP},
    "any axes": {"own": own_axes(3)},
}  # fmt: skip


@pytest.mark.parametrize("kind", DIALECTS)
def test_a_walk_is_the_same_in_every_dialect(kind, plain, rig, tmp_path):
    found, _ = retargeted(dialect(tmp_path / "walk.bvh", **DIALECTS[kind]), rig)
    far = np.linalg.norm(found[: len(plain)] - plain, axis=-1)
    assert np.delete(far, beyond(rig), axis=1).max() < 0.01 and far.max() < 0.02  # m
    bones = rig.body.parents > 0

    def direction(positions):
        bone = positions[:, bones] - positions[:, rig.body.parents[bones]]
        return bone / np.maximum(np.linalg.norm(bone, axis=-1, keepdims=True), 1e-9)

    cosine = np.sum(direction(found[: len(plain)]) * direction(plain), axis=-1)
    still = np.linalg.norm(direction(plain), axis=-1) < 0.5  # joints at one place
    assert np.degrees(np.arccos(np.clip(np.where(still, 1.0, cosine), -1, 1))).max() < 3.0 + 3.0 * ("axes" in kind)


def test_an_axis_may_be_said(plain, rig, tmp_path):
    path = dialect(tmp_path / "walk.bvh")
    found, _ = retargeted(path, rig, axes=retarget.Axes("y", "x"))
    turned = Rotation.from_euler("y", -90, degrees=True).as_matrix()
    np.testing.assert_allclose(found - found[:, :1], (plain - plain[:, :1]) @ turned.T, atol=1e-4)
    with pytest.raises(ValueError, match=r"walk\.bvh: y is up, so --forward -y cannot be"):
        retargeted(path, rig, axes=retarget.Axes(None, "-y"))


def test_an_axis_that_the_figure_does_not_stand_along_is_refused(rig, tmp_path):
    path = dialect(tmp_path / "walk.bvh")
    with pytest.raises(ValueError, match=r"walk\.bvh: --up z, but its figure stands along y; --allow"):
        retargeted(path, rig, axes=retarget.Axes("z"))
    retargeted(path, rig, axes=retarget.Axes("z"), allow=True)


def test_what_was_read_off_the_frames_is_told(rig, tmp_path):
    for options, told in (
        ({}, []),
        ({"turn": Z_UP}, ["z is up, for the figure stands along it; --up says otherwise"]),
        ({"own": own_axes(3)}, ["its rest pose is no T-pose; trunk and shoulders are taken to be straight in frame "]),
    ):
        lines = []
        retargeted(dialect(tmp_path / "walk.bvh", **options), rig, tell=lines.append)
        assert len(lines) == len(told) and all(map(str.startswith, lines, told))


def test_a_rest_pose_may_face_another_way(plain, rig, tmp_path):
    """The heading of the zero pose is not that of the motion."""
    turned = np.tile(Rotation.from_euler("y", 70, degrees=True).as_matrix(), (21, 1, 1))
    found, _ = retargeted(dialect(tmp_path / "walk.bvh", own=turned), rig)
    np.testing.assert_allclose(found, plain, atol=1e-3)


@pytest.mark.parametrize(
    "names, told",
    [
        (lambda side, part: other_side(side + part), "toes point backward"),
        (
            lambda side, part: other_side(side + part) if part in LIMBS[:4] else side + part,
            "arms are on the other side",
        ),
    ],
)
def test_names_of_the_other_side_are_refused(names, told, rig, tmp_path):
    path = dialect(tmp_path / "walk.bvh", name=names)
    with pytest.raises(ValueError, match=rf"walk\.bvh: {told}.*left and right are exchanged.*rename"):
        retargeted(path, rig)
    retargeted(path, rig, allow=True)


def test_knees_that_bend_forward_are_refused(rig, tmp_path):
    """Where there are no toes, knees show that x is negated."""
    rows = dict(zip(("names", "parents", "offsets"), skeleton_of(lambda side, part: side + part)))
    kept = [j for j, name in enumerate(rows["names"]) if "Toe" not in name]
    names, parents = tuple(rows["names"][j] for j in kept), [rows["parents"][j] for j in kept]
    rotations, path = walk()
    mirror = np.diag([-1.0, 1, 1])
    for sign, fine in ((np.eye(3), True), (mirror, False)):
        above = np.array([-1 if parent < 0 else kept.index(parent) for parent in parents])
        moved = (sign @ rotations @ sign)[:, kept]
        write(tmp_path / "walk.bvh", names, above, rows["offsets"][kept] @ sign, moved, path @ sign)
        if fine:
            retargeted(tmp_path / "walk.bvh", rig)
        else:
            with pytest.raises(ValueError, match=r"walk\.bvh: knees bend forward: left and right"):
                retargeted(tmp_path / "walk.bvh", rig)


def test_a_result_that_differs_from_its_recording_is_refused(rig, tmp_path):
    path = dialect(tmp_path / "walk.bvh")
    capture = bvh.read_bvh(path)
    _, motion = retargeted(path, rig)
    of_file, of_body = (
        skeleton.find(*pair) for pair in ((capture.names, capture.parents), (rig.names, rig.body.parents))
    )
    shown = rest_pose.figure(capture, capture.rotations, capture.translation)
    compared = (motion, rig.body, of_body, shown, of_file, "walk.bvh")
    retarget.compare(*compared, 0.0)
    arm = rig.names.index("LeftArm")
    motion.rotations[:, arm] = motion.rotations[:, arm] @ Rotation.from_euler("z", 30, degrees=True).as_matrix()
    with pytest.raises(ValueError, match=r"walk\.bvh: the left .*arm would be (2|3)\d degrees off: in frame"):
        retarget.compare(*compared, 0.0)
    retarget.compare(*compared, 15.0)  # that was asked for


def test_all_that_is_missing_is_told_at_once_and_a_mapping_file_is_begun(rig, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    odd = {"LeftArm": "Bone.012", "RightForeArm": "Bone.044", "Head": "Bone.001"}
    path = dialect(tmp_path / "walk.bvh", name=lambda side, part: odd.get(side + part, side + part))
    arguments = bvh.Arguments(motion=path, output=tmp_path / "out.h5")
    with pytest.raises(ValueError, match=r"walk\.bvh: .*left upper arm.*right forearm.*walk_joints\.yaml") as told:
        program.retarget_as_asked(bvh.read_bvh(path), rig, arguments, path)
    assert "Bone.044" in str(told.value)
    draft = (tmp_path / "walk_joints.yaml").read_text()
    assert "left upper arm:\n" in draft and "left forearm" in draft
    (tmp_path / "walk_joints.yaml").write_text("# filled in\n")
    with pytest.raises(ValueError, match=r"walk_joints\.yaml"):
        program.retarget_as_asked(bvh.read_bvh(path), rig, arguments, path)
    assert (tmp_path / "walk_joints.yaml").read_text() == "# filled in\n"
    filled = tmp_path / "map.yaml"
    names, parents, _ = skeleton_of(lambda side, part: odd.get(side + part, side + part))
    rows = skeleton.find(*skeleton_of(lambda side, part: side + part)[:2]).limbs
    filled.write_text("\n".join(f"{part}: {names[joint]}" for part, joint in rows.items()) + "\nhead: Bone.001\n")
    assert skeleton.mapped(names, parents, filled).limbs == rows
    filled.write_text(f"left shin: {names[rows['left thigh']]}\nleft thigh: {names[rows['left shin']]}\n")
    with pytest.raises(ValueError, match=r"map\.yaml: .*the left shin, does not hang on .*the left thigh"):
        skeleton.mapped(names, parents, filled)
    filled.write_text("left wing: Bone.012\n")
    with pytest.raises(ValueError, match=r"map\.yaml: no parts: left wing"):
        skeleton.mapped(names, parents, filled)
    filled.write_text("head: Bone.999\n")
    with pytest.raises(ValueError, match=r"map\.yaml: no joints of the recording: Bone\.999"):
        skeleton.mapped(names, parents, filled)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
def test_byte_order_marks(encoding, plain, rig, tmp_path):
    path = dialect(tmp_path / "walk.bvh")
    text = path.read_text()
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    path.write_bytes((mark + text).encode(encoding))
    np.testing.assert_allclose(retargeted(path, rig)[0], plain, atol=1e-6)
    packed = tmp_path / "walk.bvh.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    np.testing.assert_allclose(retargeted(packed, rig)[0], plain, atol=1e-6)


@pytest.mark.parametrize("duration", ["33.3333", "1", "0.00001"])
def test_a_frame_time_in_other_units_is_refused(duration, tmp_path):
    path = dialect(tmp_path / "walk.bvh")
    path.write_text(path.read_text().replace(f"Frame Time: {1 / 30:.7f}", f"Frame Time: {duration}"))
    with pytest.raises(ValueError, match=r"walk\.bvh, line \d+: a Frame Time of .* it is in seconds"):
        bvh.read_bvh(path)


@pytest.mark.parametrize(
    "text, fps, told",
    [("0.0083333", 120.0, False), ("0.033", 30.0, True), ("0.0417", 24.0, False), ("0.008", 120.0, True),
     ("0.033367", 29.97, False), ("0.02", 50.0, False), ("8.3333e-3", 120.0, False)],
)  # fmt: skip
def test_a_rounded_frame_time_is_that_of_a_usual_rate(text, fps, told, tmp_path):
    path, lines = dialect(tmp_path / "walk.bvh"), []
    path.write_text(path.read_text().replace(f"Frame Time: {1 / 30:.7f}", f"Frame Time: {text}"))
    assert bvh.read_bvh(path, lines.append).fps == pytest.approx(fps, abs=0.011)
    assert [f"taken as {fps:g} frames a second" in line for line in lines] == [True] * told


@pytest.mark.parametrize("fps", [30.0, 120.0])
def test_an_added_t_pose_is_told(fps, tmp_path, capsys):
    names, parents, offsets = skeleton_of(lambda side, part: side + part)
    rotations, path = walk(60, fps)
    added = np.concatenate([np.tile(np.eye(3), (1, len(names), 1, 1)), rotations]), np.concatenate([path[:1], path])
    for told, (turned, places) in ((False, (rotations, path)), (True, added)):
        write(tmp_path / "walk.bvh", names, parents, offsets, turned, places, fps=fps)
        bvh.main(bvh.Arguments(tmp_path / "walk.bvh", tmp_path / "walk.h5"))
        assert ("walk.bvh: frame 0 is far from the next" in capsys.readouterr().out) is told
        bvh.main(bvh.Arguments(tmp_path / "walk.bvh", tmp_path / "walk.h5", skip=1))
        assert "frame 0" not in capsys.readouterr().out


def test_resampling_keeps_what_is_smooth():
    """Between frames of 24 Hz a swing of 1 Hz is met within a tenth of a degree: on chords it would be off by 0.4."""
    time = np.arange(49) / 24
    swing = np.zeros((49, 1, 3))
    swing[:, 0, 0] = np.radians(50) * np.sin(2 * np.pi * time)
    capture = Capture(
        ("Hips",), np.array([-1]), np.zeros((1, 3)), Rotation.from_rotvec(swing[:, 0]).as_matrix()[:, None],
        np.sin(2 * np.pi * time)[:, None] * [1.0, 0, 0], 24.0,
    )  # fmt: skip
    found = resample(capture, 30.0)
    new = np.arange(5, 55) / 30  # but at the ends
    angle = Rotation.from_matrix(found.rotations[5:55, 0]).as_rotvec(degrees=True)[:, 0]
    np.testing.assert_allclose(angle, 50 * np.sin(2 * np.pi * new), atol=0.1)
    np.testing.assert_allclose(found.translation[5:55, 0], np.sin(2 * np.pi * new), atol=0.002)


# What hangs together otherwise


def carried(taken, above, beside=(), turn=None):
    """A recording below joints that are still, with others beside the figure; the path stays on its hips."""
    count, n = len(taken.places), len(above)
    turns = np.tile(np.eye(3) if turn is None else turn, (count, 1, 1, 1))
    rest = np.tile(np.eye(3), (count, len(beside), 1, 1))
    back = np.swapaxes(turns[:, 0], -1, -2)
    rotations, places = taken.rotations.copy(), taken.places.copy()
    rotations[:, 0], places[:, 0] = back @ rotations[:, 0], np.einsum("tab,tb->ta", back, places[:, 0])
    others = np.tile(np.eye(3), (count, n - 1, 1, 1))
    return Take(
        (*above, *taken.names, *beside),
        np.array([*range(-1, n - 1), *np.where(taken.parents < 0, n - 1, taken.parents + n), *[0] * len(beside)]),
        np.concatenate([np.zeros((count, n, 3)), places, np.zeros((count, len(beside), 3))], axis=1),
        np.concatenate([turns, others, rotations, rest], axis=1),
        np.array([True] * n + [*(taken.parents < 0)] + [False] * len(beside)),
    )


@pytest.mark.parametrize(
    "above, beside, turn",
    [(("root",), ("ik_foot_root", "ik_hand_root"), None), (("Armature", "root"), (), None),
     (("Armature", "root"), ("Camera",), Z_UP)],
)  # fmt: skip
def test_the_path_is_that_of_the_hips_whatever_they_hang_on(above, beside, turn, rig, tmp_path):
    taken = take("walk", 0, 30)
    write_bvh(tmp_path / "plain.bvh", taken, "0.0333333", ["zxy"] * len(taken.names))
    both = carried(taken, above, beside, turn)
    write_bvh(tmp_path / "carried.bvh", both, "0.0333333", ["zxy"] * len(both.names))
    wanted, found = (retargeted(tmp_path / f"{name}.bvh", rig)[0] for name in ("plain", "carried"))
    np.testing.assert_allclose(found, wanted, atol=2e-3)
    assert np.ptp(found[:, 0, 2]) > 1


def test_a_second_figure_is_told(tmp_path):
    taken, lines = take("walk", 0, 30), []
    n = len(taken.names)
    both = Take(
        ("Scene", *(f"A:{name}" for name in taken.names), *(f"B:{name}" for name in taken.names)),
        np.concatenate([[-1], *(np.where(taken.parents < 0, 0, taken.parents + k) for k in (1, 1 + n))]),
        np.concatenate([0 * taken.places[:, :1], taken.places, taken.places], axis=1),
        np.concatenate([np.tile(np.eye(3), (len(taken.places), 1, 1, 1)), taken.rotations, taken.rotations], axis=1),
        np.array([True, *taken.moving, *taken.moving]),
    )  # fmt: skip
    write_bvh(tmp_path / "two.bvh", both, "0.0333333", ["zxy"] * len(both.names))
    capture = bvh.read_bvh(tmp_path / "two.bvh", lines.append)
    assert len(capture.names) == n
    assert lines == ["there are two figures: that of A:Hips is taken, that of B:Hips is left out"]


@pytest.mark.parametrize("leg", ["Hip,Knee,Ankle,Toe", "Leg,Knee,Ankle,Toe"])
def test_an_arm_may_hang_on_a_shoulder_and_bend_at_an_elbow(leg, plain, rig, tmp_path):
    parts = dict(zip(LIMBS, ("Shoulder", "Arm", "Elbow", "Wrist", *leg.split(","))))
    path = dialect(tmp_path / "walk.bvh", name=lambda side, part: side + parts.get(part, part))
    np.testing.assert_allclose(retargeted(path, rig)[0], plain, atol=1e-4)


def test_a_scheme_that_skips_a_known_joint_is_none():
    """From a shoulder to an elbow, with an arm between."""
    other = {"Shoulder": "Collar", "Arm": "Shoulder", "ForeArm": "Elbow", "Hand": "Wrist"}
    names, parents, _ = skeleton_of(lambda side, part: side + other.get(part, part))
    assert names[skeleton.find(names, parents).limbs["left upper arm"]] == "LeftShoulder"
    other |= {"Shoulder": "Shoulder", "Arm": "UpperArm"}
    names, parents, _ = skeleton_of(lambda side, part: side + other.get(part, part))
    with pytest.raises(ValueError, match="no joint is known as left upper arm"):
        skeleton.find(names, parents)


def test_hips_carry_legs_and_chest(rig):
    """As in Character Creator: hip -> {pelvis -> legs, waist}."""
    names, parents, _ = skeleton_of(lambda side, part: side + part)
    below = np.array([-1, 0, *(1 if p == 0 and name.endswith("UpLeg") else 0 if p == 0 else p + 1
                               for name, p in zip(names[1:], parents[1:]))])  # fmt: skip
    parts = skeleton.find(("CC_Base_Hip", "CC_Base_Pelvis", *names[1:]), below)
    assert parts.hips == 0 and len(parts.spine) == 2


def test_positions_may_be_added_to_the_offsets(plain, rig, tmp_path):
    """Millimetres of noise are no places on the parents."""
    path = dialect(tmp_path / "walk.bvh")
    capture = bvh.read_bvh(path)
    added = 0.2 * np.random.default_rng(0).normal(size=(len(capture.translation), len(capture.names), 3))
    added[:, 0] = capture.translation
    taken = Take(capture.names, capture.parents, added, capture.rotations, np.full(len(capture.names), True))
    write_bvh(path, taken, "0.0333333", ["zxy"] * len(capture.names))
    lines = path.read_text().splitlines()
    for k, words in enumerate(map(str.split, lines)):
        if words[0] in ("ROOT", "JOINT"):
            lines[k + 2] = "OFFSET {} {} {}".format(*capture.offsets[capture.names.index(words[1])])
    path.write_text("\n".join(lines))
    found, _ = retargeted(path, rig)
    assert np.delete(np.linalg.norm(found - plain, axis=-1), beyond(rig), axis=1).max() < 0.01  # m


def test_angles_that_may_be_radians_are_told(tmp_path):
    path, lines = dialect(tmp_path / "walk.bvh"), []
    bvh.read_bvh(path, lines.append)
    assert lines == []
    text = path.read_text().splitlines()
    at = text.index("MOTION") + 3
    rows = np.array([line.split() for line in text[at:]], float)
    rows[:, 3:] = np.radians(rows[:, 3:])
    path.write_text("\n".join([*text[:at], *(" ".join(map(str, row)) for row in rows)]))
    bvh.read_bvh(path, lines.append)
    assert len(lines) == 1 and "are they in radians?" in lines[0]


@pytest.mark.parametrize("kind, frame", [("twist", 50), ("run", 20)])
def test_a_frame_of_the_motion_is_no_t_pose(kind, frame, rig, tmp_path):
    taken, lines = named(take(kind, 0, 30), {name: name for name in KEPT}), []
    world = kinematics(taken.rotations, taken.places[:, 0], taken.places[0], taken.parents)[0]
    turned = with_axes(taken, np.swapaxes(world[frame], -1, -2))
    write_bvh(tmp_path / "walk.bvh", turned, "0.0333333", ["zxy"] * len(turned.names))
    found, _ = retargeted(tmp_path / "walk.bvh", rig, tell=lines.append)
    assert any("its rest pose is no T-pose" in line for line in lines)
    at = [rig.names.index(name) for name in ("RightArm", "LeftArm")]
    line, wanted = (x[:, at[1]] - x[:, at[0]] for x in (found, joints(kind, 0, 30)))
    cosine = np.sum(rest_pose.unit(line) * rest_pose.unit(wanted), axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 8


def test_forearms_that_end_in_no_joint_are_refused_where_they_are_not_seen(rig, tmp_path):
    names, parents, offsets = skeleton_of(lambda side, part: side + part)
    kept = [j for j, name in enumerate(names) if not name.endswith("Hand")]
    above = np.array([-1 if parents[j] < 0 else kept.index(parents[j]) for j in kept])
    rotations, path = walk()
    for own, fine in ((np.tile(np.eye(3), (len(names), 1, 1)), True), (own_axes(3), False)):
        before = np.where((parents < 0)[:, None, None], np.eye(3), own[np.maximum(parents, 0)])
        turned = np.swapaxes(before, -1, -2) @ rotations @ own
        places = np.einsum("nba,nb->na", before, offsets)[kept]
        write(tmp_path / "walk.bvh", tuple(names[j] for j in kept), above, places, turned[:, kept], path)
        if fine:
            retargeted(tmp_path / "walk.bvh", rig)
        else:
            with pytest.raises(
                ValueError, match=r"walk\.bvh: it has no hands, and its rest pose is no T-pose.*--allow"
            ):
                retargeted(tmp_path / "walk.bvh", rig)


def test_what_is_no_recording_is_refused_with_what_to_do(rig, tmp_path):
    path = dialect(tmp_path / "walk.bvh")
    with pytest.raises(ValueError, match=r"--skip -5: give how many"):
        bvh.main(bvh.Arguments(path, tmp_path / "m.h5", skip=-5))
    with pytest.raises(ValueError, match=r"walk\.bvh: a motion has two frames at least, not 1"):
        bvh.main(bvh.Arguments(path, tmp_path / "m.h5", skip=39))
    capture = bvh.read_bvh(path)
    capture.offsets[[capture.names.index(f"{side}UpLeg") for side in ("Left", "Right")]] = 0
    with pytest.raises(ValueError, match=r"walk: LeftUpLeg and RightUpLeg are at one place: export it"):
        retarget.retarget(capture, *rig, about="walk")
    packed = tmp_path / "packed.bvh"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert bvh.read_bvh(packed).names == capture.names
    data = gzip.compress(path.read_bytes())
    for damaged in (data[:500], data[:200] + bytes(100) + data[300:]):
        packed.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"packed\.bvh: cannot be read"):
            bvh.read_bvh(packed)
    for begin, told in ((b"glTF", "a glTF file"), (b"Kaydara FBX Binary", "an FBX file")):
        (tmp_path / "other.bvh").write_bytes(begin + bytes(100))
        with pytest.raises(ValueError, match=rf"other\.bvh: {told}"):
            bvh.read_bvh(tmp_path / "other.bvh")


def test_a_motion_that_would_not_be_read_again_is_not_written(rig, tmp_path):
    motion = procedural.generate("walk", 0, 2.0)
    high = motion._replace(translation=motion.translation + [0, 30.0, 0])
    with pytest.raises(ValueError, match=r"walk\.bvh: the hips would be 3\d m above the ground"):
        program.write_motion(tmp_path / "m.h5", high, rig, Path("walk.bvh"), program.OutputOptions())
    assert not (tmp_path / "m.h5").exists()


def test_a_mapping_file_is_utf_8_everywhere(tmp_path, monkeypatch):
    """Where the system's encoding is another one, too."""
    monkeypatch.chdir(tmp_path)
    write_text, read_text = Path.write_text, Path.read_text
    monkeypatch.setattr(Path, "write_text", lambda path, text, encoding="ascii": write_text(path, text, encoding))
    monkeypatch.setattr(Path, "read_text", lambda path, encoding="ascii": read_text(path, encoding))
    names, parents, _ = skeleton_of(lambda side, part: f"骨{side}X{part}")
    with pytest.raises(ValueError, match="walk_joints"):
        program.known_parts(names, parents, None, Path("walk.bvh"))
    with pytest.raises(ValueError, match=r"walk_joints\.yaml: no joint is known as"):
        program.known_parts(names, parents, Path("walk_joints.yaml"), Path("walk.bvh"))
    assert "骨LeftXArm" in (tmp_path / "walk_joints.yaml").read_bytes().decode("utf-8")


# ASF and AMC


@pytest.mark.parametrize("said", ["radians", "degrees"])
def test_an_angle_that_two_files_have_in_other_units_is_refused(said, tmp_path):
    (tmp_path / "a.asf").write_text(ASF if said == "radians" else ASF.replace("angle deg", "angle rad"))
    (tmp_path / "a.amc").write_text(AMC.replace(":DEGREES", f":{said.upper()}"))
    with pytest.raises(ValueError, match=rf"a\.amc, line \d: :{said.upper()}, but its skeleton is in"):
        asf_amc.read_amc(tmp_path / "a.amc", asf_amc.read_asf(tmp_path / "a.asf"))
    with pytest.raises(ValueError, match=r"a\.amc, line \d+: no complete :hierarchy .no bones: no ASF file"):
        asf_amc.read_asf(tmp_path / "a.amc")
    (tmp_path / "a.asf").write_text(ASF)
    with pytest.raises(ValueError, match=r"a\.amc: --source-fps 1: give"):
        asf_amc.read_amc(tmp_path / "a.amc", asf_amc.read_asf(tmp_path / "a.asf"), 1.0)


# AMASS


def recording(tmp_path, poses, **arrays):
    motion = procedural.generate("walk", 0, 2.0)
    trans = motion.translation[:60] @ Z_UP.T
    np.savez(tmp_path / "walk.npz", **{"poses": poses, "trans": trans, "mocap_framerate": 30.0} | arrays)
    return tmp_path / "walk.npz"


@pytest.fixture
def poses():
    """Axis-angle [T, 22, 3] of a figure that stands upright, z up, and moves."""
    random, frames = np.random.default_rng(0), 60
    angles = 0.3 * np.sin(np.arange(frames)[:, None, None] / 9 + random.uniform(0, 6, (22, 3)))
    angles[:, 0] = (Rotation.from_matrix(Z_UP) * Rotation.from_rotvec(angles[:, 0])).as_rotvec()
    return angles


@pytest.mark.parametrize("kind", ["flat", "quaternions", "quaternions, angle last", "matrices"])
def test_poses_are_told_apart_by_shape_and_norm(kind, poses, tmp_path):
    turns = Rotation.from_rotvec(poses.reshape(-1, 3))
    last = turns.as_quat().reshape(60, 22, 4)
    other = {
        "flat": poses.reshape(60, -1),
        "quaternions": last[..., [3, 0, 1, 2]],
        "quaternions, angle last": last.reshape(60, -1),
        "matrices": turns.as_matrix().reshape(60, 22, 3, 3),
    }[kind]
    wanted = amass.read_amass(recording(tmp_path, poses))
    found = amass.read_amass(recording(tmp_path, other))
    np.testing.assert_allclose(found.rotations, wanted.rotations, atol=1e-6)
    np.testing.assert_allclose(wanted.rotations[:, 0, 1, 1], 1.0, atol=0.3)  # it stands


@pytest.fixture
def bent(poses):
    """The same with knees and elbows that bend as those of a body."""
    for name, bend in (("left_knee", [1, 0, 0]), ("right_knee", [1, 0, 0]), ("left_elbow", [0, -1, 0]),
                       ("right_elbow", [0, 1, 0])):  # fmt: skip
        poses[:, BODY.index(name)] = np.abs(poses[:, BODY.index(name), :1]) * bend
    return poses


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("kind", ["columns", "rows", "alternating"])
def test_two_columns_are_converted(kind, flat, bent, tmp_path):
    matrices = Rotation.from_rotvec(bent.reshape(-1, 3)).as_matrix().reshape(60, 22, 3, 3)
    sixes = {
        "columns": np.concatenate([matrices[..., 0], matrices[..., 1]], axis=-1),
        "rows": np.concatenate([matrices[..., 0, :], matrices[..., 1, :]], axis=-1),
        "alternating": matrices[..., :2].reshape(60, 22, 6),
    }[kind]
    wanted = amass.read_amass(recording(tmp_path, bent))
    found = amass.read_amass(recording(tmp_path, sixes.reshape(60, -1) if flat else sixes))
    np.testing.assert_allclose(found.rotations, wanted.rotations, atol=1e-6)


@pytest.mark.parametrize("kind", ["inverse", "x negated", "sides exchanged", "degrees"])
def test_what_no_body_does_is_refused(kind, bent, tmp_path):
    other = {
        "inverse": -bent,
        "x negated": bent * [1, -1, -1],
        "sides exchanged": bent[:, [BODY.index(CROSSED[name]) for name in BODY]],
        "degrees": np.degrees(bent),
    }[kind]
    told = "in degrees" if kind == "degrees" else "bend the wrong way"
    with pytest.raises(ValueError, match=rf"walk\.npz: .*{told}.*[Cc]onvert it"):
        amass.read_amass(recording(tmp_path, other))
    amass.read_amass(recording(tmp_path, bent))


def test_an_axis_of_amass_that_figures_do_not_stand_along_is_refused(bent, tmp_path):
    with pytest.raises(ValueError, match=r"walk\.npz: --up y, but its figure stands along z; --allow"):
        amass.read_amass(recording(tmp_path, bent), "y")
    amass.read_amass(recording(tmp_path, bent), "y", allow=True)


def test_one_that_lies_is_asked_about(bent, tmp_path):
    """A body on its back is upright along a horizontal axis of the file; only its height tells."""
    back = Rotation.from_euler("x", -90, degrees=True)
    lying = bent.copy()
    lying[:, 0] = (back * Rotation.from_rotvec(bent[:, 0])).as_rotvec()
    path = recording(tmp_path, lying, trans=np.tile([0.3, 0.2, 0.12], (len(bent), 1)))
    with pytest.raises(ValueError, match=r"walk\.npz: .*give --up z if the figure lies or crawls, --up -?[xy] if it"):
        amass.read_amass(path)
    found = amass.read_amass(path, "z").rotations
    upright = found[:, 0, :, 1]
    assert np.abs(upright[:, 1]).max() < 0.5  # +y is up in the result


@pytest.mark.parametrize("path", [[0.0, 0.1, 0.0], [0.5, 0.15, 0.9]])
def test_one_that_lies_in_a_file_with_a_t_pose_is_asked_about(path, rig, tmp_path):
    lying = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    taken = take("walk", 3, 60)
    rotations, places = taken.rotations.copy(), taken.places.copy()
    rotations[:, 0], places[:, 0] = lying @ rotations[:, 0], np.array(path)
    taken = taken._replace(rotations=rotations, places=places)
    file = tmp_path / "walk.bvh"
    write_bvh(file, taken, "0.0166667", ["zxy"] * len(taken.names))
    with pytest.raises(ValueError, match=r"walk\.bvh: .*its rest pose has y up: give --up y if it lies or crawls"):
        retargeted(file, rig)
    found, _ = retargeted(file, rig, axes=retarget.Axes("y"))
    head, hips = (found[:, rig.names.index(name)] for name in ("Head", "Hips"))
    assert np.abs((head - hips)[:, 1]).max() < 0.2


def test_a_file_with_y_up_shows_it(poses, tmp_path):
    wanted = amass.read_amass(recording(tmp_path, poses))
    turned = poses.copy()
    turned[:, 0] = (Rotation.from_matrix(Z_UP.T) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    motion = procedural.generate("walk", 0, 2.0)
    found = amass.read_amass(recording(tmp_path, turned, trans=motion.translation[:60]))
    np.testing.assert_allclose(found.rotations, wanted.rotations, atol=1e-6)
    np.testing.assert_allclose(found.translation, wanted.translation, atol=1e-6)


def test_what_is_no_axis_angle_is_refused(poses, tmp_path):
    matrices = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(60, 22, 3, 3)
    unclear = np.concatenate([matrices[..., 0], matrices[..., 1]], axis=-1)  # knees bend to both sides
    for other in (unclear, unclear.reshape(60, -1), matrices[:, :, :2], 2 * matrices, poses[:, :20]):
        with pytest.raises(ValueError, match=r"walk\.npz: poses"):
            amass.read_amass(recording(tmp_path, other))


@pytest.mark.parametrize("kind", ["flat matrices", "quaternions", "6D", "longer quaternions", "noisy 6D"])
def test_only_the_joints_of_the_body_show_what_poses_are(kind, bent, tmp_path):
    """Hands without rotations, lengths that are not 1, and noise as of a network."""
    turns = Rotation.from_rotvec(bent.reshape(-1, 3))
    matrices, noise = turns.as_matrix().reshape(60, 22, 3, 3), np.random.default_rng(0).normal(size=(60, 22, 6))
    six, fours = matrices[..., :2].reshape(60, 22, 6), turns.as_quat().reshape(60, 22, 4)

    def with_hands(x):
        return np.concatenate([x, np.zeros((60, 2, x.shape[-1]))], axis=1).reshape(60, -1)

    other = {
        "flat matrices": matrices.reshape(60, -1),
        "quaternions": with_hands(fours),
        "6D": with_hands(six),
        "longer quaternions": with_hands(1.05 * fours),
        "noisy 6D": (six + 0.01 * noise).reshape(60, -1),
    }[kind]
    wanted, found = (amass.read_amass(recording(tmp_path, each)).rotations for each in (bent, other))
    np.testing.assert_allclose(found, wanted, atol=0.08 if "noisy" in kind else 1e-6)
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=1e-6)


def test_what_turns_no_body_so_is_refused(bent, tmp_path):
    taken = take("walk", 0, 30)
    at = [taken.names.index(CMU_FROM_SMPL[name]) for name in BODY]
    places = joints("walk", 0, 30)[:60, at]
    with pytest.raises(ValueError, match=r"walk\.npz: poses .* are where joints are"):
        amass.read_amass(recording(tmp_path, places - places[:, :1]))
    world = bent.copy()
    world[:, 1:] = world[:, :1]  # each turned as the pelvis, upright in z
    with pytest.raises(ValueError, match=r"walk\.npz: poses .* are no rotations of a known kind: .*spine1.*--allow"):
        amass.read_amass(recording(tmp_path, world))
    amass.read_amass(recording(tmp_path, world), allow=True)
    fours = Rotation.from_rotvec(bent.reshape(-1, 3)).as_quat().reshape(60, 22, 4)
    fours[7, 4] = 0
    with pytest.raises(ValueError, match=r"walk\.npz: poses of frame 7, left_knee, are no rotation"):
        amass.read_amass(recording(tmp_path, fours))


@pytest.mark.parametrize(
    "rates, told",
    [({"mocap_framerate": 1 / 120}, "not a rate in Hz"), ({"mocap_framerate": 1.0}, "not a rate in Hz"),
     ({"mocap_framerate": 30.0, "fps": 60.0}, r"mocap_framerate, fps has 2 rates, as \[30\.0, 60\.0\]"),
     ({"mocap_framerate": np.arange(60.0)}, "has 60 rates")],
)  # fmt: skip
def test_rates_that_are_none_or_differ_are_refused(rates, told, poses, tmp_path):
    with pytest.raises(ValueError, match=rf"walk\.npz: .*{told}"):
        amass.read_amass(recording(tmp_path, poses, **rates))
    assert amass.read_amass(recording(tmp_path, poses, mocap_framerate=np.full(60, 30.0))).fps == 30


def test_files_without_frames_or_of_another_kind_are_refused(poses, tmp_path):
    for count in (0, 1):
        path = recording(tmp_path, poses[:count], trans=np.zeros((count, 3)))
        with pytest.raises(ValueError, match=rf"walk\.npz: a motion has two frames at least, not {count}"):
            amass.read_amass(path)
    np.save(tmp_path / "motion.npy", poses)
    with pytest.raises(ValueError, match=r"motion\.npy: not a motion of AMASS: an \.npz file of poses"):
        amass.read_amass(tmp_path / "motion.npy")


def test_centimetres_are_noticed(poses, tmp_path):
    wanted = amass.read_amass(recording(tmp_path, poses))
    path = recording(tmp_path, poses, trans=100 * procedural.generate("walk", 0, 2.0).translation[:60] @ Z_UP.T)
    with pytest.raises(ValueError, match=r"walk\.npz: trans looks like centimetres.*--units cm"):
        amass.read_amass(path)
    found = amass.read_amass(path, units="cm")
    np.testing.assert_allclose(found.translation, wanted.translation, atol=1e-6)


# The cases that were accepted and wrong


@pytest.mark.skipif(not CASES.is_dir(), reason="needs the files in ../shared/cases")
@pytest.mark.parametrize(
    "case", ["bones_along_x", "byte_order_mark", "positions_without_offsets", "root_above_hips",
             "shoulder_is_upper_arm", "z_up"]
)  # fmt: skip
def test_the_cases_are_the_plain_walk(case, rig):
    plain, _ = retargeted(CASES / "plain/walk.bvh", rig)
    for path in sorted((CASES / f"bvh_{case}").glob("*.bvh")):
        found, _ = retargeted(path, rig)
        assert np.delete(np.linalg.norm(found - plain, axis=-1), beyond(rig), axis=1).max() < 0.01, path


def scrambled(capture):
    """The same positions of joints, each of which is turned about itself as it likes; a helper turns what it carries
    back."""
    count, frames, random = len(capture.names), len(capture.translation), np.random.default_rng(4)
    angles = np.radians(120) * np.sin(0.2 * np.arange(frames)[:, None] + random.uniform(0, 6, count))
    about = random.normal(size=(count, 3))
    about /= np.linalg.norm(about, axis=1, keepdims=True)
    turns = Rotation.from_rotvec((angles[..., None] * about).reshape(-1, 3)).as_matrix().reshape(frames, count, 3, 3)
    names, parents, offsets, rotations, place = [], [], [], [], {}
    for j, parent in enumerate(capture.parents):
        if parent >= 0:
            names.append(f"helper{j}")
            parents.append(place[parent])
            offsets.append(np.zeros(3))
            rotations.append(np.swapaxes(turns[:, parent], -1, -2))
        place[j] = len(names)
        names.append(capture.names[j])
        parents.append(place[j] - 1)
        offsets.append(capture.offsets[j])
        rotations.append(capture.rotations[:, j] @ turns[:, j])
    return capture._replace(
        names=tuple(names), parents=np.array(parents), offsets=np.array(offsets), rotations=np.stack(rotations, axis=1)
    )


@pytest.mark.parametrize("turn", [np.eye(3), Z_UP], ids=["y up", "z up"])
def test_rotations_that_mean_nothing_are_refused_or_left(turn, plain, rig, tmp_path):
    capture = scrambled(bvh.read_bvh(dialect(tmp_path / "walk.bvh", turn=turn)))
    with pytest.raises(ValueError, match=r"walk: the \S+.* would be \d+ degrees off: .*--by-positions leaves"):
        retarget.retarget(capture, *rig, about="walk")
    motion = retarget.retarget(capture, *rig, about="walk", by_positions=True)
    found = joint_positions(motion, rig.body)
    assert np.delete(np.linalg.norm(found - plain, axis=-1), beyond(rig), axis=1).max() < 0.04  # m, at the head
    turned = apart(motion, retarget.retarget(bvh.read_bvh(tmp_path / "walk.bvh"), *rig), rig)
    assert all(turned[name] < 1 for name in ("LeftArm", "RightForeArm", "LeftUpLeg", "RightLeg"))
    assert all(turned[name] < 5 for name in ("Hips", "Spine1", "Head", "LeftFoot"))


def apart(one, other, rig):
    """How far joints of two motions are turned apart at most, in degrees by name; both have to turn them."""
    worlds = [body_kinematics(motion, rig.body)[0] for motion in (one, other)]
    np.testing.assert_allclose(np.linalg.det(worlds[0]), 1, atol=1e-4)
    turned = Rotation.from_matrix((np.swapaxes(worlds[0], -1, -2) @ worlds[1]).reshape(-1, 3, 3)).magnitude()
    return dict(zip(rig.names, np.degrees(turned.reshape(-1, len(rig.names)).max(axis=0)), strict=True))


def test_straight_limbs_are_turned_as_in_the_frames_around_or_a_t_pose(rig, tmp_path):
    """A T-pose comes first, then a walk with an arm that never bends."""
    capture = bvh.read_bvh(dialect(tmp_path / "walk.bvh"))
    at = {
        name: capture.names.index(name) for name in ("LeftForeArm", "RightArm", "RightForeArm", "LeftUpLeg", "LeftLeg")
    }
    capture.rotations[:, at["LeftForeArm"]] = np.eye(3)
    for name in ("RightArm", "RightForeArm", "LeftUpLeg", "LeftLeg"):
        capture.rotations[:12, at[name]] = np.eye(3)
    motion = retarget.retarget(scrambled(capture), *rig, about="walk", by_positions=True)
    turned = apart(motion, retarget.retarget(capture, *rig), rig)
    assert all(turned[name] < 40 for name in ("LeftArm", "RightArm", "LeftUpLeg"))  # a straight limb does not show it


def test_limbs_keep_their_turn_while_they_are_straight(rig, tmp_path):
    """An arm that is turned about itself, is straight for a while, and hangs on a shrug; legs that kick."""
    capture = bvh.read_bvh(dialect(tmp_path / "walk.bvh"))

    def turned_by(name, axis, degrees, frames=slice(None)):
        joint = capture.names.index(name)
        capture.rotations[frames, joint] @= Rotation.from_euler(axis, degrees, degrees=True).as_matrix()

    turned_by("RightArm", "x", 60)
    turned_by("RightForeArm", "y", 50)
    turned_by("RightShoulder", "z", -25)
    capture.rotations[20:30, capture.names.index("RightForeArm")] = np.eye(3)
    capture.rotations[20:25, [capture.names.index(name) for name in ("LeftLeg", "LeftFoot")]] = np.eye(3)
    turned_by("LeftUpLeg", "x", -90, slice(20, 25))  # the foot points up
    turned_by("RightUpLeg", "z", -60, slice(30, 35))  # the foot rolls with its leg
    found = apart(
        retarget.retarget(scrambled(capture), *rig, about="walk", by_positions=True),
        retarget.retarget(capture, *rig),
        rig,
    )
    assert found["RightArm"] < 10 and found["RightForeArm"] < 10
    assert found["RightShoulder"] < 12  # of a shrug of 25; by rotations the bones of clavicles are not aligned
    assert all(found[side + part] < 8 for side in ("Left", "Right") for part in ("UpLeg", "Leg", "Foot"))


def test_a_recording_without_a_head_is_taken_by_positions(rig, tmp_path):
    capture = bvh.read_bvh(dialect(tmp_path / "walk.bvh"))
    kept = [j for j, name in enumerate(capture.names) if "Head" not in name]
    place = {j: k for k, j in enumerate(kept)}
    without = capture._replace(
        names=tuple(capture.names[j] for j in kept),
        parents=np.array([place.get(capture.parents[j], -1) for j in kept]),
        offsets=capture.offsets[kept],
        rotations=capture.rotations[:, kept],
    )
    parts = skeleton.find(without.names, without.parents, allow=True)
    motion = retarget.retarget(without, *rig, parts, by_positions=True)
    turned = apart(motion, retarget.retarget(without, *rig, parts), rig)
    assert turned["LeftArm"] < 1 and turned["RightLeg"] < 1 and turned["Spine1"] < 5
    with pytest.raises(ValueError, match=r"walk: it has neither spine nor neck"):
        retarget.retarget(without, *rig, parts._replace(spine=(), neck=()), by_positions=True, about="walk", allow=True)


def test_by_positions_is_an_option_of_the_program(tmp_path, monkeypatch):
    path, given = dialect(tmp_path / "walk.bvh"), []
    monkeypatch.setattr(program, "retarget", lambda *arguments, **options: given.append(options) or "motion")
    monkeypatch.setattr(bvh, "write_motion", lambda *arguments: None)
    bvh.main(bvh.Arguments(path, tmp_path / "m.h5", by_positions=True))
    assert given[0]["by_positions"]
