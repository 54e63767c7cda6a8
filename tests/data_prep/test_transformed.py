"""Right inputs, transformed at random: each comes out right, is refused with a remedy, or the doubt is told.

A draw is a number: `python -m pytest tests/data_prep/test_transformed.py -m slow -k bvh-17` makes it again.
"""

import contextlib
import io
import itertools
import re
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from recorded import (
    CROSSED,
    SCHEMES,
    X_NEGATED,
    after_a_t_pose,
    below,
    in_mirror,
    joints,
    named,
    other_side,
    reordered,
    smpl_joints,
    smpl_poses,
    take,
    turned,
    with_axes,
    write_bvh,
)
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from clothjax.body.plausibility import joint_positions
from clothjax.files import storage
from data_prep import amass, bvh, placement, procedural, skeleton, user_mesh
from data_prep.retarget import leg_length
from data_prep.smpl import BODY

FAST = {"bvh": 24, "amass": 8, "mesh": 8}  # draws of every day
ALL = {"bvh": 1200, "amass": 300, "mesh": 500}
NEAR, ALIKE = 0.01, 3.0  # m of a joint, degrees of a bone, that a right result may be off
RATES = (24, 25, 30, 50, 60, 100, 120)  # Hz
UNITS = {"m": 1.0, "cm": 100.0, "mm": 1000.0, "in": 1 / 0.0254}  # in a metre
ORDERS = ["".join(order) for order in itertools.permutations("xyz")]
QUARTERS = Rotation.create_group("O").as_matrix()
AXES = ("x", "-x", "y", "-y", "z", "-z")
TURNED_X = Rotation.from_euler("x", 90, degrees=True).as_matrix()  # +y becomes +z
EXCUSED = 5.0  # times these, where it is told that no more can be known
REFUSED = "$ never"  # no line has it
REMEDY = re.compile(
    r"--(up|units|joints|allow|skip|shift|turn|sew|vertices)\b|rename|cut|convert it|move ", re.IGNORECASE
)
ARMS = ("Shoulder", "Arm", "Hand", "Finger", "Thumb")
WRONG_PATH = r"\bfeet\b|no foot|m/s"  # of doubts
FORMS = (
    "axis-angle",
    "quaternions",
    "quaternions, angle first",
    "matrices",
    "6D",
    "6D in rows",
    "6D, alternating",
    "degrees",
)


class Outcome(NamedTuple):
    """What a program made of a file: `right`, `refused`, `told` or `silently wrong`; and in words."""

    kind: str
    words: str

    @classmethod
    def of_refusal(cls, path, error, reason):
        """What a refusal is: it names the file and a remedy, and there is a reason for it."""
        if not reason:
            return cls("refused without a reason", str(error))
        fine = path.name in str(error) and REMEDY.search(str(error))
        return cls("refused" if fine else "refused without a remedy", str(error))


def yaw(degrees):
    return Rotation.from_euler("y", degrees, degrees=True).as_matrix()


def drawn(random, *choices, often=0.5):
    """The first choice often, else one of the others."""
    return choices[0] if random.random() < often else choices[1 + random.integers(len(choices) - 1)]


def other_axis(random, up):
    """An axis that is not nearest to a direction."""
    nearest = "-" * bool(up[np.abs(up).argmax()] < 0) + "xyz"[int(np.abs(up).argmax())]
    return str(random.choice([axis for axis in AXES if axis != nearest]))


def judged(path, program, error_of, must, may=(), reason=""):
    """Run a program on a file.

    Args:
        path: of the file.
        program: to run.
        error_of: returns the error of the result, at most 1 if it is right, and in words.
        must: patterns of what has to be printed, whatever the result; REFUSED for what has to be refused.
        may: patterns of what excuses an error of at most EXCUSED.
        reason: for a refusal of a file that is not wrong.
    """
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            program()
    except ValueError as error:
        return Outcome.of_refusal(path, error, must or reason)
    (wrong, words), said = error_of(), printed.getvalue()
    untold = [pattern for pattern in must if not re.search(pattern, said)]
    excused = wrong <= EXCUSED and any(re.search(pattern, said) for pattern in may)
    fine = not untold and (wrong <= 1 or excused or must)
    kind = "silently wrong" if not fine else "told" if must or wrong > 1 else "right"
    return Outcome(kind, f"{words}; not told: {untold}; {said}")


