"""`psi.c` inside of jax, on a CPU: the same step as `clothjax.runtime.inference.step`, in eight bits and plain C.

XLA has no fast product of a vector and a matrix of low precision; `psi.c` has. It is built when a model is first
packed, which needs a C and a C++ compiler, and registered with `jax.ffi`.
"""

import ctypes
import dataclasses
import functools
import shutil
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from clothjax.export import native
from clothjax.runtime import inference
from clothjax.runtime.models import CAUSES, Model, State
from clothjax.types import Array, Pose

SOURCE = Path(__file__).with_name("psi_ffi.cc")
TARGET = "clothjax_psi_step"


@functools.partial(jax.tree_util.register_dataclass, data_fields=("file",), meta_fields=("vertices",))
@dataclasses.dataclass(frozen=True)
class Packed:
    """A model packed for plain C."""

    file: Array  # [bytes] uint8, a .psi
    vertices: int


def available() -> bool:
    """Return whether `pack` can work here: jax computes on a CPU, and a C and a C++ compiler are present."""
    return jax.default_backend() == "cpu" and None not in (native.compiler(), _compiler())


def _compiler() -> str | None:
    return next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)


def pack(model: Model) -> Packed:
    """Pack a model of one character for `step`; a specialised one is fastest.

    Raises:
        OSError: if jax does not compute on a CPU, or a compiler is missing or fails.
    """
    if jax.default_backend() != "cpu":
        raise OSError(f"plain C inside of jax is for CPUs; jax computes on {jax.default_backend()} (JAX_PLATFORMS=cpu)")
    _register()
    return Packed(jnp.asarray(np.frombuffer(native.packed(model), np.uint8)), model.wearer.template.shape[1])


@functools.cache
def _register() -> None:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        plain, library = Path(folder) / "psi.o", Path(folder) / "libpsi_ffi.so"
        native.run_compiler(native.compiler(), "C", [*native.FLAGS, "-fPIC", "-c", native.SOURCES[1], "-o", plain])
        includes = [f"-I{folder}" for folder in (native.SOURCES[0].parent, jax.ffi.include_dir())]
        shared = ["-std=c++17", "-O2", "-fPIC", "-shared", *includes, SOURCE, plain, "-o", library]
        native.run_compiler(_compiler(), "C++", shared)
        handler = ctypes.CDLL(str(library)).PsiStep  # it stays loaded when its file is gone
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(handler), platform="cpu")


@functools.partial(jax.jit, static_argnames="vertices")
def step(
    packed: Packed, state: State, pose: Pose, vertices: bool = True, external: Array | None = None
) -> tuple[State, Array | None]:
    """Compute the next frame as `inference.step` does, but by plain C: a new state, and vertices [V, 3] m in the world.

    Args:
        packed: of `pack`.
        state: first that of `inference.initial_state` for the model itself.
        pose: of the frame to come, local rotations [J, 3, 3] and root translation [3] m.
        vertices: False for a garment that nobody sees: they are then None.
        external: [3] m/s^2, as of `inference.step`.

    Raises:
        ValueError: for an external acceleration of a Psi without forces.
        jax.errors.JaxRuntimeError: for a state or a pose of another garment, or a damaged file.
    """
    if external is not None and state.drape is None:
        raise ValueError(inference.NOT_FELT)
    carried, restored = ravel_pytree((state[:4], state.drape))
    external = jnp.zeros(3) if external is None else jnp.asarray(external, jnp.float32)
    shape = (packed.vertices if vertices else 0, 3)
    kinds = [jax.ShapeDtypeStruct(carried.shape, jnp.float32), jax.ShapeDtypeStruct((len(CAUSES),), jnp.bool_),
             jax.ShapeDtypeStruct(shape, jnp.float32)]  # fmt: skip
    call = jax.ffi.ffi_call(TARGET, kinds, vmap_method="sequential")
    carried, outside, garment = call(packed.file, carried, *(jnp.asarray(x, jnp.float32) for x in pose), external)
    (latent, rotations, positions, translation), drape = restored(carried)
    return State(latent, rotations, positions, translation, outside, drape), garment if vertices else None
