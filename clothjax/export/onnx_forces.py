"""The forces on a garment in an ONNX graph, which Psi feels: as `forces.on_vertices` and `forces.felt_planes`.

A row of vectors is [N, 3, n], of scalars [N, 1, n], for N characters.
"""

from typing import NamedTuple

import numpy as np

from clothjax.export.onnx_graph import Graph
from clothjax.geometry.clusters import TRIED, Clusters
from clothjax.networks import forces
from clothjax.physics.energies import GRAVITY, SLIVER, THICKNESS
from clothjax.runtime import drape
from clothjax.runtime.models import Cloth, ForcePredictor, Model, Shown
from clothjax.types import Material, Rest

Planes = tuple[str, str]  # points and normals [N, 3, n]


class Parts(NamedTuple):
    """Parts of a model with forces, checked to be there."""

    predictor: ForcePredictor
    cloth: Cloth
    felt: Shown
    template: np.ndarray  # [3, V] m, of the garment that feels


def parts(model: Model) -> Parts:
    """Return the parts of a model with forces.

    Raises:
        ValueError: if its body has pose blend shapes.
    """
    predictor, cloth = model.network.predictor, model.wearer.cloth
    assert isinstance(predictor, ForcePredictor) and cloth is not None
    if predictor.corrections is not None:
        raise ValueError("ONNX has no pose blend shapes of a body yet; export to another format")
    felt, template = drape.felt_garment(model)
    return Parts(predictor, cloth, felt, np.asarray(template))


def blended(g: Graph, transforms: str, weights: np.ndarray) -> str:
    """Return transforms [N, 3, 4, V] of vertices with weights [J', V], from those [N, J', 12] of the joints."""
    rows = g("MatMul", g("Transpose", transforms, perm=[0, 2, 1]), np.asarray(weights))
    return g.reshape(rows, 3, 4, np.shape(weights)[1])


def moved(g: Graph, rows: str, points: str) -> str:
    """Return points [N, 3, V] moved by transforms [N, 3, 4, V]."""
    turned = g("Mul", g.slice(rows, 2, 0, 3), g("Unsqueeze", points, np.array([1], np.int64)))
    turned = g("ReduceSum", turned, np.array([2], np.int64), keepdims=0)
    return g("Add", turned, g("Squeeze", g.slice(rows, 2, 3, 4), np.array([2], np.int64)))


def pushed(g: Graph) -> str:
    """Return whether `external` is finite, [N, 1] bool."""
    return g.all(g("Less", g("Abs", "external"), np.float32(np.finfo(np.float32).max)), axis=1)


def external(g: Graph) -> str:
    """Return the external acceleration [N, 3] m/s^2, zero where it is not finite."""
    return g("Where", pushed(g), "external", np.zeros((1, 3)))


def momentum(g: Graph, model: Model, it: Parts, held: str) -> str:
    timestep = 1.0 / model.config.fps
    weight = 0.0 if "gravity" in model.config.physics.without else GRAVITY
    further = g("Mul", g.reshape(external(g), 1, 3), np.float32(timestep**2))
    flown = g("Add", g("Add", "position", "velocity"), further)
    apart = g("Sub", g("Transpose", flown, perm=[0, 2, 1]), held)
    down = np.array([[0.0], [-weight], [0.0]])
    return g("Mul", g("Add", g("Mul", apart, np.float32(1.0 / timestep**2)), down), np.asarray(it.cloth.mass))


def elasticity(g: Graph, model: Model, it: Parts, held: str) -> str:
    """Elastic forces [N, 3, V] in N: minus the gradient of the stretching and bending energies, in closed form."""
    faces, hinges = (np.asarray(x) for x in (it.predictor.mesh.faces, it.predictor.mesh.hinges))
    gradients = stretching(g, it.cloth.rest, it.cloth.material, held, faces)
    gradients += _bending(g, model, it, held, hinges)
    return g("Neg", at_vertices(g, gradients, [faces, hinges], it.template.shape[1]))


def at_vertices(g: Graph, values: list[str], elements: list[np.ndarray], vertices: int) -> str:
    """Sum values [N, R, n] for the corners of elements, in the order of `_around`, to those [N, R, V] of vertices."""
    return g("ReduceSum", _at_vertices(g, values, elements, vertices), np.array([3], np.int64), keepdims=0)


def _at_vertices(g: Graph, values: list[str], elements: list[np.ndarray], vertices: int) -> str:
    """Gather values [N, R, n] to [N, R, V, D], zero where a vertex has fewer corners than D."""
    table = _around(elements, vertices)
    rows = g("Pad", g("Concat", *values, axis=2), np.array([0, 0, 0, 0, 0, 1], np.int64))
    gathered = g("Gather", rows, table.reshape(-1), axis=2)
    return g("Reshape", gathered, np.array([0, 0, *table.shape], np.int64))


