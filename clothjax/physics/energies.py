"""The energies of cloth, each from positions and constants: no weights, no networks.

Elementwise functions return one value per face, hinge or vertex. The same code thus gives the loss (a sum), the
force (its gradient) and the reference solver's Hessian (second derivative, element by element). Every function is
finite, with a finite gradient, at zero edges, zero areas, flat and folded hinges and zero slip.
"""

from functools import reduce

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from clothjax.geometry import vectors
from clothjax.geometry.vectors import cross, dot, minus, norm, plus, times
from clothjax.types import Array, Garment, Mesh, Rest, Scalar

GRAVITY = 9.81  # m/s^2
THICKNESS = 4.7e-4  # m, of the StVK membrane in HOOD and SNUG
SLIVER = 1e-6  # twice the area, over a hinge's squared size, below which a face has no direction
COLLISION_OFFSET = 3e-3  # m, the cloth is pushed out to this distance from the body


def rest_measures(vertices: Float[Array, "V 3"], mesh: Mesh, flat: bool = True) -> Rest:
    """Rest measures of a garment from its canonical vertices [V, 3] m.

    With `flat` the rest angle of every hinge is zero, as in HOOD; otherwise it is the canonical one.
    """
    corners = vertices[mesh.faces]
    e0, e1 = corners[:, 0] - corners[:, 2], corners[:, 1] - corners[:, 2]
    normal = jnp.cross(e0, e1)
    double_area = norm(normal)
    length = norm(e0)
    # the edge matrix in the basis (e0 / |e0|, in-plane normal to it) is upper triangular
    along = jnp.sum(e0 * e1, axis=-1) / length
    height = double_area / length
    zero = jnp.zeros_like(length)
    inverse = jnp.stack([1.0 / length, -along / (length * height), zero, 1.0 / height], axis=-1)
    face_area = 0.5 * double_area
    angle = dihedral_angle(vertices[mesh.hinges])
    return Rest(
        inverse=inverse.reshape(-1, 2, 2),
        face_area=face_area,
        hinge_area=_triangle_areas(vertices[mesh.hinges]),
        hinge_angle=jnp.zeros_like(angle) if flat else angle,
    )


