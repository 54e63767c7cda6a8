"""The data that modules pass to one another, as named tuples of arrays. SI units, +Y up.

Letters in shapes: V garment vertices, B body vertices, J joints, S betas, F faces of the garment, Fb of the body.
Further, H hinges, E edges, T frames, L numbers of a code, K blend shapes. [V, 3] m is one point in metres a vertex.

Names in formulas and code: x positions [m], v velocities [m per frame], z code, dt time step [s], lbs the garment by
plain skinning, hold the garment by persistence. METHOD.md has the glossary.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

Array = jax.Array | np.ndarray
Scalar = Float[Array, ""] | np.floating | float


class Body(NamedTuple):
    """A rigged, shapeable body in its canonical (zero) pose."""

    vertices: Array  # [B, 3] m
    faces: Array  # [Fb, 3] int32
    joints: Array  # [J, 3] m
    parents: Array  # [J] int32, root -1, topological order
    weights: Array  # [B, J] skinning weights, rows sum to 1
    shapedirs: Array  # [B, 3, S] m per standard deviation
    joint_shapedirs: Array  # [J, 3, S] m per standard deviation
    posedirs: Array | None = None  # [B, 3, 9 (J - 1)] m, SMPL's pose blend shapes


class Garment(NamedTuple):
    """A garment aligned with its body's canonical pose, with the body's skinning and shape diffused onto it."""

    vertices: Array  # [V, 3] m
    faces: Array  # [F, 3] int32
    weights: Array  # [V, J] skinning weights, rows sum to 1
    shapedirs: Array  # [V, 3, S] m per standard deviation
    pinned: Array  # [V] bool, vertices that follow skinning
    cloth: Array | None = None  # [V, 3] factors of the material's density, of its mu and lam, and of its bending


class Motion(NamedTuple):
    """A clip on a body's own joints; the identity rotation is the body's canonical pose."""

    rotations: Array  # [T, J, 3, 3] local to the parent
    translation: Array  # [T, 3] m, of the root relative to its canonical place
    fps: float


class Pose(NamedTuple):
    """One frame of a motion. A window of three frames has a leading axis 3, a batch a leading axis [N]."""

    rotations: Array  # [J, 3, 3] local to the parent
    translation: Array  # [3] m


class Material(NamedTuple):
    """Constants of the cloth; every field is a scalar."""

    density: Array  # kg/m^2
    mu: Array  # Pa, Lame's second parameter
    lam: Array  # Pa, Lame's first parameter
    bending: Array  # N m


class Mesh(NamedTuple):
    """Connectivity of a garment: the elements over which its energies are sums."""

    faces: Array  # [F, 3] int32
    hinges: Array  # [H, 4] int32: edge (a, b), then the vertex opposite it in the left and the right face
    edges: Array  # [E, 2] int32, undirected


class Rest(NamedTuple):
    """The undeformed garment on a shaped body: lengths, areas and angles at which its elastic energy is zero."""

    inverse: Array  # [F, 2, 2] inverse of the rest edge matrix, 1/m
    face_area: Array  # [F] m^2
    hinge_area: Array  # [H] m^2, of the two faces together
    hinge_angle: Array  # [H] rad


class Contact(NamedTuple):
    """One plane of the body's surface for each garment vertex, fixed during a time step: a point and a unit normal."""

    point: Array  # [V, 3] m, at the current frame
    point_next: Array  # [V, 3] m, the same surface point at the next frame
    normal: Array  # [V, 3] at the current frame
    normal_next: Array  # [V, 3] at the next frame
    index: Array  # [V] int32, a body vertex beside it; of planes that Psi feels, the body's face


class EdgeContact(NamedTuple):
    """One plane of the body's surface for each garment edge, at a place between its ends, fixed during a time step."""

    place: Array  # [E] from 0 at the edge's first vertex to 1 at its second
    point_next: Array  # [E, 3] m, of the body at the next frame
    normal_next: Array  # [E, 3]


class SelfContact(NamedTuple):
    """The point of the garment itself that each of its vertices may touch, fixed during a time step."""

    corners: Array  # [V, 3] int32 vertices of the triangle
    weights: Array  # [V, 3] barycentric coordinates
    normal: Array  # [V, 3] from that point to the vertex


class ClothState(NamedTuple):
    """The state of a garment at a frame. Positions are relative to the root's translation at that frame."""

    position: Array  # [V, 3] m
    velocity: Array  # [V, 3] m per frame
    acceleration: Array  # [V, 3] m per frame^2
    latent: Array  # [L] the code that gave `position`, or a baseline's memory
    change: Array  # [L] the code minus that of the frame before