def _around(elements: list[np.ndarray], vertices: int) -> np.ndarray:
    """Return the corners of elements at each vertex [V, D] int64; rows end with the number of corners.

    Corners are numbered by the elements, then by their place in one, then by the element.
    """
    corners = np.concatenate([each.T.reshape(-1) for each in elements])
    order, counts = np.argsort(corners, kind="stable"), np.bincount(corners, minlength=vertices)
    table = np.full((vertices, counts.max(initial=1)), len(corners))
    table[np.repeat(np.arange(vertices), counts), np.concatenate([np.arange(count) for count in counts])] = order
    return table


def stretching(g: Graph, rest: Rest, material: Material, held: str, faces: np.ndarray) -> list[str]:
    """Gradients [N, 3, F] of the stretching energy for the three corners."""
    a, b, c, d = np.asarray(rest.inverse).reshape(-1, 4).T
    size = np.asarray(rest.face_area) * THICKNESS
    stiff, lam = 2.0 * float(material.mu) * size, float(material.lam) * size
    corners = [g("Gather", held, faces[:, k], axis=2) for k in range(3)]
    first, second = (g("Sub", corners[k], corners[2]) for k in range(2))
    along = g("Add", g("Mul", first, a), g("Mul", second, c))
    across = g("Add", g("Mul", first, b), g("Mul", second, d))
    one = np.float32(1.0)
    stretch = [g("Mul", g("Sub", g.dot(x, x), one), np.float32(0.5)) for x in (along, across)]
    shear = g("Mul", g.dot(along, across), 0.5 * stiff)
    trace = g("Mul", g("Add", *stretch), lam)
    of_along, of_across = (g("Add", g("Mul", x, stiff), trace) for x in stretch)
    left = g("Add", g("Mul", of_along, along), g("Mul", shear, across))
    right = g("Add", g("Mul", shear, along), g("Mul", of_across, across))
    first = g("Add", g("Mul", left, a), g("Mul", right, b))
    second = g("Add", g("Mul", left, c), g("Mul", right, d))
    return [first, second, g("Neg", g("Add", first, second))]


def _bending(g: Graph, model: Model, it: Parts, held: str, hinges: np.ndarray) -> list[str]:
    """Gradients [N, 3, H] of the bending energy for the edge's ends and the two vertices opposite."""
    rest = it.cloth.rest
    start, end, *opposite = (g("Gather", held, hinges[:, k], axis=2) for k in range(4))
    edge, left, right = (g("Sub", x, start) for x in (end, *opposite))
    normals = [g.cross(edge, left), g.cross(right, edge)]
    squared, *sides = (g.dot(x, x) for x in (edge, left, right))
    squares = [g.dot(x, x) for x in normals]
    size = g("Max", squared, *sides)
    bent = g("Greater", g("Min", *squares), g("Mul", g("Mul", size, size), np.float32(SLIVER**2)))
    one = np.float32(1.0)
    squared, *squares = (g("Where", bent, x, one) for x in (squared, *squares))
    length = g("Sqrt", squared)
    sine, cosine = g.dot(g.cross(*normals), edge), g("Mul", g.dot(*normals), length)
    # twice the arc of half the angle: there is no arctan2
    radius = g("Sqrt", g("Add", g("Mul", sine, sine), g("Mul", cosine, cosine)))
    sine = g("Where", g("Equal", sine, np.float32(0.0)), np.float32(1e-30), sine)  # folded over: half a turn
    half = g("Div", sine, g("Max", g("Add", radius, cosine), np.float32(1e-37)))
    angle = g("Sub", g("Mul", g("Atan", half), np.float32(2.0)), np.asarray(rest.hinge_angle))
    bending = 0.0 if "bending" in model.config.physics.without else float(it.cloth.material.bending)
    stiff = bending / (4.0 * np.asarray(rest.hinge_area))
    weight = g("Mul", g("Cast", bent, to=g.onnx.TensorProto.FLOAT), stiff)
    torque = g("Mul", g("Mul", g("Mul", weight, squared), angle), length)
    tips = [g("Mul", g("Neg", g("Div", torque, x)), y) for x, y in zip(squares, normals, strict=True)]
    places = [g("Div", g.dot(x, edge), squared) for x in (left, right)]
    longer = g("Mul", g("Mul", weight, g("Mul", angle, angle)), edge)
    at_end = g("Neg", g("Add", *(g("Mul", x, y) for x, y in zip(places, tips, strict=True))))
    at_start = g("Neg", g("Add", at_end, g("Add", *tips)))
    return [g("Sub", at_start, longer), g("Add", at_end, longer), *tips]


def surface(g: Graph, it: Parts, transforms: str, advance: str) -> Planes:
    """Centroids and normals [N, 3, 16 P] of the body's faces, in the order of their clusters."""
    predictor = it.predictor
    rows = blended(g, transforms, np.asarray(predictor.body))
    body = g("Add", moved(g, rows, g.constant(np.asarray(it.cloth.body).T[None])), advance)
    faces = np.asarray(predictor.faces)[np.asarray(predictor.clusters.points).reshape(-1)]
    corners = [g("Gather", body, faces[:, k], axis=2) for k in range(3)]
    centres = g("Mul", g("Add", g("Add", corners[0], corners[1]), corners[2]), np.float32(1.0 / 3.0))
    normals = g.cross(*(g("Sub", corner, corners[0]) for corner in corners[1:]))
    length = g("Sqrt", g("Max", g.dot(normals, normals), np.float32(1e-30)))
    return centres, g("Div", normals, length)


