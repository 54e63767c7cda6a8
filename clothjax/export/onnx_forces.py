"""The part of an ONNX graph that a Psi with forces adds: forces on the garment, pulled back to the code.

It follows `clothjax/runtime/drape.py`. A row of vectors is [N, 3, n], of scalars [N, 1, n], for N characters.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from clothjax.export.onnx_graph import Graph
from clothjax.geometry.clusters import TRIED, Clusters
from clothjax.networks import forces, psi
from clothjax.networks.forces import KINDS
from clothjax.physics import relaxation
from clothjax.physics.energies import GRAVITY, SLIVER, THICKNESS
from clothjax.runtime import drape
from clothjax.runtime.models import Cloth, ForcePredictor, Layer, Model, Shown

DRAPE = ("change", "garment", "position", "velocity", "still")  # of the state, beside `latent` and `history`
AXES = ([1, 2, 0], [2, 0, 1])


class Parts(NamedTuple):
    """What a model with forces has, checked to be there."""

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


def shapes(model: Model) -> dict[str, tuple[int, ...]]:
    """Return the shapes of `DRAPE` by name, without the leading axis."""
    vertices = len(parts(model).cloth.mass)
    sizes = ((len(model.network.first),), (3, vertices), (vertices, 3), (vertices, 3), ())
    return dict(zip(DRAPE, sizes, strict=True))


def blended(g: Graph, transforms: str, weights: np.ndarray) -> str:
    """Return transforms [N, 3, 4, V] of vertices with weights [J', V], from those [N, J', 12] of the joints."""
    rows = g("MatMul", g("Transpose", transforms, perm=[0, 2, 1]), np.asarray(weights))
    return g.reshape(rows, 3, 4, np.shape(weights)[1])


def moved(g: Graph, rows: str, points: str) -> str:
    """Return points [N, 3, V] moved by transforms [N, 3, 4, V]."""
    turned = g("Mul", g.slice(rows, 2, 0, 3), g("Unsqueeze", points, np.array([1], np.int64)))
    turned = g("ReduceSum", turned, np.array([2], np.int64), keepdims=0)
    return g("Add", turned, g("Squeeze", g.slice(rows, 2, 3, 4), np.array([2], np.int64)))


def next_code(
    g: Graph, model: Model, rows: str, transforms: str, advance: str, turned: str
) -> tuple[str, tuple[str, str]]:
    """Return the next code [N, L], not yet clipped, with points and normals [N, 3, V] of what the garment touches.

    Args:
        rows: transforms [N, 3, 4, V] of the garment that feels, at the next frame.
        transforms: [N, J', 12] of the joints.
        advance: [N, 3, 1] m, the root's step.
        turned: [N, 1, 9 J], the change of the joints' rotations.
    """
    it = parts(model)
    held = g("Add", moved(g, rows, "garment"), advance)
    edges = np.asarray(forces.touching_edges(it.predictor.mesh, model.config.physics))
    planes = _planes(g, it, edges, held, transforms, advance)
    kinds = [
        _momentum(g, model, it, held),
        _elasticity(g, model, it, held),
        _contact(g, model, held, *planes),
    ]
    on_vertices = g("Concat", *(g("Unsqueeze", kind, np.array([1], np.int64)) for kind in kinds), axis=1)
    rotation = g("Unsqueeze", g.slice(rows, 2, 0, 3), np.array([1], np.int64))
    carried_back = g("Mul", rotation, g("Unsqueeze", on_vertices, np.array([3], np.int64)))
    carried_back = g("ReduceSum", carried_back, np.array([2], np.int64), keepdims=0)  # [N, kinds, 3, V]
    flat = g.reshape(carried_back, len(KINDS), int(np.prod(it.template.shape)))
    pulls = _pulled_back(g, model, g("MatMul", flat, np.asarray(it.felt.shapes).T))
    return _predicted(g, model, it, pulls, _awake(g, turned, advance)), planes


def follow(g: Graph, model: Model, latent: str, garment: str, rows: str, advance: str) -> tuple[str, str]:
    """Name the next state of the garment; return its vertices [N, 3, V] m, canonical and relative to the root's place.

    Args:
        latent: [N, L] the next code.
        garment: [N, 3 V] m, its garment in the canonical pose, before relaxation.
        rows, advance: as of `next_code`.
    """
    cloth = parts(model).cloth
    g("Sub", latent, "latent", name="next_change")
    shape = np.array([0, 3, len(cloth.mass)], np.int64)
    if cloth.mobility is None:
        canonical = g("Reshape", garment, shape, name="next_garment")
        placed = moved(g, rows, canonical)
    else:
        decoded = g("Reshape", garment, shape)
        skinned = moved(g, rows, decoded)
        placed = _relaxed(g, model, skinned, model.config.model.relaxation)
        back = _unapplied(g, rows, g("Sub", placed, skinned))
        canonical = g("Add", decoded, back, name="next_garment")
    position = g("Transpose", placed, perm=[0, 2, 1], name="next_position")
    g("Sub", g("Add", position, g("Transpose", advance, perm=[0, 2, 1])), "position", name="next_velocity")
    return canonical, placed


class Outside(NamedTuple):
    """Planes that a garment is pushed out of, for each of its vertices: rows [N, 3, V] and [N, 1, V]."""

    point: str
    normal: str
    apart: str  # how far outside of the plane the vertex is then

    def at(self, g: Graph, nearest: np.ndarray) -> "Outside":
        """Return those of some of the vertices [V']."""
        return Outside(*(g("Gather", row, nearest.astype(np.int64), axis=2) for row in self))


def outside(g: Graph, model: Model, position: str, planes: tuple[str, str], advance: str) -> Outside:
    """Return what a garment is pushed out of, none of it by more than `drape.DEEPEST`.

    Args:
        position: [N, 3, V] m, of `follow`.
        planes, advance: as of `next_code`.
    """
    point, normal = g("Sub", planes[0], advance), planes[1]
    farthest = g("Add", _dot(g, g("Sub", position, point), normal), np.float32(drape.DEEPEST))
    return Outside(point, normal, g("Min", farthest, np.float32(model.config.physics.collision_offset)))


def relaxed_outside(g: Graph, model: Model, position: str, planes: Outside) -> str:
    """Return the garment [N, 3, V] m that feels, pushed out and relaxed in turn, but for the last push.

    Args:
        position: [N, 3, V] m, of `follow`.
    """
    for _ in range(0 if parts(model).cloth.mobility is None else model.config.model.relaxation):
        position = _relaxed(g, model, pushed_out(g, position, planes), 1)
    return position


def shown_apart(g: Graph, model: Model, garment: str, decoded: str, canonical: str) -> str:
    """Return the garment [N, 3 V'] m that is shown where another feels, moved as that one.

    Args:
        garment: [N, 3 V'] m, before.
        decoded: [N, 3 V] m, the garment that feels as it is decoded ...
        canonical: [N, 3, V] m, ... and as it is moved.
    """
    it = parts(model)
    felt = it.predictor.felt
    assert felt is not None
    if it.cloth.mobility is None:
        return garment
    moved = g("Sub", canonical, g.reshape(decoded, 3, len(it.cloth.mass)))
    taken = g("Gather", moved, np.asarray(felt.around, np.int64), axis=2)  # [N, 3, V', 3]
    taken = g("ReduceSum", g("Mul", taken, np.asarray(felt.shares)), np.array([3], np.int64), keepdims=0)
    return g("Add", garment, g.reshape(taken, 3 * len(felt.around)))


def carried_back(g: Graph, rows: str, canonical: str, position: str, later: str) -> str:
    """Return the garment [N, 3, V] m that feels, in the canonical pose, where it has moved from one place to another.

    Args:
        rows: as of `next_code`.
        canonical, position: [N, 3, V] m, of `follow`.
        later: [N, 3, V] m, of `relaxed_outside`.
    """
    return g("Add", canonical, _unapplied(g, rows, g("Sub", later, position)))


def _relaxed(g: Graph, model: Model, position: str, steps: int) -> str:
    """Return positions [N, 3, V] m after some of the steps of `relaxation.relaxed`."""
    it = parts(model)
    mobility = np.asarray(it.cloth.mobility)
    faces, longest = np.asarray(it.predictor.mesh.faces), np.float32(relaxation.LONGEST**-2)
    for _ in range(steps):
        pull = _at_vertices(g, _stretching(g, it, position, faces), [faces], len(mobility))
        move = g("Mul", pull, -mobility)
        length = g("Sqrt", g("Add", g("Mul", _dot(g, move, move), longest), np.float32(1.0)))
        position = g("Add", position, g("Div", move, length))
    return position


def _unapplied(g: Graph, rows: str, vectors: str) -> str:
    """Return vectors [N, 3, V] carried back by transforms [N, 3, 4, V], as by `skinning.unapply_direction`."""
    a, b, c = (g("Squeeze", g.slice(rows, 2, k, k + 1), np.array([2], np.int64)) for k in range(3))
    normals = [_cross(g, *pair) for pair in ((b, c), (c, a), (a, b))]
    determinant, least = _dot(g, a, normals[0]), np.float32(1e-3)
    nearest = g("Where", g("Less", determinant, np.float32(0.0)), -least, least)
    safe = g("Where", g("Less", g("Abs", determinant), least), nearest, determinant)
    return g("Div", g("Concat", *(_dot(g, normal, vectors) for normal in normals), axis=1), safe)


def pushed_out(g: Graph, position: str, planes: Outside) -> str:
    """Return vertices [N, 3, V] m, pushed out of planes as by `contact_search.pushed_out`."""
    gap = _dot(g, g("Sub", position, planes.point), planes.normal)
    depth = g("Min", g("Relu", g("Sub", planes.apart, gap)), np.float32(drape.DEEPEST))
    return g("Add", position, g("Mul", depth, planes.normal))


def pushed(g: Graph) -> str:
    """Return whether `external` is finite, [N, 1] bool."""
    return g.all(g("Less", g("Abs", "external"), np.float32(np.finfo(np.float32).max)), axis=1)


def _external(g: Graph) -> str:
    """Return the external acceleration [N, 3] m/s^2, zero where it is not finite."""
    return g("Where", pushed(g), "external", np.zeros((1, 3)))


def _awake(g: Graph, turned: str, advance: str) -> str:
    """Name the next `still` as `drape.stood` does; return the share [N, 1] that is left of a change of the code."""
    moved = g("ReduceMax", g("Abs", turned), axes=[1, 2], keepdims=0)
    moved = g("Max", moved, g("ReduceMax", g("Abs", advance), axes=[1, 2], keepdims=0))
    quiet = g("Equal", g("ReduceMax", g("Abs", _external(g)), axes=[1], keepdims=0), np.float32(0.0))
    quiet = g("And", g("Less", moved, np.float32(drape.STILL)), quiet)
    one, zero = np.float32(1.0), np.float32(0.0)
    still = g("Where", quiet, g("Add", "still", one), zero, name="next_still")
    share = g("Pow", np.float32(drape.SLOWING), g("Relu", g("Sub", still, np.float32(drape.AWAKE))))
    return g("Unsqueeze", share, np.array([1], np.int64))


def _momentum(g: Graph, model: Model, it: Parts, held: str) -> str:
    timestep = 1.0 / model.config.fps
    weight = 0.0 if "gravity" in model.config.physics.without else GRAVITY
    further = g("Mul", g.reshape(_external(g), 1, 3), np.float32(timestep**2))
    flown = g("Add", g("Add", "position", "velocity"), further)
    apart = g("Sub", g("Transpose", flown, perm=[0, 2, 1]), held)
    down = np.array([[0.0], [-weight], [0.0]])
    return g("Mul", g("Add", g("Mul", apart, np.float32(1.0 / timestep**2)), down), np.asarray(it.cloth.mass))


def _elasticity(g: Graph, model: Model, it: Parts, held: str) -> str:
    """Elastic forces [N, 3, V] in N: minus the gradient of the stretching and bending energies, in closed form."""
    faces, hinges = (np.asarray(x) for x in (it.predictor.mesh.faces, it.predictor.mesh.hinges))
    gradients = _stretching(g, it, held, faces)
    gradients += _bending(g, model, it, held, hinges)
    return g("Neg", _at_vertices(g, gradients, [faces, hinges], it.template.shape[1]))


def _at_vertices(g: Graph, gradients: list[str], elements: list[np.ndarray], vertices: int) -> str:
    """Sum the gradients [N, 3, n] for the corners of elements, in the order of `_around`, to those [N, 3, V]."""
    table = _around(elements, vertices)
    rows = g("Pad", g("Concat", *gradients, axis=2), np.array([0, 0, 0, 0, 0, 1], np.int64))
    gathered = g.reshape(g("Gather", rows, table.reshape(-1), axis=2), 3, *table.shape)
    return g("ReduceSum", gathered, np.array([3], np.int64), keepdims=0)


def _around(elements: list[np.ndarray], vertices: int) -> np.ndarray:
    """Return the corners of elements at each vertex [V, D] int64; rows end with the number of corners.

    Corners are numbered by the elements, then by their place in one, then by the element.
    """
    corners = np.concatenate([each.T.reshape(-1) for each in elements])
    order, counts = np.argsort(corners, kind="stable"), np.bincount(corners, minlength=vertices)
    table = np.full((vertices, counts.max(initial=1)), len(corners))
    table[np.repeat(np.arange(vertices), counts), np.concatenate([np.arange(count) for count in counts])] = order
    return table


def _stretching(g: Graph, it: Parts, held: str, faces: np.ndarray) -> list[str]:
    """Gradients [N, 3, F] of the stretching energy for the three corners."""
    rest, material = it.cloth.rest, it.cloth.material
    a, b, c, d = np.asarray(rest.inverse).reshape(-1, 4).T
    size = np.asarray(rest.face_area) * THICKNESS
    stiff, lam = 2.0 * float(material.mu) * size, float(material.lam) * size
    corners = [g("Gather", held, faces[:, k], axis=2) for k in range(3)]
    first, second = (g("Sub", corners[k], corners[2]) for k in range(2))
    along = g("Add", g("Mul", first, a), g("Mul", second, c))
    across = g("Add", g("Mul", first, b), g("Mul", second, d))
    one = np.float32(1.0)
    stretch = [g("Mul", g("Sub", _dot(g, x, x), one), np.float32(0.5)) for x in (along, across)]
    shear = g("Mul", _dot(g, along, across), 0.5 * stiff)
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
    normals = [_cross(g, edge, left), _cross(g, right, edge)]
    squared, *sides = (_dot(g, x, x) for x in (edge, left, right))
    squares = [_dot(g, x, x) for x in normals]
    size = g("Max", squared, *sides)
    bent = g("Greater", g("Min", *squares), g("Mul", g("Mul", size, size), np.float32(SLIVER**2)))
    one = np.float32(1.0)
    squared, *squares = (g("Where", bent, x, one) for x in (squared, *squares))
    length = g("Sqrt", squared)
    sine, cosine = _dot(g, _cross(g, *normals), edge), g("Mul", _dot(g, *normals), length)
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
    places = [g("Div", _dot(g, x, edge), squared) for x in (left, right)]
    longer = g("Mul", g("Mul", weight, g("Mul", angle, angle)), edge)
    at_end = g("Neg", g("Add", *(g("Mul", x, y) for x, y in zip(places, tips, strict=True))))
    at_start = g("Neg", g("Add", at_end, g("Add", *tips)))
    return [g("Sub", at_start, longer), g("Add", at_end, longer), *tips]


def _planes(g: Graph, it: Parts, edges: np.ndarray, held: str, transforms: str, advance: str) -> tuple[str, str]:
    """Points and normals [N, 3, V] of the nearest faces, raised, as of `forces.felt`."""
    predictor, cloth = it.predictor, it.cloth
    vertices = it.template.shape[1]
    rows = blended(g, transforms, np.asarray(predictor.body))
    body = g("Add", moved(g, rows, g.constant(np.asarray(cloth.body).T[None])), advance)
    faces = np.asarray(predictor.faces)[np.asarray(predictor.clusters.points).reshape(-1)]
    corners = [g("Gather", body, faces[:, k], axis=2) for k in range(3)]
    centres = g("Mul", g("Add", g("Add", corners[0], corners[1]), corners[2]), np.float32(1.0 / 3.0))
    normals = _cross(g, *(g("Sub", corner, corners[0]) for corner in corners[1:]))
    length = g("Sqrt", g("Max", _dot(g, normals, normals), np.float32(1e-30)))
    normals = g("Div", normals, length)
    face = g.reshape(_nearest(g, predictor.clusters, held, centres), 1, vertices)
    face = g("Concat", face, face, face, axis=1)
    point, normal = (g("GatherElements", x, face, axis=2) for x in (centres, normals))
    if len(edges) == 0:
        return point, normal
    turned, along = (g("Sub", *(g("Gather", x, edges[:, k], axis=2) for k in range(2))) for x in (normal, held))
    bulge = g("Mul", _dot(g, turned, along), np.float32(1 / 8))
    bulge = g("Min", g("Relu", bulge), np.float32(forces.HIGHEST))
    table = _around([edges], vertices)
    rows = g("Pad", g("Concat", bulge, bulge, axis=2), np.array([0, 0, 0, 0, 0, 1], np.int64))
    gathered = g.reshape(g("Gather", rows, table.reshape(-1), axis=2), 1, *table.shape)
    raised = g("ReduceMax", gathered, axes=[3], keepdims=0)
    return g("Add", point, g("Mul", raised, normal)), normal


def _nearest(g: Graph, clusters: Clusters, held: str, centres: str) -> str:
    """Places [N, V] of the nearest of the points [N, 3, 16 P], as of `clusters.nearest_in_clusters`.

    Args:
        centres: the points in the order of their clusters.
    """
    asked, (count, size) = np.asarray(clusters.positions), np.shape(clusters.points)
    groups, tried = len(asked), min(TRIED, count)
    near = g.reshape(g("Gather", held, asked.reshape(-1), axis=2), 3, *asked.shape)
    middle = g("ReduceMean", near, axes=[3], keepdims=1)  # [N, 3, G, 1]
    patches = g.reshape(centres, 3, count, size)
    means = g("ReduceMean", patches, axes=[3], keepdims=1)
    radius = g("ReduceSumSquare", g("Sub", patches, means), axes=[1], keepdims=1)
    radius = g("Sqrt", g("ReduceMax", radius, axes=[3], keepdims=0))  # [N, 1, P]
    apart = g("Sub", middle, g.reshape(means, 3, 1, count))
    bound = g("Sub", g("Sqrt", g("ReduceSumSquare", apart, axes=[1], keepdims=0)), radius)
    chosen = g("Mul", g.reshape(g.lowest(bound, tried), groups, tried, 1), np.int64(size))
    places = g.reshape(g("Add", chosen, np.arange(size)), 1, groups * tried * size)
    beside = g("GatherElements", centres, g("Concat", places, places, places, axis=1), axis=2)
    # half the squared distance without the part of the position, from the middle: far from it products cancel
    beside = g("Sub", g.reshape(beside, 3, groups, tried * size), middle)
    half = g("Mul", g("ReduceSumSquare", beside, axes=[1], keepdims=0), np.float32(0.5))
    near = g("Transpose", g("Sub", near, middle), perm=[0, 2, 3, 1])
    product = g("MatMul", near, g("Transpose", beside, perm=[0, 2, 1, 3]))  # [N, G, S, tried size]
    score = g("Sub", g("Unsqueeze", half, np.array([2], np.int64)), product)
    best = g("ArgMin", score, axis=3, keepdims=0)  # [N, G, S]
    found = g("GatherElements", g.reshape(places, groups, tried * size), best, axis=2)
    order = np.zeros(asked.max() + 1, np.int64)
    order[asked.reshape(-1)] = np.arange(asked.size)
    return g("Gather", g.reshape(found, asked.size), order, axis=1)


def _contact(g: Graph, model: Model, held: str, point: str, normal: str) -> str:
    """Forces [N, 3, V] in N of planes that are touched, as of `forces.spring`."""
    physics = model.config.physics
    gap = _dot(g, g("Sub", held, point), normal)
    depth = g("Relu", g("Sub", np.float32(physics.collision_offset), gap))
    return g("Mul", g("Mul", depth, np.float32(3.0 * forces.DEPTH * physics.collision_stiffness)), normal)


def _pulled_back(g: Graph, model: Model, on_weights: str) -> str:
    """Return forces [N, kinds, L] on whitened codes, from those [N, kinds, K] on the weights of the blend shapes."""
    network, config = model.network, model.config.model
    read, width = network.read, network.width
    assert isinstance(read, Layer) and isinstance(network.predictor, ForcePredictor)
    last = len(network.decoder) - 1
    before = [g("Add", g("MatMul", "latent", read.kernel), read.bias)]
    before, skip = ([before[0]], None) if len(read.bias) == width else (
        [g.slice(before[0], 1, 0, width)], g.slice(before[0], 1, width, len(read.bias))
    )  # fmt: skip
    for number, layer in enumerate(network.decoder):
        if number < last or config.blendshape_relu:
            before.append(g("Add", g("MatMul", g("Relu", before[-1]), layer.kernel), layer.bias))
    force = on_weights
    if network.mix is not None:
        force = g("MatMul", force, np.asarray(network.mix.kernel).T)
    if config.blendshape_relu:
        weights = before.pop()
        force = _masked(g, force, weights if skip is None else g("Add", weights, skip))
    of_skip = force
    for layer in reversed(network.decoder):
        force = _masked(g, g("MatMul", force, np.asarray(layer.kernel).T), before.pop())
    whole = force if skip is None else g("Concat", force, of_skip, axis=2)
    back = np.asarray(network.predictor.scales.whitening.back, np.float64)
    return g("MatMul", whole, np.asarray(read.kernel, np.float64).T @ back)


def _masked(g: Graph, force: str, before: str) -> str:
    """Return forces [N, kinds, n] where a ReLU of values [N, n] lets them through."""
    open_ = g("Cast", g("Greater", before, np.float32(0.0)), to=g.onnx.TensorProto.FLOAT)
    return g("Mul", force, g("Unsqueeze", open_, np.array([1], np.int64)))


def _predicted(g: Graph, model: Model, it: Parts, pulls: str, share: str) -> str:
    """Return the next code [N, L] from the forces [N, kinds, L] on whitened codes, as `psi.next_code`.

    Args:
        share: [N, 1], that is left of its change.
    """
    scales, params, size = it.predictor.scales, it.predictor.params, len(model.network.first)
    inputs = (2 + len(KINDS)) * size
    change = g("MatMul", "change", np.asarray(scales.whitening.to))
    seen = g("Concat", "latent", change, g.reshape(pulls, len(KINDS) * size), axis=1)
    spread = psi.BOUND * np.asarray(scales.spread)[:inputs]
    seen = g("Tanh", g("Div", g("Sub", seen, np.asarray(scales.middle)[:inputs]), spread))
    seen = g("Mul", seen, np.float32(psi.BOUND))
    constants = np.asarray(psi.scaled_inputs(scales, jnp.pad(it.cloth.constants, (inputs, 0))))[inputs:]

    def reading(layer: dict) -> Layer:
        kernel = np.asarray(layer["kernel"])
        return Layer(kernel[:inputs], np.asarray(layer["bias"]) + constants @ kernel[inputs:])

    x = g.layer(seen, reading(params["mlp"]["dense_0"]))
    for number in range(1, len(params["mlp"])):
        layer = params["mlp"][f"dense_{number}"]
        x = g.layer(g("Relu", x), Layer(layer["kernel"], layer["bias"]))
    moved_by = g("Add", g.layer(seen, reading(params["linear"])), x)
    change = g("MatMul", moved_by, np.asarray(scales.output) * np.asarray(scales.whitening.back))
    return g("Add", "latent", g("Mul", share, change))


def _dot(g: Graph, a: str, b: str) -> str:
    return g("ReduceSum", g("Mul", a, b), np.array([1], np.int64), keepdims=1)


def _cross(g: Graph, a: str, b: str) -> str:
    turned = [[g("Gather", x, np.array(axes, np.int64), axis=1) for axes in AXES] for x in (a, b)]
    return g("Sub", g("Mul", turned[0][0], turned[1][1]), g("Mul", turned[0][1], turned[1][0]))
