"""Plain C: the matrices of a model in eight bits for `psi.c`, which needs no runtime.

A `.psi` is little-endian, and every array in it begins at a multiple of 64 bytes. Each row of a matrix, which gives one
output, has its own scale. `psi.c` quantises up to 512 inputs of a matrix to sixteen bits, more inputs to fewer bits.
Inputs that differ in scale are first multiplied by gains.
"""

import ctypes
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from clothjax.export import sidecar
from clothjax.geometry.clusters import ASKED, middles
from clothjax.geometry.proximity import even, halved
from clothjax.networks import forces, psi
from clothjax.networks.psi import BOUND
from clothjax.physics import compilers
from clothjax.physics.energies import GRAVITY, THICKNESS
from clothjax.runtime import drape
from clothjax.runtime.models import CAUSES, Bounds, FoldedLayer, ForcePredictor, Layer, Model, PosePredictor
from clothjax.types import Array, Material, Mesh, Motion, Rest

SOURCES = tuple(Path(__file__).with_name(name) for name in ("psi.h", "psi.c"))
MAGIC = int.from_bytes(b"PSI\0", "little")
VERSION = 1  # of a model without forces; ...
FORCED = 10  # ... and of one with forces
ALIGN = 64
MOST_WIDTH = 65536  # inputs of a layer
LANES = 64  # vertices skinned at once


def to_c(model: Model, path: str | Path, about: dict | None = None) -> Path:
    """Write a model for `psi.c`, and beside it `psi.c`, `psi.h` and a JSON that tells an engine how to drive it.

    Args:
        about: more entries for the JSON.

    Raises:
        ValueError: for what plain C does not have with forces: pose blend shapes of a body, and very many vertices.
    """
    path = Path(path)
    path.write_bytes(packed(model))
    sidecar.write(model, path, "world", {"driven": "by psi.c: see psi.h"} | (about or {}))
    for source in SOURCES:
        shutil.copyfile(source, path.parent / source.name)
    return path


def packed(model: Model) -> bytes:
    """Return a model as the bytes of a `.psi` file."""
    return as_bytes(_arrays(model))


def as_bytes(arrays: Iterable[np.ndarray]) -> bytes:
    """Return arrays as the bytes of a `.psi` file."""
    parts = (array.astype(array.dtype.newbyteorder("<")).tobytes() for array in arrays)
    return b"".join(part + bytes(-len(part) % ALIGN) for part in parts)


def _arrays(model: Model) -> Iterator[np.ndarray]:
    """Yield the arrays of a file in their order."""
    network, wearer, predictor = model.network, model.wearer, model.network.predictor
    code, pose = len(network.first), predictor if isinstance(predictor, PosePredictor) else None
    forced = isinstance(predictor, ForcePredictor)
    hidden = _mlp(predictor)[1:] if isinstance(predictor, ForcePredictor) else predictor.hidden
    head = (
        MAGIC, FORCED if forced else VERSION, len(model.parents), len(model.input_joints), len(model.moving),
        wearer.template.shape[1], code, len(hidden), len(network.decoder), len(network.read.bias) > network.width,
        model.config.model.blendshape_relu, network.mix is not None, bool(wearer.known), forced, 0, 0,
    )  # fmt: skip
    yield np.array(head, np.int32)
    yield np.array([model.config.fps, model.config.stage2.latent_decay], np.float32)
    for integers in (model.parents, model.input_joints, model.moving):
        yield np.array(integers, np.int32)
    yield np.asarray(wearer.joints, np.float32)
    yield _padded(network.weights)
    if pose is not None:
        yield np.asarray(pose.pose_mean, np.float32)
        yield from _bounds(pose.pose_bounds, len(pose.pose_mean))
    yield from _bounds(network.code_bounds, code)
    yield np.asarray(network.first, np.float32)
    if pose is not None:
        yield from _layer(Layer(pose.pose, pose.code.bias + wearer.bias), gains=True)
        yield from _layer(pose.code._replace(bias=np.zeros(len(wearer.bias))))
    for layer in hidden:
        yield from _layer(layer)
    yield from _layer(network.read, gains=True)
    for layer in network.decoder:
        yield from _layer(layer)
    if network.mix is not None:
        yield from _layer(network.mix)
    yield from _layer(Layer(network.shapes, wearer.template.reshape(-1)), gains=True)
    if isinstance(predictor, ForcePredictor):
        yield from _of_forces(model, predictor)


