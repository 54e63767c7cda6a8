"""glTF for engines: body and garment as skinned meshes on one skeleton, the garment's folds as morph targets."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from clothjax.render.gltf import MOST, POSITIONS, Document, principal_components
from clothjax.render.performance import SkinnedPerformance
from clothjax.types import Array

SET = 4  # joints that a set of attributes holds
LOST = 0.01  # of a vertex's weights, above which a second set is written


def to_skinned_glb(
    path: str | Path, performance: SkinnedPerformance, *, tolerance: float = 1e-3, most: int = MOST
) -> dict[str, float]:
    """Write a binary glTF of skinned meshes; return the largest error in m of each one's canonical vertices.

    Skinning does not enlarge that error. Shapes that change are compressed as by `gltf.to_glb`. A vertex has its four
    largest weights, or eight where four would lose more than a hundredth. A joint that is a bone of VRM's humanoid has
    its name there in `extras`.

    Raises:
        ImportError: if pygltflib is not installed.
    """
    document, errors, motion = Document(), {}, performance.motion
    places, parents = np.asarray(performance.joints, np.float32), np.asarray(performance.parents)
    rest = places - np.where(parents[:, None] < 0, 0.0, places[parents])
    nodes = [
        document.node(
            name=name,
            translation=rest[joint].tolist(),
            children=np.flatnonzero(parents == joint).tolist(),  # joints are the first nodes
            extras={"humanoid": performance.bones[name]} if name in performance.bones else {},
        )
        for joint, name in enumerate(performance.names)
    ]
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(nodes), 1, 1))
    inverse_bind[:, 3, :3] = -places  # column-major
    matrices = document.add(inverse_bind.reshape(-1, 16), "MAT4")
    document.file.skins = [document.gltf.Skin(joints=nodes, inverseBindMatrices=matrices)]
    times = None if motion is None else document.times(len(motion.translation), motion.fps)
    for part in performance.parts:
        mean, targets, weights, errors[part.name] = (
            (part.vertices[0], np.zeros((0, 0, 3)), None, 0.0)
            if len(part.vertices) == 1
            else principal_components(part.vertices, tolerance, most)
        )
        attributes = {
            name: document.add(values, "VEC4", POSITIONS) for name, values in _influences(part.weights).items()
        }
        mesh = document.mesh(part.name, mean, part.faces, part.colour, targets, **attributes)
        node = document.node(name=part.name, mesh=mesh, skin=0)
        if times is not None and weights is not None:
            document.animate(node, "weights", times, document.add(weights.reshape(-1), "SCALAR"))
    if motion is not None and times is not None:
        root = int(np.argmin(parents))
        values = np.asarray(motion.translation, np.float32) + rest[root]
        document.animate(root, "translation", times, document.add(values, "VEC3"))
        for joint, turns in enumerate(np.moveaxis(_quaternions(motion.rotations), 1, 0)):
            document.animate(joint, "rotation", times, document.add(turns, "VEC4"))
    document.save(path)
    return errors


def largest(weights: np.ndarray, count: int) -> np.ndarray:
    """Return skinning weights [N, J] with the `count` largest of each row, the others zero, rows summing to 1."""
    kept = np.array(weights, np.float64)
    np.put_along_axis(kept, np.argsort(-kept, axis=1, kind="stable")[:, count:], 0.0, axis=1)
    return kept / kept.sum(axis=1, keepdims=True)


def _influences(weights: np.ndarray) -> dict[str, np.ndarray]:
    """Return the attributes of skinning weights [N, J]: joints [N, 4] and their weights [N, 4], once or twice."""
    kind = np.uint8 if weights.shape[1] <= 256 else np.uint16
    weights = np.pad(weights, ((0, 0), (0, 2 * SET)))  # a skeleton may have few joints
    four = np.sort(weights, axis=1)[:, -SET:].sum(axis=1)
    sets = 1 if four.min() >= 1.0 - LOST else 2
    kept = largest(weights, SET * sets)
    order = np.argsort(-kept, axis=1, kind="stable")[:, : SET * sets]
    values = np.take_along_axis(kept, order, axis=1).astype(np.float32)
    joints = np.where(values > 0.0, order, 0).astype(kind)
    attributes = {}
    for k in range(sets):
        attributes |= {f"JOINTS_{k}": joints[:, SET * k :][:, :SET], f"WEIGHTS_{k}": values[:, SET * k :][:, :SET]}
    return attributes


def _quaternions(rotations: Array) -> np.ndarray:
    """Return rotations [T, J, 3, 3] as quaternions [T, J, 4], x first, whose signs do not jump between frames."""
    matrices = np.asarray(rotations, np.float64)
    turns = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat().reshape(*matrices.shape[:2], 4)
    flipped = np.sum(turns[1:] * turns[:-1], axis=-1, keepdims=True) < 0.0
    turns[1:] *= np.where(np.cumsum(flipped, axis=0) % 2, -1.0, 1.0)
    return turns.astype(np.float32)