# Recordings


def far_off(output, wanted, bones):
    """Measure how far the motion in a file is from joint positions [T, J, 3] m, but for the heading and the place.

    Args:
        output: file of the motion.
        wanted: at 30 Hz.
        bones: pairs of joints.
    """
    rig = storage.load_rig("body")
    found = joint_positions(storage.load_motion(output, rig.names), rig.body)
    count = min(len(found), len(wanted))
    if abs(len(found) - len(wanted)) > 1:
        return np.inf, f"{len(found)} frames, expected {len(wanted)}"
    known = sorted({joint for bone in bones for joint in bone})
    found, wanted = found[:count], wanted[:count]
    mine, true = (x[:, known] - x[:, known].mean(axis=(0, 1)) for x in (found, wanted))
    a, b = (x[..., 2] + 1j * x[..., 0] for x in (mine, true))
    turn = yaw(np.degrees(np.angle(np.vdot(a, b))))
    far = np.linalg.norm(mine @ turn.T - true, axis=-1).max()
    one, other = (np.stack([x[:, end] - x[:, start] for start, end in bones], axis=1) for x in (found @ turn.T, wanted))
    cosine = np.sum(one * other, axis=-1) / np.linalg.norm(one, axis=-1) / np.linalg.norm(other, axis=-1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1))).max(axis=0)
    worst = "-".join(rig.names[joint] for joint in bones[int(angle.argmax())])
    return max(far / NEAR, angle.max() / ALIKE), f"{1e3 * far:.0f} mm, {angle.max():.1f} degrees of {worst}"


def bones_of(names, parents):
    """Pairs of the body's joints that are apart, of joints with CMU's names."""
    own = storage.load_rig("body")
    number, at = [own.names.index(name) for name in names], np.asarray(own.body.joints)
    pairs = [(number[parent], number[j]) for j, parent in enumerate(parents) if parent >= 0]
    return [(a, b) for a, b in pairs if np.linalg.norm(at[a] - at[b]) > 0.01]