def _of_forces(model: Model, predictor: ForcePredictor) -> Iterator[np.ndarray]:
    """Yield the arrays of a predictor with forces: cloth and body, then layers."""
    network, cloth, physics = model.network, model.wearer.cloth, model.config.physics
    assert cloth is not None
    if predictor.corrections is not None:
        raise ValueError("plain C has no pose blend shapes of a body yet; export to another format")
    if 3 * len(cloth.mass) > MOST_WIDTH:
        raise ValueError(f"plain C takes {MOST_WIDTH // 3} vertices of a garment with forces, not {len(cloth.mass)}")
    felt, template = drape.felt_garment(model)
    mesh, rest, scales = predictor.mesh, cloth.rest, predictor.scales
    alone = None if predictor.felt is None else predictor.felt.mesh
    edges = np.asarray(forces.touching_edges(mesh, physics))
    # a cluster of the body's faces is where they are in the file, and vertices of one joint are side by side
    order = np.argsort(np.asarray(predictor.body).argmax(axis=0), kind="stable")
    faces = np.argsort(order)[np.asarray(predictor.faces)][np.asarray(predictor.clusters.points).reshape(-1)]
    near = np.asarray(predictor.clusters.positions, np.int32)
    near = np.pad(near, ((0, 0), (0, ASKED - near.shape[1])), mode="edge")
    between = np.zeros((0, ASKED), np.int32)
    if len(edges) > 0:
        between = even(halved(np.asarray(middles(template.T, edges)), np.arange(len(edges)), ASKED), ASKED)
    how = drape.shown_relaxation(model)
    yield np.array(
        [len(cloth.mass), len(mesh.faces), len(mesh.hinges), len(cloth.body), len(faces), len(near),
         predictor.felt is not None, len(edges), len(between), drape.relaxation_steps(model),
         0 if alone is None else len(alone.faces), how.steps, how.rounds, how.turns],
        np.int32,
    )  # fmt: skip
    weight = 0.0 if "gravity" in physics.without else GRAVITY
    spring = 3.0 * forces.DEPTH * physics.collision_stiffness  # N/m
    yield np.array(
        [1 / model.config.fps, weight, spring, physics.collision_offset, forces.HIGHEST, drape.DEEPEST, drape.REACH,
         model.config.model.relaxation_momentum, how.momentum, how.outside_momentum],
        np.float32,
    )  # fmt: skip
    stiffness = 0.0 if "bending" in physics.without else np.asarray(cloth.material.bending)
    yield _padded(cloth.mass)
    yield from _fabric(mesh, rest, cloth.material, cloth.mobility)
    yield _padded(mesh.hinges.T)
    yield _padded(stiffness / (4.0 * np.asarray(rest.hinge_area)))
    yield _padded(rest.hinge_angle)
    yield _padded(faces.T)
    yield near
    yield _padded(edges.T)
    yield between
    yield _padded(predictor.body[:, order])
    yield _padded(cloth.body[order].T)
    if predictor.felt is not None:
        yield _padded(felt.weights)
        yield _padded(predictor.felt.around.T)
        yield _padded(predictor.felt.shares.T)
    if predictor.felt is not None and alone is not None and cloth.shown is not None:
        yield from _fabric(alone, cloth.shown.rest, cloth.material, cloth.shown.mobility)
        assert predictor.felt.beside is not None
        yield _padded(predictor.felt.beside.T)
    read, code = network.read, len(network.first)
    assert isinstance(read, Layer)
    inputs = len(scales.middle) - len(cloth.constants)
    spread = BOUND * np.asarray(scales.spread, np.float64)
    yield np.asarray(scales.middle[:inputs], np.float32)
    yield np.asarray(1.0 / spread[:inputs], np.float32)
    yield from _layer(_linear(_rest(read.kernel)), gains=True)
    yield from _layer(_linear(np.asarray(felt.shapes).T))
    for layer in ([] if network.mix is None else [network.mix]) + list(network.decoder):
        yield from _layer(_linear(np.asarray(layer.kernel).T))
    back = np.asarray(scales.whitening.back, np.float64)
    yield from _exact(np.asarray(read.kernel, np.float64).T @ back)
    yield from _exact(scales.whitening.to)
    linear = predictor.params["linear"]
    first = _mlp(predictor)[0]
    kernel = np.concatenate([first.kernel, linear["kernel"]], axis=1).astype(np.float64)
    constants = np.asarray(psi.scaled_inputs(scales, cloth.constants))
    bias = np.concatenate([first.bias, linear["bias"]]) + constants @ kernel[inputs:]
    yield from _layer(Layer(kernel[:inputs], bias))
    yield from _exact(np.asarray(scales.output) * back)
    if predictor.felt is not None:
        yield from _layer(Layer(felt.shapes, template.reshape(-1)), gains=True)
    assert inputs == psi.DIRECTED * code