def vertex_areas(vertices: Float[Array, "V 3"], faces: Int[Array, "F 3"]) -> Float[Array, " V"]:
    """Area [V] m^2 that belongs to each vertex [V, 3] m: a third of the area of its faces [F, 3]."""
    corners = vertices[faces]
    areas = 0.5 * norm(jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return jnp.zeros_like(vertices[:, 0]).at[faces.reshape(-1)].add(jnp.repeat(areas / 3.0, 3))


def regional(
    rest: Rest, areas: Float[Array, " V"], mesh: Mesh, cloth: Float[Array, "V 3"]
) -> tuple[Rest, Float[Array, " V"]]:
    """Apply the factors of cloth that is not the same everywhere to a garment's rest measures and vertex areas.

    A face's energy is proportional to its rest area, a hinge's to the inverse of its own, a mass to the vertex area.
    Scaling these areas therefore scales the material there.

    Args:
        rest: of the uniform cloth.
        areas: [V] m^2, of its vertices.
        mesh: faces and hinges; each takes the mean factor of its corners.
        cloth: [V, 3] factors of density, of mu and lam, and of bending.

    Returns:
        The rest measures, and the areas [V] m^2 that give the masses.
    """
    _, stretching, bending = cloth.T
    return rest._replace(
        face_area=rest.face_area * jnp.mean(stretching[mesh.faces], axis=1),
        hinge_area=rest.hinge_area / jnp.mean(bending[mesh.hinges], axis=1),  # the bending energy divides by it
    ), areas * cloth[:, 0]


def cloth_measures(
    garment: Garment, template: Float[Array, "V 3"] | None, mesh: Mesh
) -> tuple[Rest, Float[Array, " V"]]:
    """Return the rest measures of a garment and its vertex areas [V] m^2, weighted by its cloth.

    Args:
        template: [V, 3] m, the garment shaped to its wearer; None for the shape as modelled.
    """
    measured = jnp.asarray(garment.vertices) if template is None else template
    rest, areas = rest_measures(measured, mesh), vertex_areas(measured, garment.faces)
    return (rest, areas) if garment.cloth is None else regional(rest, areas, mesh, jnp.asarray(garment.cloth))


def green_strain(corners: Float[Array, "F 3 3"], inverse: Float[Array, "F 2 2"]) -> Float[Array, "F 2 2"]:
    """Green strain [F, 2, 2] of deformed triangles [F, 3, 3] m with inverse rest edge matrices [F, 2, 2] 1/m."""
    along, shear, across = _strain(corners, inverse)
    return jnp.stack([jnp.stack([along, shear], axis=1), jnp.stack([shear, across], axis=1)], axis=1)


def _deformed(corners: Float[Array, "F 3 3"], inverse: Float[Array, "F 2 2"]) -> tuple[vectors.Vector, vectors.Vector]:
    """Return the columns of the deformation gradients of triangles, each a vector of components [F]."""
    a, b, c, d = inverse.reshape(-1, 4).T
    first, second, third = vectors.corners(corners)
    left, right = minus(first, third), minus(second, third)
    return plus(times(a, left), times(c, right)), plus(times(b, left), times(d, right))


def _strain(corners: Float[Array, "F 3 3"], inverse: Float[Array, "F 2 2"]) -> tuple[Array, Array, Array]:
    """Return the entries 11, 12 and 22 [F] of the Green strain: (F^T F - I) / 2."""
    along, across = _deformed(corners, inverse)
    return 0.5 * (dot(along, along) - 1.0), 0.5 * dot(along, across), 0.5 * (dot(across, across) - 1.0)


def stretching(
    corners: Float[Array, "F 3 3"],
    inverse: Float[Array, "F 2 2"],
    area: Float[Array, " F"],
    mu: Scalar | Float[Array, " F"],
    lam: Scalar | Float[Array, " F"],
    thickness: float = THICKNESS,
) -> Float[Array, " F"]:
    """Saint Venant-Kirchhoff energy [F] J: A h (mu tr(G^2) + lambda/2 tr(G)^2) of triangles [F, 3, 3] m."""
    along, shear, across = _strain(corners, inverse)
    trace = along + across
    squares = along * along + 2.0 * shear * shear + across * across
    return area * thickness * (mu * squares + 0.5 * lam * trace * trace)


def stretching_hessian_product(
    corners: Float[Array, "F 3 3"],
    moves: Float[Array, "F 3 3"],
    inverse: Float[Array, "F 2 2"],
    area: Float[Array, " F"],
    mu: Scalar | Float[Array, " F"],
    lam: Scalar | Float[Array, " F"],
    thickness: float = THICKNESS,
) -> Float[Array, "F 3 3"]:
    """Return the Hessians of `stretching` of triangles [F, 3, 3] m times moves [F, 3, 3] m of their corners, in N.

    That is the derivative of the first Piola-Kirchhoff stress F S along the moves: dF S + F dS, with
    S = 2 mu G + lambda tr(G) I, at the corners.
    """

    def stress(along: Array, shear: Array, across: Array) -> tuple[Array, Array, Array]:
        trace = lam * (along + across)
        scale = area * thickness
        return scale * (2.0 * mu * along + trace), scale * 2.0 * mu * shear, scale * (2.0 * mu * across + trace)

    (u, v), (du, dv) = _deformed(corners, inverse), _deformed(moves, inverse)
    s, t, w = stress(*_strain(corners, inverse))
    ds, dt, dw = stress(dot(u, du), 0.5 * (dot(u, dv) + dot(v, du)), dot(v, dv))
    first = plus(plus(times(s, du), times(t, dv)), plus(times(ds, u), times(dt, v)))
    second = plus(plus(times(t, du), times(w, dv)), plus(times(dt, u), times(dw, v)))
    a, b, c, d = inverse.reshape(-1, 4).T
    left, right = plus(times(a, first), times(b, second)), plus(times(c, first), times(d, second))
    ends = (left, right, times(-1.0, plus(left, right)))
    return jnp.stack([jnp.stack(end, axis=1) for end in ends], axis=1)


def dihedral_angle(corners: Float[Array, "H 4 3"]) -> Float[Array, " H"]:
    """Signed angle [H] rad between the faces of hinges [H, 4, 3]; 0 if flat, or where a face has hardly any area."""
    start, *others = vectors.corners(corners)
    offsets = [minus(other, start) for other in others]
    # the angle does not depend on size, but sine and cosine below are of fifth order in length and would underflow
    sizes = [jnp.abs(component) for offset in offsets for component in offset]
    size = jax.lax.stop_gradient(reduce(jnp.maximum, sizes))
    edge, left, right = (times(1.0 / jnp.where(size > 0, size, 1.0), offset) for offset in offsets)
    left, right = cross(edge, left), cross(right, edge)
    sine = dot(cross(left, right), edge)
    cosine = dot(left, right) * vectors.length(edge)
    # small again where faces are slivers, and arctan2's derivative squares them
    scale = jax.lax.stop_gradient(jnp.maximum(jnp.abs(sine), jnp.abs(cosine)))
    area = jnp.minimum(dot(left, left), dot(right, right))
    degenerate = (area < SLIVER * SLIVER) | (scale == 0)
    scale = jnp.where(degenerate, 1.0, scale)
    return jnp.where(degenerate, 0.0, jnp.arctan2(sine / scale, jnp.where(degenerate, 1.0, cosine / scale)))


def bending(
    corners: Float[Array, "H 4 3"],
    area: Float[Array, " H"],
    rest_angle: Float[Array, " H"],
    stiffness: Scalar | Float[Array, " H"],
) -> Float[Array, " H"]:
    """Dihedral energy [H] J: k l^2 / (4 A) (theta - theta_0)^2 / 2, l the current edge, A the rest area."""
    start, end, *_ = vectors.corners(corners)
    edge = minus(end, start)
    angle = dihedral_angle(corners) - rest_angle
    return stiffness * dot(edge, edge) / (8.0 * area) * angle * angle


def gravity(height: Float[Array, "*n"], mass: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Potential energy [V] J of masses [V] kg raised by `height` [V] m."""
    return GRAVITY * mass * height


def inertia(
    deviation: Float[Array, "*n 3"], mass: Float[Array, "*n"], timestep: Scalar | Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Incremental kinetic potential [V] J: m |x - x_t - v_t|^2 / (2 dt^2) of the deviation x - x_t - v_t, m."""
    return mass * jnp.sum(deviation * deviation, axis=-1) / (2.0 * timestep * timestep)


def collision(distance: Float[Array, "*n"], offset: float = COLLISION_OFFSET) -> Float[Array, "*n"]:
    """Cubic penetration max(offset - d, 0)^3 [V] m^3 at signed distances d [V] m; a stiffness in J/m^3 makes it J."""
    depth = jnp.maximum(offset - distance, 0.0)
    return depth * depth * depth


def friction(
    slip: Float[Array, "V 3"],
    normal: Float[Array, "V 3"],
    mass: Float[Array, " V"],
    touching: Bool[Array, " V"],
    coefficient: float = 0.5,
    smoothing: float = 1e-4,
) -> Float[Array, " V"]:
    """HOOD's friction potential [V] J: c g m kappa |tau| where a vertex touches the body.

    tau is the slip [V, 3] m relative to the body, without its part along the contact normal [V, 3].
    kappa = sqrt(1 - cos^2(tau, up) + 1e-4) weakens it along gravity. |tau| is smoothed over `smoothing` m; 0 gives
    HOOD's value, with a zero gradient at zero slip.
    """
    tangential = slip - jnp.sum(slip * normal, axis=-1, keepdims=True) * normal
    squared = jnp.sum(tangential * tangential, axis=-1)
    still = squared + smoothing * smoothing == 0
    length = jnp.sqrt(jnp.where(still, 1.0, squared + smoothing * smoothing))
    up = tangential[:, 1] / length
    kappa = jnp.sqrt(jnp.abs(1.0 - up * up) + 1e-4)
    distance = jnp.where(still, 0.0, length - smoothing)
    return jnp.where(touching, coefficient * GRAVITY * mass * kappa * distance, 0.0)


def _triangle_areas(hinges: Float[Array, "H 4 3"]) -> Float[Array, " H"]:
    a, b, c, d = hinges[:, 0], hinges[:, 1], hinges[:, 2], hinges[:, 3]
    return 0.5 * (norm(jnp.cross(b - a, c - a)) + norm(jnp.cross(b - a, d - a)))
