"""Rigged characters of our own making, as glTF files in the dialects of programs."""

import json
from pathlib import Path

import fast_simplification
import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from clothjax.body.plausibility import body_kinematics
from clothjax.files import storage
from clothjax.types import Body, Motion

FLOAT, UINT32, UINT16 = 5126, 5125, 5123
WIDTHS = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}

MIXAMO = {"LowerBack": "Spine", "Spine": "Spine1", "Spine1": "Spine2"}
UNREAL = {
    "Hips": "pelvis",
    "LowerBack": "spine_01",
    "Spine": "spine_02",
    "Spine1": "spine_03",
    "Neck": "neck_01",
    "Head": "head",
    **{
        f"{side}{bone}": f"{name}_{side[0].lower()}"
        for side in ("Left", "Right")
        for bone, name in (
            ("Shoulder", "clavicle"),
            ("Arm", "upperarm"),
            ("ForeArm", "lowerarm"),
            ("Hand", "hand"),
            ("UpLeg", "thigh"),
            ("Leg", "calf"),
            ("Foot", "foot"),
            ("ToeBase", "ball"),
        )
    },
}
VRM = {"Hips": "hips", "Neck": "neck", "Head": "head"} | {
    f"{side}{bone}": f"{side.lower()}{name}"
    for side in ("Left", "Right")
    for bone, name in (
        ("Arm", "UpperArm"),
        ("ForeArm", "LowerArm"),
        ("Hand", "Hand"),
        ("UpLeg", "UpperLeg"),
        ("Leg", "LowerLeg"),
        ("Foot", "Foot"),
    )
}


