"""glTF: an animated garment on its body, as morph targets that any viewer plays. NumPy only."""

from pathlib import Path
from typing import Any

import numpy as np

from clothjax.render.performance import Performance
from clothjax.render.ray_cast import vertex_normals

COMPONENTS = {"float32": 5126, "uint32": 5125, "uint16": 5123, "uint8": 5121}  # glTF's numbers of types
POSITIONS, INDICES = 34962, 34963  # buffer targets
MOST = 128  # morph targets; a t-shirt that folds needs 96 for a clip of 120 frames, a dress more


def to_glb(
    path: str | Path, performance: Performance, *, tolerance: float = 1e-3, most: int = MOST
) -> dict[str, float]:
    """Write a binary glTF; return the largest error in m of each mesh.

    Shapes are compressed by principal components into morph targets: enough to bring every vertex within `tolerance` m,
    but at most `most`.

    Raises:
        ImportError: if pygltflib is not installed.
    """
    document, errors = Document(), {}
    times = document.times(len(performance.root), performance.fps)
    translations = document.add(np.asarray(performance.root, np.float32), "VEC3")
    for part in performance.parts:
        mean, targets, weights, errors[part.name] = principal_components(part.vertices, tolerance, most)
        mesh = document.mesh(part.name, mean, part.faces, part.colour, targets)
        node = document.node(name=part.name, mesh=mesh)
        document.animate(node, "translation", times, translations)
        document.animate(node, "weights", times, document.add(weights.reshape(-1), "SCALAR"))
    document.save(path)
    return errors


Components = tuple[np.ndarray, np.ndarray, np.ndarray, float]


def principal_components(vertices: np.ndarray, tolerance: float, most: int) -> Components:
    """Compress vertices [T, N, 3] m over time by principal components.

    Args:
        tolerance: m, the vertex error at which there are enough components.
        most: number that is not exceeded.

    Returns:
        Mean [N, 3] m, components [K, N, 3] m, weights [T, K] in [-1, 1], and the largest vertex error in m.
    """
    vertices = np.asarray(vertices, np.float64)
    mean = vertices.mean(axis=0)
    left, size, right = np.linalg.svd((vertices - mean).reshape(len(vertices), -1), full_matrices=False)
    weights = left * size
    count, error, rebuilt = 0, float("inf"), np.broadcast_to(mean, vertices.shape)
    for count in range(1, min(most, len(size)) + 1):
        rebuilt = rebuilt + np.outer(weights[:, count - 1], right[count - 1]).reshape(vertices.shape)
        error = float(np.linalg.norm(rebuilt - vertices, axis=-1).max())
        if error <= tolerance:
            break
    largest = np.maximum(np.abs(weights[:, :count]).max(axis=0), 1e-12)  # some engines clamp weights
    components = (largest[:, None] * right[:count]).reshape(count, *mean.shape)
    return (
        mean.astype(np.float32),
        components.astype(np.float32),
        (weights[:, :count] / largest).astype(np.float32),
        error,
    )