def of_bvh(number, folder):
    """Write a BVH file of a draw, and see what the program makes of it."""
    random = np.random.default_rng([1, number])
    kind, seed, fps = str(random.choice(procedural.KINDS)), int(number >= FAST["bvh"]), int(random.choice(RATES))
    taken, must, may, options = take(kind, seed, fps), [], [], {}
    bones = bones_of(taken.names, taken.parents)
    wanted = joints(kind, seed, 30)

    mirror = drawn(random, "no", "whole", "x negated", "names", "names of arms", often=0.8)
    if mirror in ("whole", "x negated"):
        taken = in_mirror(taken)
    if mirror == "names of arms":
        arms = [any(part in name for part in ARMS) for name in taken.names]
        taken = taken._replace(names=tuple(other_side(n) if arm else n for n, arm in zip(taken.names, arms)))
    elif mirror in ("whole", "names"):
        taken = taken._replace(names=tuple(map(other_side, taken.names)))
    if mirror == "whole":
        wanted = joints(kind, seed, 30, True)
    elif mirror != "no":
        must.append(REFUSED)

    scheme = str(random.choice(list(SCHEMES)))
    if SCHEMES[scheme]:
        short = named(taken, {name: name for name in SCHEMES[scheme]})
        bones = bones_of(short.names, short.parents)
        taken = named(taken, SCHEMES[scheme])
    if random.random() < 0.05:
        taken, scheme = taken._replace(names=tuple(f"Bone.{j:03}" for j in range(len(taken.names)))), "numbers"
        must.append(REFUSED)

    turn = QUARTERS[random.integers(24)] if random.random() < 0.5 else np.eye(3)
    turn = turn @ yaw(random.uniform(0, 360))
    if random.random() < 0.05:  # it lies
        taken, turn = turned(taken, TURNED_X.T), yaw(random.uniform(0, 360))
        taken.places[:, 0] += [0, 0.15 - taken.places[:, 0, 1].mean(), 0]
        must.append("the figure lies|is up, for")
    taken = turned(taken, turn)
    rest = drawn(random, "as it was", "turned too", "any axes", "quarter turns", often=0.4)
    if rest == "turned too":
        taken = with_axes(taken, np.tile(turn.T, (len(taken.names), 1, 1)))
    elif rest == "any axes":
        taken = with_axes(taken, Rotation.random(len(taken.names), random_state=random).as_matrix())
    elif rest == "quarter turns":
        taken = with_axes(taken, QUARTERS[random.integers(0, 24, len(taken.names))])
    if rest in ("any axes", "quarter turns"):
        may.append("its rest pose is no T-pose")
    above = drawn(random, "", "still", "path", "all", often=0.6)
    if above:
        taken = below(taken, str(random.choice(["Armature", "reference", "root", "joint_Root"])), above)
    if random.random() < 0.3:
        taken = taken._replace(moving=np.ones(len(taken.names), bool))
    if random.random() < 0.5:
        taken = reordered(taken, random)
    if random.random() < 0.1:
        taken = after_a_t_pose(taken)
        options |= drawn(random, {}, {"skip": 1})
        if not options:
            must.append("--skip 1")
            wanted = None
    units = str(random.choice(list(UNITS)))
    taken = taken._replace(places=UNITS[units] * taken.places)
    if random.random() < 0.05 and not above:
        taken.places[:, 0] *= drawn(random, 0.01, 100.0, 2.54, 1 / 2.54)
        must.append(WRONG_PATH)
    if random.random() < 0.05:
        options["up"] = other_axis(random, turn[:, 1])
        must.append(REFUSED)
    digits = int(random.integers(4, 9) if fps != 120 else random.integers(3, 9))
    orders = [str(random.choice(ORDERS)) for _ in taken.names]
    path = folder / f"take{number}.bvh"
    end = drawn(random, "\n", "\r\n")
    write_bvh(path, taken, f"{1 / fps:.{digits}f}", orders, bool(random.random() < 0.2), end)
    if random.random() < 0.2:
        path.write_bytes("\ufeff".encode() + path.read_bytes())
    output = folder / f"take{number}.h5"
    words = (
        f"{kind} {fps} Hz, {mirror} mirror, {scheme}, rest {rest}, {above or 'nothing'} above, {units} {options} {must}"
    )

    def error():
        return (0.0, "added pose") if wanted is None else far_off(output, wanted, bones)

    found = judged(path, lambda: bvh.main(bvh.Arguments(motion=path, output=output, **options)), error, must, may)
    return found._replace(words=f"{words}: {found.words}")