class Writer:
    """The binary part of a glTF file, and its accessors."""

    def __init__(self):
        self.data, self.views, self.accessors = bytearray(), [], []

    def add(self, array: np.ndarray, kind: int = FLOAT) -> int:
        array = np.ascontiguousarray(array, {FLOAT: np.float32, UINT32: np.uint32, UINT16: np.uint16}[kind])
        rows = array.reshape(len(array), -1)
        self.data += b"\0" * (-len(self.data) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": rows.nbytes})
        self.data += rows.tobytes()
        entry = {"bufferView": len(self.views) - 1, "componentType": kind, "count": len(rows)}
        self.accessors.append(entry | {"type": WIDTHS[rows.shape[1]]})
        return len(self.accessors) - 1


def write(
    path: Path,
    body: Body,
    names: tuple[str, ...],
    motion: Motion,
    *,
    axes: np.ndarray | None = None,
    turn: np.ndarray | None = None,
    unit: float = 1.0,
    armature: tuple[np.ndarray, float] = (np.eye(3), 1.0),
    objects: dict[str, np.ndarray] | None = None,
    morphs: dict[str, np.ndarray] | None = None,
    extensions: dict | None = None,
    shown: int | None = None,
    ends: bool = False,
    carriers: int = 0,
    skinned: bool = True,
) -> None:
    """Write a character with one animation.

    Args:
        names: of its joints in the file.
        axes: [J, 3, 3], the axes of its bones in the canonical pose.
        turn: [3, 3], from our axes to the file's.
        unit: of the file's world, in m.
        armature: rotation and scale of a node that carries the skeleton.
        objects: faces [F, 3] of each object; default: one.
        morphs: [V, 3] m by name.
        extensions: of the document; for VRM.
        ends: whether a far joint that moves nothing hangs on every last one, as importers of FBX leave them.
        carriers: how many nodes, of which the first has keys, lie between that node and the hips.
        skinned: False for an animation alone.
        shown: frame of the motion in whose pose the scene stands; default: the canonical one.
    """
    count, turn = len(names), np.eye(3) if turn is None else turn
    axes = np.tile(np.eye(3), (count, 1, 1)) if axes is None else axes
    carrier = np.eye(4)
    carrier[:3, :3] = armature[0] * armature[1]

    def matrices(rotations: np.ndarray, positions: np.ndarray) -> np.ndarray:
        result = np.tile(np.eye(4), (*rotations.shape[:-2], 1, 1))
        result[..., :3, :3] = turn @ rotations @ axes * armature[1]
        result[..., :3, 3] = positions @ turn.T / unit
        return result

    def local(world: np.ndarray) -> np.ndarray:
        result = world.copy()
        result[..., 0, :, :] = np.linalg.inv(carrier) @ world[..., 0, :, :]
        result[..., 1:, :, :] = np.linalg.inv(world[..., body.parents[1:], :, :]) @ world[..., 1:, :, :]
        return result

    bind = matrices(np.tile(np.eye(3), (count, 1, 1)), np.asarray(body.joints, np.float64))
    to_world = np.diag([1 / unit / 100, 1 / unit / 100, 1 / unit / 100, 1.0])  # the mesh is in cm, in our axes
    to_world[:3, :3] = turn @ to_world[:3, :3]
    turned, positions = body_kinematics(motion, body)
    moving = local(matrices(turned, positions))
    still, writer = local(bind), Writer()
    nodes = [{"name": name, **_trs((still if shown is None else moving[shown])[j])} for j, name in enumerate(names)]
    for j, parent in enumerate(body.parents):
        if parent >= 0:
            nodes[parent].setdefault("children", []).append(j)
    skin, inverse = list(range(count)), np.linalg.inv(bind) @ to_world
    for j in sorted(set(range(count)) - set(body.parents)) if ends else ():
        nodes[j]["children"] = [len(nodes)]
        skin.append(len(nodes))
        inverse = np.concatenate([inverse, inverse[j : j + 1]])
        nodes.append({"name": f"{names[j]}_end", "translation": [0.0, 700.0, 0.0]})
    top = 0
    for k in reversed(range(carriers)):
        nodes.append({"name": "root" if k == 0 else f"carrier_{k}", "children": [top]})
        top = len(nodes) - 1
    carrying = len(nodes)
    nodes.append({"name": "Armature", "matrix": carrier.T.reshape(-1).tolist(), "children": [top]})
    weights = np.sort(np.asarray(body.weights), axis=1)[:, :-5:-1]
    joints = np.argsort(np.asarray(body.weights), axis=1)[:, :-5:-1]
    attributes = {
        "POSITION": writer.add(100 * np.asarray(body.vertices)),
        "JOINTS_0": writer.add(joints, UINT16),
        "WEIGHTS_0": writer.add(weights),
    }
    targets = [{"POSITION": writer.add(100 * added)} for added in (morphs or {}).values()]
    meshes = []
    for name, faces in (objects or {"Body": np.asarray(body.faces)}).items() if skinned else ():
        primitive = {"attributes": attributes, "indices": writer.add(faces.reshape(-1), UINT32), "targets": targets}
        meshes.append({"name": name, "primitives": [primitive], "extras": {"targetNames": list(morphs or {})}})
        nodes.append({"name": name, "mesh": len(meshes) - 1, "skin": 0})
    times = writer.add(np.arange(len(positions)) / motion.fps)
    quaternions = Rotation.from_matrix(
        (moving[..., :3, :3] / np.cbrt(np.linalg.det(moving[..., :3, :3]))[..., None, None]).reshape(-1, 3, 3)
    )
    quaternions = quaternions.as_quat().reshape(len(positions), count, 4)
    outputs = [(j, "rotation", writer.add(quaternions[:, j])) for j in range(count)]
    outputs.append((0, "translation", writer.add(moving[:, 0, :3, 3])))
    if carriers:
        outputs.append((top, "rotation", writer.add(np.tile([0.0, 0.0, 0.0, 1.0], (len(positions), 1)))))
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": list(range(carrying, len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes if skinned else [],
        "skins": [{"joints": skin, "inverseBindMatrices": writer.add(inverse.swapaxes(1, 2))}] if skinned else [],
        "animations": [
            {
                "name": "a walk",
                "samplers": [{"input": times, "output": output} for *_, output in outputs],
                "channels": [
                    {"sampler": k, "target": {"node": node, "path": kind}} for k, (node, kind, _) in enumerate(outputs)
                ],
            }
        ],
        "accessors": writer.accessors,
        "bufferViews": writer.views,
        "buffers": [{"byteLength": len(writer.data)}],
        "extensions": extensions or {},
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data = bytes(writer.data) + b"\0" * (-len(writer.data) % 4)
    chunks = [len(text).to_bytes(4, "little") + b"JSON" + text, len(data).to_bytes(4, "little") + b"BIN\0" + data]
    size = 12 + sum(map(len, chunks))
    path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + size.to_bytes(4, "little") + b"".join(chunks))


def _trs(matrix: np.ndarray) -> dict:
    scale = np.linalg.norm(matrix[:3, :3], axis=0)
    turn = Rotation.from_matrix(matrix[:3, :3] / scale).as_quat()
    return {"translation": matrix[:3, 3].tolist(), "rotation": turn.tolist(), "scale": scale.tolist()}


def coarse(body: Body, faces: int = 500) -> Body:
    """A closed body of few faces, whose vertices have the weights of the nearest ones."""
    vertices, triangles = fast_simplification.simplify(
        np.float32(body.vertices), np.int32(body.faces), target_count=faces, agg=3
    )
    nearest = KDTree(np.asarray(body.vertices)).query(vertices)[1]
    shapedirs = np.asarray(body.shapedirs)[nearest]
    return body._replace(
        vertices=vertices, faces=triangles, weights=np.asarray(body.weights)[nearest], shapedirs=shapedirs
    )


def another(path: Path) -> None:
    """A character of another skeleton, with Unreal's names, in centimetres: shorter, broader and without shapes."""
    body, names = storage.load_rig("body")
    size = np.array([1.05, 0.9, 1.0])
    body = body._replace(vertices=np.asarray(body.vertices) * size, joints=np.asarray(body.joints) * size)
    clip = storage.load_motion("walk_1", names)
    axes = Rotation.random(len(names), rng=np.random.default_rng(0)).as_matrix()
    renamed = tuple(UNREAL.get(name, name) for name in names)
    write(path, body, renamed, clip, axes=axes, armature=(np.eye(3), 0.01))