def _fabric(mesh: Mesh, rest: Rest, material: Material, mobility: Array | None) -> Iterator[np.ndarray]:
    """Yield the arrays of a garment's stretching, with the mobility of its vertices if it is relaxed."""
    size = np.asarray(rest.face_area) * THICKNESS
    yield _padded(mesh.faces.T)
    yield _padded(np.asarray(rest.inverse).reshape(-1, 4).T)
    yield _padded(2.0 * np.asarray(material.mu) * size)
    yield _padded(np.asarray(material.lam) * size)
    if mobility is not None:
        yield _padded(mobility)


def _mlp(predictor: ForcePredictor) -> list[Layer]:
    layers = predictor.params["mlp"]
    return [Layer(layers[f"dense_{i}"]["kernel"], layers[f"dense_{i}"]["bias"]) for i in range(len(layers))]


def _padded(rows: Array) -> np.ndarray:
    """Return rows [..., N] that go on with zeros to a multiple of `LANES`; reals are float32, integers int32."""
    rows = np.asarray(rows)
    rows = rows.astype(np.int32 if np.issubdtype(rows.dtype, np.integer) else np.float32)
    return np.pad(rows, [(0, 0)] * (rows.ndim - 1) + [(0, -rows.shape[-1] % LANES)])


def _linear(kernel: Array) -> Layer:
    return Layer(kernel, np.zeros(kernel.shape[1]))


def _exact(kernel: Array) -> Iterator[np.ndarray]:
    """Yield a kernel as two layers: the second is the `_rest` of the first."""
    yield from _layer(_linear(kernel), gains=True)
    yield from _layer(_linear(_rest(kernel)), gains=True)


def _rest(kernel: Array) -> np.ndarray:
    """Return what eight bits with gains leave of a kernel."""
    eight, gain, scale = eight_bits(kernel, True)
    return np.asarray(kernel, np.float64) - (scale[:, None] * eight * gain).T


def _bounds(bounds: Bounds, size: int) -> Iterator[np.ndarray]:
    for row in bounds:
        yield np.broadcast_to(np.asarray(row, np.float32), size)


def _layer(layer: Layer | FoldedLayer, gains: bool = False) -> Iterator[np.ndarray]:
    kernel = layer.kernel if isinstance(layer, Layer) else np.zeros((0, len(layer.bias)))
    eight, gain, scale = eight_bits(kernel, gains)
    yield np.array([len(kernel), len(layer.bias)], np.int32)
    yield gain
    yield np.asarray(layer.bias, np.float32)
    yield scale
    yield np.pad(eight, [(0, 0), (0, -len(kernel) % ALIGN)])