class Document:
    """A glTF under construction: nodes, meshes, one animation, and the numbers behind them.

    Raises:
        ImportError: if pygltflib is not installed.
    """

    def __init__(self):
        try:
            import pygltflib as gltf
        except ImportError as error:
            raise ImportError("glTF needs pygltflib: pip install clothjax[render]") from error
        self.gltf, self.data, self.file = gltf, bytearray(), gltf.GLTF2(scene=0)
        self.animation = gltf.Animation(name="motion")

    def add(self, array: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """Append an array of a type of `COMPONENTS`; return the index of its accessor.

        Args:
            kind: of an element, such as VEC3.
            target: of the buffer, for what a mesh is made of.
            bounds: whether to write the least and the largest element.
        """
        array = np.ascontiguousarray(array)
        while len(self.data) % 4:
            self.data += b"\0"
        view = self.gltf.BufferView(buffer=0, byteOffset=len(self.data), byteLength=array.nbytes, target=target)
        self.file.bufferViews.append(view)
        self.data += array.tobytes()
        rows = array.reshape(len(array), -1)
        self.file.accessors.append(
            self.gltf.Accessor(
                bufferView=len(self.file.bufferViews) - 1,
                componentType=COMPONENTS[array.dtype.name],
                count=len(array),
                type=kind,
                min=rows.min(axis=0).tolist() if bounds else None,
                max=rows.max(axis=0).tolist() if bounds else None,
            )
        )
        return len(self.file.accessors) - 1

    def node(self, **fields: Any) -> int:
        """Append a node; return its index."""
        self.file.nodes.append(self.gltf.Node(**fields))
        return len(self.file.nodes) - 1

    def mesh(
        self,
        name: str,
        vertices: np.ndarray,
        faces: np.ndarray,
        colour: tuple[float, float, float],
        targets: np.ndarray,
        **attributes: int,
    ) -> int:
        """Append a mesh with a material of its own; return its index.

        Args:
            vertices: [N, 3] m.
            faces: [F, 3].
            colour: red, green, blue in [0, 1].
            targets: [K, N, 3] m, morph targets.
            attributes: more of them by name, as accessors.
        """
        gltf, vertices = self.gltf, np.asarray(vertices, np.float32)
        index = np.uint16 if len(vertices) < 2**16 else np.uint32
        primitive = gltf.Primitive(
            attributes=gltf.Attributes(
                POSITION=self.add(vertices, "VEC3", POSITIONS, bounds=True),
                NORMAL=self.add(vertex_normals(vertices, faces).astype(np.float32), "VEC3", POSITIONS),
                **attributes,
            ),
            indices=self.add(np.asarray(faces, index).reshape(-1), "SCALAR", INDICES),
            material=len(self.file.materials),
        )
        morphs: list[Any] = [  # dicts, which pygltflib writes as they are
            {
                "POSITION": self.add(target, "VEC3", POSITIONS, bounds=True),
                "NORMAL": self.add(_normal_change(vertices, target, faces), "VEC3", POSITIONS),
            }
            for target in targets
        ]
        primitive.targets = morphs
        self.file.meshes.append(gltf.Mesh(name=name, primitives=[primitive], weights=[0.0] * len(targets)))
        base = gltf.PbrMetallicRoughness(baseColorFactor=[*colour, 1.0], metallicFactor=0.0, roughnessFactor=0.9)
        self.file.materials.append(gltf.Material(name=name, pbrMetallicRoughness=base, doubleSided=True))
        return len(self.file.meshes) - 1

    def times(self, frames: int, fps: float) -> int:
        """Append the times in s of frames; return the index of their accessor."""
        return self.add(np.arange(frames, dtype=np.float32) / np.float32(fps), "SCALAR", bounds=True)

    def animate(self, node: int, path: str, times: int, values: int) -> None:
        """Animate a property of a node, such as its rotation, linearly between the values of an accessor."""
        sampler = self.gltf.AnimationSampler(input=times, output=values, interpolation="LINEAR")
        target = self.gltf.AnimationChannelTarget(node=node, path=path)
        self.animation.channels.append(self.gltf.AnimationChannel(sampler=len(self.animation.samplers), target=target))
        self.animation.samplers.append(sampler)

    def save(self, path: str | Path) -> None:
        """Write the file, with a scene of the nodes that are no other's children."""
        children = {child for node in self.file.nodes for child in node.children or ()}
        roots = [index for index in range(len(self.file.nodes)) if index not in children]
        self.file.scenes = [self.gltf.Scene(nodes=roots)]
        self.file.animations = [self.animation] if self.animation.channels else []
        self.file.buffers = [self.gltf.Buffer(byteLength=len(self.data))]
        self.file.set_binary_blob(bytes(self.data))
        self.file.save_binary(str(path))


def _normal_change(mean: np.ndarray, target: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the derivative of the normals along a morph target, by a step of about a millimetre."""
    step = 1e-3 / max(float(np.abs(target).max()), 1e-12)
    change = vertex_normals(mean + step * target, faces) - vertex_normals(mean, faces)
    return (change / step).astype(np.float32)
