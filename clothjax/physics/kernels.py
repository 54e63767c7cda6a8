"""Energies, relaxation, blend shapes, a sparse solve and searches in C++: faster than XLA in descents on a CPU.

The form in jax is the reference. All use it but functions that `in_kernels` wraps, where there is a compiler. Kernels
are in single precision. They have derivatives by positions and blend weights alone, in reverse mode alone.
"""

import contextvars
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from clothjax import progress
from clothjax.geometry.proximity import STRIDES, Patches
from clothjax.physics import compilers
from clothjax.physics.energies import THICKNESS
from clothjax.types import Array, EdgeContact, Material, Mesh, Rest

SOURCE = Path(__file__).with_suffix(".cc")
SYMBOLS = (
    "ClothStretching", "ClothBending", "ClothEdgeCollision", "ClothRelax", "ClothRelaxBack", "ClothBlend",
    "ClothBlendBack", "ClothSolve", "ClothNearestFace", "ClothNearestFaceAround",
)  # fmt: skip

_used: contextvars.ContextVar[bool] = contextvars.ContextVar("kernels", default=False)


def in_kernels(function: Callable) -> Callable:
    """Return a function that is traced with kernels; on a machine that cannot build them, which is told, as it is.

    They are built here, not while it is traced: several threads may do that at once.
    """
    if not built():
        return function

    @functools.wraps(function)
    def wrapped(*arguments):
        before = _used.set(True)
        try:
            return function(*arguments)
        finally:
            _used.reset(before)

    return wrapped


def built() -> bool:
    """Return whether kernels are there: build them on a CPU, and tell it if that fails."""
    return jax.default_backend() == "cpu" and _compiled()


@functools.cache
def _compiled() -> bool:
    try:
        compilers.register(SOURCE, SYMBOLS)
    except OSError as error:
        progress.say(f"descents are left to jax, which takes longer: {str(error).splitlines()[0]}")
        return False
    return True


def used(read: Array) -> bool:
    """Return whether kernels compute what is traced now; what is read must have single precision."""
    return _used.get() and read.dtype == jnp.float32


class Sheet(NamedTuple):
    """Faces that stretch."""

    inverse: Array  # [F, 4] 1/m
    mu: Array  # [F] J, the material's times area and thickness ...
    lam: Array  # [F] J, ... likewise


def stretching(position: Float[Array, "V 3"], rest: Rest, material: Material, mesh: Mesh) -> Float[Array, ""]:
    """Return the sum of `energies.stretching` at positions [V, 3] m, in J."""
    return _energy(position, (_corners(mesh.faces), *_sheet(rest, material)), "ClothStretching")


def bending(position: Float[Array, "V 3"], rest: Rest, material: Material, mesh: Mesh) -> Float[Array, ""]:
    """Return the sum of `energies.bending` at positions [V, 3] m, in J."""
    stiffness = material.bending / (8.0 * rest.hinge_area)
    operands = (_corners(mesh.hinges), stiffness, rest.hinge_angle)
    return _energy(position, operands, "ClothBending")


def edge_collision(
    position: Float[Array, "V 3"], contact: EdgeContact, mesh: Mesh, stiffness: float, offset: float
) -> Float[Array, ""]:
    """Return the sum of `incremental_potential.edge_collision` at positions [V, 3] m, in J.

    Args:
        stiffness: J/m^3.
        offset: m.
    """
    operands = (_corners(mesh.edges), contact.place, contact.point_next, contact.normal_next)
    settings = (("stiffness", np.float32(stiffness)), ("offset", np.float32(offset)))
    return _energy(position, operands, "ClothEdgeCollision", settings)


def _corners(elements: Array) -> Array:
    return jnp.asarray(elements, jnp.int32)


def _sheet(rest: Rest, material: Material) -> Sheet:
    volume = rest.face_area * np.float32(THICKNESS)
    return Sheet(rest.inverse.reshape(-1, 4), material.mu * volume, material.lam * volume)


Settings = tuple[tuple[str, np.generic], ...]  # of a kernel, by name


def _call(name: str, shapes: list[tuple[int, ...]], *operands: Array, **attributes: np.generic) -> Sequence[Array]:
    kinds = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    # operands that all garments of a batch share are not copied
    return jax.ffi.ffi_call(name, kinds, vmap_method="expand_dims")(*operands, **attributes)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _energy(position: Array, operands: tuple, name: str, settings: Settings = ()) -> Array:
    return _energy_and_gradient(position, operands, name, settings)[0]


def _energy_and_gradient(position: Array, operands: tuple, name: str, settings: Settings) -> Sequence[Array]:
    return _call(name, [(), position.shape], position, *operands, **dict(settings))