def eight_bits(kernel: Array, gains: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a kernel [inputs, outputs] as a matrix [outputs, inputs] int8, gains [inputs] and scales [outputs].

    The transposed kernel is scales * matrix * gains.

    Args:
        gains: whether each column gets a gain, so that small columns use all of their eight bits; else gains are 1.
    """
    rows = np.asarray(kernel, np.float64).T
    gain = np.abs(rows).max(axis=0, initial=0.0) if gains else np.ones(rows.shape[1])
    gain[gain == 0] = 1.0
    rows = rows / gain
    scale = np.abs(rows).max(axis=1, initial=0.0) / 127.0
    scale[scale == 0] = 1.0
    return np.rint(rows / scale[:, None]).astype(np.int8), gain.astype(np.float32), scale.astype(np.float32)


def build(directory: str | Path, flags: tuple[str, ...] = compilers.FLAGS) -> Path:
    """Compile `psi.c` into a shared library in a folder; return its path.

    Args:
        flags: of the compiler.

    Raises:
        OSError: if there is no compiler, or it fails.
    """
    library = Path(directory) / "libpsi.so"
    compilers.run("C", [*flags, "-fPIC", "-shared", "-o", library, SOURCES[1], "-lm"])
    return library


class Psi:
    """A model file loaded into `psi.c`, with one character.

    Args:
        library: path of the library that `build` compiled.
        rotations, translation: [J, 3, 3] and [3] m, the pose in which the character has been standing.

    Raises:
        ValueError: if the file is not a whole one, or the pose has another number of joints.
    """

    def __init__(self, library: str | Path, path: str | Path, rotations: Array, translation: Array):
        self._model = self._state = None
        self._c = ctypes.CDLL(str(library))
        for name in ("psi_load", "psi_begin"):
            getattr(self._c, name).restype = ctypes.c_void_p
        reason = ctypes.c_char_p()
        self._model = ctypes.c_void_p(self._c.psi_load(str(path).encode(), ctypes.byref(reason)))
        if not self._model:
            raise ValueError(f"{path}: {(reason.value or b'').decode()}")
        self.joints = self._c.psi_joints(self._model)
        self.vertices = np.zeros((self._c.psi_vertices(self._model), 3), np.float32)
        pose = self._pose(rotations, translation)
        self._state = ctypes.c_void_p(self._c.psi_begin(self._model, *map(_pointer, pose)))
        if not self._state:
            raise MemoryError(f"no memory for a character in {path}")

    def step(self, rotations: Array, translation: Array, vertices: bool = True) -> bool:
        """Compute the next frame, into `vertices` [V, 3] m if asked for; return its `State.ok`."""
        return bool(self.bound(rotations, translation, vertices)())

    def bound(self, rotations: Array, translation: Array, vertices: bool = True) -> Callable[[], int]:
        """Return a function that computes the next frame from the values then in these arrays, contiguous float32."""
        pose = self._pose(rotations, translation)
        vertices_out = _pointer(self.vertices) if vertices else None
        arguments = (self._model, self._state, *map(_pointer, pose), vertices_out)
        return lambda: self._c.psi_step(*arguments)

    def outside(self) -> tuple[str, ...]:
        """Return which of `models.CAUSES` brought the last frame out of the range of training."""
        bits = self._c.psi_outside(self._state)
        return tuple(cause for i, cause in enumerate(CAUSES) if bits >> i & 1)

    def state(self) -> np.ndarray:
        """Return what goes on from frame to frame, as `psi_keep` orders it."""
        carried = np.zeros(self._c.psi_carried(self._model), np.float32)
        self._c.psi_keep(self._model, self._state, _pointer(carried))
        return carried

    def put_back(self, carried: Array) -> None:
        """Go on from what `state` returned."""
        self._c.psi_put_back(self._model, self._state, _pointer(np.ascontiguousarray(carried, np.float32)))

    def push(self, external: Array) -> bool:
        """Set the external acceleration [3] m/s^2 of the frames to come; return whether the model feels it."""
        row = np.ascontiguousarray(external, np.float32)
        if row.shape != (3,):
            raise ValueError(f"an external acceleration is [3], not {row.shape}")
        return bool(self._c.psi_push(self._model, self._state, _pointer(row)))

    def _pose(self, rotations: Array, translation: Array) -> tuple[np.ndarray, np.ndarray]:
        pose = (np.ascontiguousarray(rotations, np.float32), np.ascontiguousarray(translation, np.float32))
        if pose[0].shape != (self.joints, 3, 3) or pose[1].shape != (3,):
            raise ValueError(f"poses are [{self.joints}, 3, 3] and [3], not {pose[0].shape} and {pose[1].shape}")
        return pose

    def __del__(self):
        if self._state:
            self._c.psi_end(self._state)
        if self._model:
            self._c.psi_free(self._model)


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def run_c(library: str | Path, path: str | Path, motion: Motion) -> np.ndarray:
    """Run a file over a motion in plain C; return vertices [T, V, 3] m.

    Args:
        library: path of the library that `build` compiled.
    """
    psi = Psi(library, path, motion.rotations[0], motion.translation[0])
    vertices = []
    for pose in zip(motion.rotations, motion.translation, strict=True):
        psi.step(*pose)
        vertices.append(psi.vertices.copy())
    return np.stack(vertices)