def of_amass(number, folder):
    """Write arrays as AMASS's of a draw, and see what the program makes of them."""
    random = np.random.default_rng([2, number])
    kind, seed, fps = str(random.choice(procedural.KINDS)), int(number >= FAST["amass"]), int(random.choice(RATES))
    turns, path = smpl_poses(kind, seed, fps)
    wanted, must, options = joints(kind, seed, 30), [], {}
    mirror = drawn(random, "no", "whole", "x negated", "names", often=0.7)
    if mirror in ("whole", "x negated"):
        turns, path = X_NEGATED @ turns @ X_NEGATED, path @ X_NEGATED
    if mirror in ("whole", "names"):
        turns = turns[:, [BODY.index(CROSSED.get(name, name)) for name in BODY]]
    if mirror == "whole":
        wanted = joints(kind, seed, 30, True)
    elif mirror != "no":
        must.append(REFUSED)
    form = str(random.choice(FORMS))
    if random.random() < 0.1 and "6D" not in form and mirror == "no":  # two such errors may undo each other
        turns = np.swapaxes(turns, -1, -2)
        must.append(REFUSED)
    axes = QUARTERS[random.integers(24)] if random.random() < 0.5 else TURNED_X
    turn = axes @ yaw(random.uniform(0, 360))
    if random.random() < 0.05:  # it lies
        turns[:, 0], path, turn = TURNED_X.T @ turns[:, 0], path @ TURNED_X, TURNED_X
        path += [0, 0.15 - path[:, 1].mean(), 0]
        must.append("is up, for")
    if drawn(random, False, True, often=0.95):
        path = path[:, [0, 2, 1]]
        must.append(WRONG_PATH)
    turns[:, 0], path = turn @ turns[:, 0], path @ turn.T
    count = int(random.choice([22, 24, 52, 55]))  # joints
    turns = np.concatenate([turns, np.tile(np.eye(3), (len(turns), count - 22, 1, 1))], axis=1)
    rotations = Rotation.from_matrix(turns.reshape(-1, 3, 3))
    arrays = {
        "axis-angle": rotations.as_rotvec,
        "degrees": lambda: rotations.as_rotvec(degrees=True),
        "quaternions": rotations.as_quat,
        "quaternions, angle first": lambda: rotations.as_quat()[:, [3, 0, 1, 2]],
        "matrices": rotations.as_matrix,
        "6D": lambda: np.concatenate([turns[..., 0], turns[..., 1]], axis=-1),
        "6D in rows": lambda: np.concatenate([turns[..., 0, :], turns[..., 1, :]], axis=-1),
        "6D, alternating": lambda: turns[..., :2],
    }[form]()
    shape = (len(path), count, 3, 3) if form == "matrices" else (len(path), count, -1)
    poses = arrays.reshape(shape)
    if form != "matrices" and random.random() < 0.5:
        poses = poses.reshape(len(path), -1)
    if form == "degrees":
        must.append(REFUSED)
    units = drawn(random, *UNITS, "ft", often=0.6)
    if units != "m":
        told = drawn(random, True, False)
        options |= {"units": units} if told else {}
        path = (UNITS | {"ft": 1 / 0.3048})[units] * path
        if not told:
            must.append(WRONG_PATH)
    if random.random() < 0.05:
        options["up"] = other_axis(random, turn[:, 1])
        must.append(REFUSED)
    rate = str(random.choice(amass.RATES))
    precision = random.choice([np.float32, np.float64])
    file, output = folder / f"take{number}.npz", folder / f"take{number}.h5"
    np.savez(file, poses=poses.astype(precision), trans=path.astype(precision), **{rate: float(fps)})
    names, body = storage.load_rig("body").names, storage.load_rig("body").body
    options["leg"] = leg_length(np.asarray(body.joints), skeleton.find(names, body.parents))
    found = judged(
        file,
        lambda: amass.main(amass.Arguments(motion=file, output=output, **options)),
        lambda: far_off(output, wanted, bones_of(*smpl_joints())),
        must,
        reason="straight knees" if form in ("6D", "6D in rows") and kind in ("arms", "twist") else "",
    )
    words = f"{kind} {fps} Hz, {mirror} mirror, {form} of {count}, {units} {options} {must}"
    return found._replace(words=f"{words}: {found.words}")


# Meshes


@cache
def worn(name):
    """Vertices [V, 3] m and faces of an embedded garment."""
    made = storage.load_garment(name, storage.load_rig("body").body)
    return np.asarray(made.vertices, np.float64), np.asarray(made.faces, np.int64)


def write_obj(path, vertices, parts):
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    for name, faces in parts:
        lines += [f"o {name}", *(f"f {a} {b} {c}" for a, b, c in faces + 1)]
    path.write_text("\n".join(lines) + "\n")


def with_remedies(path, answers):
    """Bring a mesh, and do what a refusal proposes, thrice at most; return the garment, its log, and the refusals."""
    rig, asked = storage.load_rig("body"), []
    for _ in range(4):
        try:
            return *user_mesh.bring(path, *rig, answers), asked
        except ValueError as error:
            words = str(error)
            flags = re.findall(r"--(units|up|turn|shift)((?: -?[\w.]+)+)", words)
            if not flags or len(asked) == 3:
                raise
            place = answers.placement
            for flag, value in flags:
                values = value.split()
                if flag == "shift":
                    place = place._replace(shift=tuple(float(x) for x in values[:3]))
                elif flag == "turn":
                    place = place._replace(turn=float(values[0]))
                else:
                    place = place._replace(**{flag: values[0]})
            answers = answers._replace(placement=place)
            asked.append(words)
    raise AssertionError("does not happen")