def _energy_forward(position, operands, name: str, settings: Settings) -> tuple[Array, Array]:
    energy, gradient = _energy_and_gradient(position.value, _constant(operands), name, settings)
    return energy, gradient


def _energy_backward(_name: str, _settings: Settings, gradient: Array, cotangent: Array) -> tuple[Array, None]:
    return cotangent * gradient, None


_energy.defvjp(_energy_forward, _energy_backward, symbolic_zeros=True)


def _constant(operands: tuple) -> tuple:
    """Return the values of operands that `symbolic_zeros` tells whether one differentiates by."""
    if any(operand.perturbed for operand in operands):
        raise NotImplementedError("kernels have derivatives by positions and weights alone")
    return tuple(operand.value for operand in operands)


def relaxed(
    position: Float[Array, "V 3"],
    mobility: Float[Array, " V"],
    rest: Rest,
    material: Material,
    mesh: Mesh,
    steps: int,
    momentum: float,
    longest: float,
) -> Float[Array, "V 3"]:
    """Return what `relaxation.relaxed` does.

    Args:
        longest: m, that the gradient moves a vertex by in a step at most.
    """
    settings = (("steps", np.int32(steps)), ("momentum", np.float32(momentum)), ("longest", np.float32(longest)))
    return _relaxed(position, (mobility, _corners(mesh.faces), *_sheet(rest, material)), settings)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _relaxed(position: Array, operands: tuple, settings: Settings) -> Array:
    return _call("ClothRelax", [position.shape], position, *operands, **dict(settings))[0]


def _relaxed_forward(position, operands, settings: Settings) -> tuple[Array, tuple]:
    position, operands = position.value, _constant(operands)
    return _relaxed(position, operands, settings), (position, operands)


def _relaxed_backward(settings: Settings, passed: tuple, cotangent: Array) -> tuple[Array, None]:
    position, operands = passed
    return _call("ClothRelaxBack", [position.shape], cotangent, position, *operands, **dict(settings))[0], None


_relaxed.defvjp(_relaxed_forward, _relaxed_backward, symbolic_zeros=True)


@jax.custom_vjp
def blended(weights: Float[Array, " K"], shapes: Float[Array, "K N"]) -> Float[Array, " N"]:
    """Return blend shapes [K, N] in a sum by weights [K]."""
    return _call("ClothBlend", [shapes.shape[1:]], weights, shapes)[0]


def _blended_forward(weights, shapes) -> tuple[Array, Array]:
    (shapes,) = _constant((shapes,))
    return blended(weights.value, shapes), shapes


def _blended_backward(shapes: Array, cotangent: Array) -> tuple[Array, None]:
    return _call("ClothBlendBack", [shapes.shape[:1]], cotangent, shapes)[0], None


blended.defvjp(_blended_forward, _blended_backward, symbolic_zeros=True)


class Factor(NamedTuple):
    """A symmetric positive definite matrix of n of V vertices as L D L^T, sparse (Davis, Direct Methods, chapter 4)."""

    order: np.ndarray  # [n] int32, the vertices in the order in which they are eliminated
    start: np.ndarray  # [n + 1] int32, where the columns of L begin, ...
    below: np.ndarray  # [m] int32, ... and their rows below the diagonal, in that order, ...
    lower: np.ndarray  # [m] ... and values
    pivot: np.ndarray  # [n] 1 / D


def solve(factor: Factor, right: Float[Array, "V 3"]) -> Float[Array, "V 3"]:
    """Return the inverse of a matrix times right-hand sides [V, 3]; zero for vertices that are not in it."""
    return _call("ClothSolve", [right.shape], right, *factor)[0]


def nearest_face(positions: Float[Array, "V 3"], body: Float[Array, "B 3"], patches: Patches) -> Int[Array, " V"]:
    """Return what `proximity.nearest_face` does, of the faces of a body."""
    return _searched("ClothNearestFace", positions, body, patches.faces, patches.groups)


def nearest_face_around(
    positions: Float[Array, "V 3"], body: Float[Array, "B 3"], patches: Patches, vertices: Sequence[Array]
) -> Int[Array, " V"]:
    """Return what `proximity.nearest_face_around` does, from two vertices each."""
    first, second = vertices
    operands = (patches.faces, patches.around, first, second)
    return _searched("ClothNearestFaceAround", positions, body, *operands, strides=np.int32(STRIDES))


def _searched(name: str, positions: Array, body: Array, *operands: Array, **attributes: np.generic) -> Array:
    positions, body = jax.lax.stop_gradient((positions, body))
    kind = jax.ShapeDtypeStruct(positions.shape[:1], jnp.int32)
    return jax.ffi.ffi_call(name, kind, vmap_method="expand_dims")(positions, body, *operands, **attributes)
