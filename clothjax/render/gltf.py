"""glTF: an animated garment on its body, as morph targets that any viewer plays. NumPy only."""

from pathlib import Path
from typing import Any

import numpy as np

from clothjax.render.performance import Performance
from clothjax.render.ray_cast import vertex_normals

FLOAT, UNSIGNED = 5126, 5125
POSITIONS, INDICES = 34962, 34963  # buffer targets


def to_glb(path: str | Path, performance: Performance, *, tolerance: float = 1e-3, most: int = 48) -> dict[str, float]:
    """Write a binary glTF; return the largest error in m of each mesh.

    Shapes are compressed by principal components into morph targets: enough to bring every vertex within `tolerance` m,
    but at most `most`.

    Raises:
        ImportError: if pygltflib is not installed.
    """
    try:
        import pygltflib as gltf
    except ImportError as error:
        raise ImportError("glTF needs pygltflib: pip install clothjax[render]") from error
    writer = _Buffer(gltf)
    frames = np.arange(len(performance.root), dtype=np.float32)
    times = writer.add(frames / np.float32(performance.fps), "SCALAR", bounds=True)
    meshes, materials, nodes, channels, samplers, errors = [], [], [], [], [], {}
    translations = writer.add(np.asarray(performance.root, np.float32), "VEC3")
    for index, part in enumerate(performance.parts):
        mean, targets, weights, errors[part.name] = principal_components(part.vertices, tolerance, most)
        attributes = gltf.Attributes(
            POSITION=writer.add(mean, "VEC3", POSITIONS, bounds=True),
            NORMAL=writer.add(vertex_normals(mean, part.faces), "VEC3", POSITIONS),
        )
        corners = writer.add(np.asarray(part.faces, np.uint32).reshape(-1), "SCALAR", INDICES)
        morphs: list[Any] = [  # dicts, which pygltflib writes as they are
            {
                "POSITION": writer.add(target, "VEC3", POSITIONS, bounds=True),
                "NORMAL": writer.add(_normal_change(mean, target, part.faces), "VEC3", POSITIONS),
            }
            for target in targets
        ]
        primitive = gltf.Primitive(attributes=attributes, indices=corners, material=index)
        primitive.targets = morphs  # pyright: ignore[reportAttributeAccessIssue]  # dictionaries are written as they are
        meshes.append(gltf.Mesh(name=part.name, primitives=[primitive], weights=[0.0] * len(targets)))
        nodes.append(gltf.Node(name=part.name, mesh=index))
        base = gltf.PbrMetallicRoughness(baseColorFactor=[*part.colour, 1.0], metallicFactor=0.0, roughnessFactor=0.9)
        materials.append(gltf.Material(name=part.name, pbrMetallicRoughness=base, doubleSided=True))
        for values, kind in ((translations, "translation"), (writer.add(weights.reshape(-1), "SCALAR"), "weights")):
            samplers.append(gltf.AnimationSampler(input=times, output=values, interpolation="LINEAR"))
            target = gltf.AnimationChannelTarget(node=index, path=kind)
            channels.append(gltf.AnimationChannel(sampler=len(samplers) - 1, target=target))
    document = gltf.GLTF2(
        scene=0,
        scenes=[gltf.Scene(nodes=list(range(len(nodes))))],
        nodes=nodes,
        meshes=meshes,
        materials=materials,
        animations=[gltf.Animation(name="motion", samplers=samplers, channels=channels)],
        accessors=writer.accessors,
        bufferViews=writer.views,
        buffers=[gltf.Buffer(byteLength=len(writer.data))],
    )
    document.set_binary_blob(bytes(writer.data))
    document.save_binary(str(path))
    return errors


Components = tuple[np.ndarray, np.ndarray, np.ndarray, float]


def principal_components(vertices: np.ndarray, tolerance: float, most: int) -> Components:
    """Compress vertices [T, N, 3] m over time by principal components.

    Args:
        tolerance: m, the vertex error at which there are enough components.
        most: number that is not exceeded.

    Returns:
        Mean [N, 3] m, components [K, N, 3], weights [T, K] in m, and the largest vertex error in m.
    """
    vertices = np.asarray(vertices, np.float64)
    mean = vertices.mean(axis=0)
    left, size, right = np.linalg.svd((vertices - mean).reshape(len(vertices), -1), full_matrices=False)
    weights = left * size
    count, error = 0, float("inf")
    for count in range(1, min(most, len(size)) + 1):
        rebuilt = (weights[:, :count] @ right[:count]).reshape(vertices.shape) + mean
        error = float(np.linalg.norm(rebuilt - vertices, axis=-1).max())
        if error <= tolerance:
            break
    components = right[:count].reshape(count, *mean.shape)
    return (
        mean.astype(np.float32),
        components.astype(np.float32),
        weights[:, :count].astype(np.float32),
        error,
    )


def _normal_change(mean: np.ndarray, target: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the derivative of the normals along a morph target, by a step of about a millimetre."""
    step = 1e-3 / max(float(np.abs(target).max()), 1e-12)
    change = vertex_normals(mean + step * target, faces) - vertex_normals(mean, faces)
    return (change / step).astype(np.float32)


class _Buffer:
    """Binary part of a glTF under construction."""

    def __init__(self, gltf):
        self.gltf, self.data, self.views, self.accessors = gltf, bytearray(), [], []

    def add(self, array: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """Append an array; return the index of its accessor."""
        array = np.ascontiguousarray(array)
        while len(self.data) % 4:
            self.data += b"\0"
        self.views.append(
            self.gltf.BufferView(buffer=0, byteOffset=len(self.data), byteLength=array.nbytes, target=target)
        )
        self.data += array.tobytes()
        rows = array.reshape(len(array), -1)
        self.accessors.append(
            self.gltf.Accessor(
                bufferView=len(self.views) - 1,
                componentType=UNSIGNED if array.dtype == np.uint32 else FLOAT,
                count=len(array),
                type=kind,
                min=rows.min(axis=0).tolist() if bounds else None,
                max=rows.max(axis=0).tolist() if bounds else None,
            )
        )
        return len(self.accessors) - 1