def outside(made):
    """Whether the faces of a garment look away from its middle."""
    corners = made.vertices[made.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.sum(normal * (corners.mean(axis=1) - made.vertices.mean(axis=0)) * [1, 0, 1]) > 0


def of_mesh(number, folder):
    """Write an OBJ file of a draw, and see what garment it becomes."""
    random = np.random.default_rng([3, number])
    name = str(random.choice(["tshirt_1000", "skirt_1000", "pants_1000", "dress_1000"]))
    vertices, faces = worn(name)
    mirror = drawn(random, "no", "whole", "x negated", often=0.7)
    if mirror != "no":
        vertices = vertices @ X_NEGATED
        faces = faces[:, ::-1] if mirror == "whole" else faces
    wanted, path = vertices, folder / f"{name}_{number}.obj"
    turn = drawn(random, np.eye(3), *QUARTERS)
    sizes = (-0.5, -0.2, -0.05, 0.05, 0.2, 0.5)  # m
    shift = drawn(random, np.zeros(3), *(size * np.eye(3)[axis] for axis in range(3) for size in sizes))
    vertices = (vertices + shift) @ turn.T
    flipped = drawn(random, np.zeros(len(faces), bool), np.ones(len(faces), bool), random.random(len(faces)) < 0.5)
    faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    if random.random() < 0.5:
        order = random.permutation(len(vertices))
        vertices, faces = vertices[order], np.argsort(order)[faces][random.permutation(len(faces))]
    parts = [("all", faces)]
    if random.random() < 0.5:
        left = vertices[faces].mean(axis=1) @ turn[:, 0] > 0
        parts = [("left", faces[left]), ("right", faces[~left])]
    if random.random() < 0.5:
        apart = [vertices[own].reshape(-1, 3) for _, own in parts]
        starts = np.cumsum([0, *map(len, apart)])
        vertices = np.concatenate(apart)
        parts = [(part, start + np.arange(own.size).reshape(-1, 3)) for (part, own), start in zip(parts, starts)]
    units = str(random.choice(list(UNITS)))
    write_obj(path, UNITS[units] * vertices, parts)
    answers = user_mesh.Answers(loose=False)
    if random.random() < 0.5:
        answers = answers._replace(placement=placement.Placement(units))
    place = f"turn {turn.round().astype(int).tolist()}, shift {shift.tolist()}, {units} as {answers.placement.units}"
    words = f"{name}, {mirror} mirror, {place}, {flipped.mean():.1f} flipped, {len(parts)} parts"
    moved = (turn != np.eye(3)).any() or shift.any()
    try:
        made, log, asked = with_remedies(path, answers)
    except ValueError as error:
        found = Outcome.of_refusal(path, error, moved)
        return found._replace(words=f"{words}: {error}")

    def far(others):
        return max(cKDTree(a).query(b)[0].max() for a, b in ((made.vertices, others), (others, made.vertices)))

    words = f"{words}: {1e3 * far(wanted):.0f} mm; {log}; {asked}"
    if far(wanted) < 0.005 and outside(made) and any(" 1 part," in line for line in log):
        return Outcome("right", words)
    may = "nearer|is it worn elsewhere"
    if far(wanted + np.array([0, made.vertices[:, 1].max() - wanted[:, 1].max(), 0])) < 0.012:
        may += "|worn from"  # at another height, and pushed out there, is a matter of design
    return Outcome("told" if any(re.search(may, line) for line in log) else "silently wrong", words)


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where drafts of mapping files go


OF = {"bvh": of_bvh, "amass": of_amass, "mesh": of_mesh}


@pytest.mark.parametrize(
    "what, number",
    [
        pytest.param(what, number, id=f"{what}-{number}", marks=[pytest.mark.slow] * (number >= FAST[what]))
        for what in OF
        for number in range(ALL[what])
    ],
)
def test_nothing_is_silently_wrong(what, number, tmp_path):
    outcome = OF[what](number, tmp_path)
    assert outcome.kind in ("right", "refused", "told"), outcome.words
