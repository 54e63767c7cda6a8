"""From a mesh that nobody of us made to a trained and exported model, by the four commands of the README."""

import shlex
import sys

import numpy as np
import onnxruntime
import pytest
import trimesh
from samples import SMALL, commands, run

from clothjax.files import storage


def cape() -> trimesh.Trimesh:
    """A cape: open in front, from the neck to the thighs, around all that is there but the arms."""
    body, names = storage.load_rig("body")
    joint = dict(zip(names, np.asarray(body.joints)))
    top, bottom = joint["Neck"][1], joint["LeftUpLeg"][1] - 0.05
    trunk = np.asarray(body.vertices)
    trunk = trunk[np.abs(trunk[:, 0]) < abs(joint["LeftArm"][0]) + 0.03]
    middle = joint["Spine"][2] if "Spine" in joint else joint["Hips"][2]
    heights = np.linspace(top, bottom, 26)
    radius = np.array(
        [np.hypot(trunk[:, 0], trunk[:, 2] - middle)[np.abs(trunk[:, 1] - y) < 0.02].max() for y in heights]
    )
    radius = np.maximum.accumulate(radius) + np.linspace(0.02, 0.10, len(heights))
    angles = np.radians(np.linspace(50, 310, 40))  # 0 is the front
    rows = [
        np.stack([r * np.sin(angles), np.full_like(angles, y), middle + r * np.cos(angles)], 1)
        for y, r in zip(heights, radius)
    ]
    return grid(np.stack(rows))


def grid(points: np.ndarray) -> trimesh.Trimesh:
    """The triangles of rows and columns of points [r, c, 3]."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (index[i : rows - 1 + i, j : columns - 1 + j].reshape(-1) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return trimesh.Trimesh(points.reshape(-1, 3), faces, process=False)


def layered_skirt() -> trimesh.Trimesh:
    """A skirt of two layers that do not touch, the outer one shorter."""
    inner = storage.load_garment("skirt_1000", storage.load_body("body"))
    vertices, faces = np.asarray(inner.vertices, float), np.asarray(inner.faces)
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    middle = vertices.mean(axis=0) * [1, 0, 1]
    outer = middle + (vertices - middle) * [1.15, 1, 1.15]
    outer[:, 1] = high - 0.8 * (high - vertices[:, 1])
    assert outer[:, 1].min() > low
    return trimesh.Trimesh(
        np.concatenate([vertices, outer]), np.concatenate([faces, faces + len(vertices)]), process=False
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, make, parts, pin",  # an open front has no border that is only at the top; a cape lies on the arms
    [("cape", cape, 1, "--pin above:0.52 --allow"), ("layered_skirt", layered_skirt, 2, "--pin highest")],
)
def test_four_commands(name, make, parts, pin, workplace):
    mesh = make()
    mesh.apply_scale(100)  # centimetres, as the README's
    mesh.export(workplace / f"{name}.obj")
    four = [c for c in commands() if "runs/mine_too" in c or c.endswith("--pin highest shirt.h5")]
    assert len(four) == 4
    for command in four:
        command = command.replace("shirt.", f"{name}.").replace("mine_too", name).replace("--pin highest", pin)
        if "experiments.train" in command:
            command += " " + SMALL
        run([sys.executable, *shlex.split(command)[1:]], workplace)
    cloth = storage.load_garment(workplace / f"{name}.h5", storage.load_body("body"))
    assert trimesh.Trimesh(cloth.vertices, cloth.faces, process=False).body_count == parts
    assert cloth.pinned.sum() > 10
    exported = list((workplace / "runs" / name).glob("*.onnx"))
    assert len(exported) == 1 and exported[0].stat().st_size > 1e5


@pytest.mark.slow
def test_five_commands_from_a_rigged_character(workplace):
    five = [command for command in commands() if "hero" in command]
    assert len(five) == 5
    for command in five:
        run(
            [sys.executable, *shlex.split(command + (" " + SMALL if "experiments.train" in command else ""))[1:]],
            workplace,
        )
    body, names = storage.load_rig(workplace / "hero.h5")
    assert names[0] == "pelvis" and np.ptp(body.vertices[:, 1]) == pytest.approx(0.9 * 1.84, abs=0.02)
    (exported,) = (workplace / "runs" / "hero").glob("*.onnx")
    session = onnxruntime.InferenceSession(exported)
    assert next(x.shape for x in session.get_outputs() if x.name == "vertices")[1] > 900
