"""`psi.c` inside of jax, on a CPU: the same step as `clothjax.runtime.inference.step`, in eight bits and plain C.

XLA has no fast product of a vector and a matrix of low precision; `psi.c` has. It is built when a model is first
packed, which needs a C and a C++ compiler, and registered with `jax.ffi`.
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from clothjax.export import native
from clothjax.physics import compilers
from clothjax.runtime import inference
from clothjax.runtime.models import CAUSES, Model, State
from clothjax.types import Array, Pose

SOURCE = Path(__file__).with_name("psi_ffi.cc")
TARGET = "PsiStep"


@functools.partial(jax.tree_util.register_dataclass, data_fields=("file",), meta_fields=("vertices",))
@dataclasses.dataclass(frozen=True)
class Packed:
    """A model packed for plain C."""

    file: Array  # [bytes] uint8, a .psi
    vertices: int


def available() -> bool:
    """Return whether `pack` can work here: jax computes on a CPU, and a C and a C++ compiler are present."""
    return jax.default_backend() == "cpu" and None not in map(compilers.compiler, compilers.PROGRAMS)


def pack(model: Model) -> Packed:
    """Pack a model of one character for `step`; a specialised one is fastest.

    Raises:
        OSError: if jax does not compute on a CPU, or a compiler is missing or fails.
    """
    if jax.default_backend() != "cpu":
        raise OSError(f"plain C inside of jax is for CPUs; jax computes on {jax.default_backend()} (JAX_PLATFORMS=cpu)")
    compilers.register(SOURCE, (TARGET,), native.SOURCES[1])
    return Packed(jnp.asarray(np.frombuffer(native.packed(model), np.uint8)), model.wearer.template.shape[1])


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