class Searched(NamedTuple):
    """The faces among which those nearest to clusters of vertices are searched for."""

    middle: str  # [N, 3, G, 1] m, of a cluster of vertices
    beside: str  # [N, 3, G, 16 T] m, the centroids of faces that may be near it, from its middle, and ...
    places: str  # [N, G, 16 T] ... where they are


def searched(g: Graph, clusters: Clusters, held: str, centres: str) -> Searched:
    """Find the clusters of faces in which `clusters.nearest_in_clusters` searches.

    Args:
        centres: of `surface`.
    """
    asked, (count, size) = np.asarray(clusters.positions), np.shape(clusters.points)
    groups, tried = len(asked), min(TRIED, count)
    near = g.reshape(g("Gather", held, asked.reshape(-1), axis=2), 3, *asked.shape)
    middle = g("ReduceMean", near, axes=[3], keepdims=1)
    patches = g.reshape(centres, 3, count, size)
    means = g("ReduceMean", patches, axes=[3], keepdims=1)
    radius = g("ReduceSumSquare", g("Sub", patches, means), axes=[1], keepdims=1)
    radius = g("Sqrt", g("ReduceMax", radius, axes=[3], keepdims=0))  # [N, 1, P]
    apart = g("Sub", middle, g.reshape(means, 3, 1, count))
    bound = g("Sub", g("Sqrt", g("ReduceSumSquare", apart, axes=[1], keepdims=0)), radius)
    chosen = g("Mul", g.reshape(g.lowest(bound, tried), groups, tried, 1), np.int64(size))
    places = g.reshape(g("Add", chosen, np.arange(size)), 1, groups * tried * size)
    beside = g("GatherElements", centres, g("Concat", places, places, places, axis=1), axis=2)
    beside = g("Sub", g.reshape(beside, 3, groups, tried * size), middle)
    return Searched(middle, beside, g.reshape(places, groups, tried * size))


def nearest_planes(g: Graph, among: Searched, positions: str, members: np.ndarray, surface: Planes) -> Planes:
    """Return the planes of the faces nearest to positions [N, 3, n].

    Args:
        members: [G, S], the positions for which a cluster's faces are searched; -1 is none.
        surface: of `surface`.
    """
    count = members.max() + 1
    near = g.reshape(g("Gather", positions, np.maximum(members, 0).reshape(-1), axis=2), 3, *members.shape)
    near = g("Transpose", g("Sub", near, among.middle), perm=[0, 2, 3, 1])
    # half the squared distance without the part of the position, from the middle: far from it products cancel
    half = g("Mul", g("ReduceSumSquare", among.beside, axes=[1], keepdims=0), np.float32(0.5))
    product = g("MatMul", near, g("Transpose", among.beside, perm=[0, 2, 1, 3]))  # [N, G, S, 16 T]
    score = g("Sub", g("Unsqueeze", half, np.array([2], np.int64)), product)
    best = g("ArgMin", score, axis=3, keepdims=0)  # [N, G, S]
    found = g.reshape(g("GatherElements", among.places, best, axis=2), members.size)
    order = np.zeros(count + 1, np.int64)
    order[members.reshape(-1)] = np.arange(members.size)  # of -1 at the end
    face = g.reshape(g("Gather", found, order[:count], axis=1), 1, count)
    face = g("Concat", face, face, face, axis=1)
    point, normal = (g("GatherElements", x, face, axis=2) for x in surface)
    return point, normal


def raised(g: Graph, planes: Planes, held: str, edges: np.ndarray, vertices: int, times: float = 1.0) -> Planes:
    """Return planes of so many vertices, raised as by `forces.raised`."""
    if len(edges) == 0:
        return planes
    point, normal = planes
    turned, along = (g("Sub", *(g("Gather", x, edges[:, k], axis=2) for k in range(2))) for x in (normal, held))
    bulge = g("Mul", g.dot(turned, along), np.float32(1 / 8))
    bulge = g("Mul", g("Min", g("Relu", bulge), np.float32(forces.HIGHEST)), np.float32(times))
    of_ends = _at_vertices(g, [bulge, bulge], [edges], vertices)
    height = g("ReduceMax", of_ends, axes=[3], keepdims=0)
    return g("Add", point, g("Mul", height, normal)), normal


def contact(g: Graph, model: Model, held: str, point: str, normal: str) -> str:
    """Forces [N, 3, V] in N of planes that are touched, as of `forces.spring`."""
    physics = model.config.physics
    gap = g.dot(g("Sub", held, point), normal)
    depth = g("Relu", g("Sub", np.float32(physics.collision_offset), gap))
    return g("Mul", g("Mul", depth, np.float32(3.0 * forces.DEPTH * physics.collision_stiffness)), normal)
