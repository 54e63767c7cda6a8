"""The part of an ONNX graph that a Psi with forces adds: how its garment hangs, and the next code from forces on it.

It follows `clothjax/runtime/drape.py`. A row of vectors is [N, 3, n], of scalars [N, 1, n], for N characters.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from clothjax.export import onnx_forces
from clothjax.export.onnx_forces import Parts, Planes
from clothjax.export.onnx_graph import Graph
from clothjax.networks import forces, psi
from clothjax.networks.forces import KINDS
from clothjax.physics import relaxation
from clothjax.runtime import drape, inference
from clothjax.runtime.models import Felt, ForcePredictor, Layer, Model

DRAPE = ("change", "garment", "position", "velocity", "still")  # of the state, beside `latent` and `history`


def shapes(model: Model) -> dict[str, tuple[int, ...]]:
    """Return the shapes of `DRAPE` by name, without the leading axis."""
    vertices = len(onnx_forces.parts(model).cloth.mass)
    sizes = ((len(model.network.first),), (3, vertices), (vertices, 3), (vertices, 3), ())
    return dict(zip(DRAPE, sizes, strict=True))


class Touched(NamedTuple):
    """Planes that the garment may touch, as of `drape.Touched`."""

    vertices: Planes
    edges: Planes | None  # None if edges do not touch, or if nothing is shown; ...
    far: str  # [N, 1, E] ... which touch none of these planes


def next_code(
    g: Graph, model: Model, rows: str, transforms: str, advance: str, turned: str, shown: bool
) -> tuple[str, Touched]:
    """Return the next code [N, L], not yet clipped, and what the garment touches.

    Args:
        rows: transforms [N, 3, 4, V] of the garment that feels, at the next frame.
        transforms: [N, J', 12] of the joints.
        advance: [N, 3, 1] m, the root's step.
        turned: [N, 1, 9 J], the change of the joints' rotations.
        shown: whether what its edges touch is needed.
    """
    it = onnx_forces.parts(model)
    held = g("Add", onnx_forces.moved(g, rows, "garment"), advance)
    edges = np.asarray(forces.touching_edges(it.predictor.mesh, model.config.physics))
    surface, clusters = onnx_forces.surface(g, it, transforms, advance), it.predictor.clusters
    among = onnx_forces.searched(g, clusters, held, surface[0])
    planes, at_edges = onnx_forces.nearest_planes(g, among, held, np.asarray(clusters.positions), surface), None
    far = ""
    if shown and len(edges) > 0:
        middles = _middles(g, held, edges)
        at_edges = onnx_forces.nearest_planes(g, among, middles, np.asarray(clusters.edges), surface)
        apart = g("Sub", middles, at_edges[0])
        far = g("Greater", g.dot(apart, apart), np.float32(drape.REACH**2))
    kinds = [
        onnx_forces.momentum(g, model, it, held),
        onnx_forces.elasticity(g, model, it, held),
        onnx_forces.contact(g, model, held, *onnx_forces.raised(g, planes, held, edges, it.template.shape[1])),
    ]
    on_vertices = g("Concat", *(g("Unsqueeze", kind, np.array([1], np.int64)) for kind in kinds), axis=1)
    rotation = g("Unsqueeze", g.slice(rows, 2, 0, 3), np.array([1], np.int64))
    carried_back = g("Mul", rotation, g("Unsqueeze", on_vertices, np.array([3], np.int64)))
    carried_back = g("ReduceSum", carried_back, np.array([2], np.int64), keepdims=0)  # [N, kinds, 3, V]
    flat = g.reshape(carried_back, len(KINDS), int(np.prod(it.template.shape)))
    pulls = _pulled_back(g, model, g("MatMul", flat, np.asarray(it.felt.shapes).T))
    return _predicted(g, model, it, pulls, _awake(g, turned, advance)), Touched(planes, at_edges, far)


class Hung(NamedTuple):
    """The garment that feels after a step."""

    decoded: str  # [N, 3 V] m, in the canonical pose, before relaxation
    canonical: str  # [N, 3, V] m, and after it
    placed: str  # [N, 3, V] m, posed, relative to the root's place


def follow(g: Graph, model: Model, latent: str, decoded: str, rows: str, advance: str) -> Hung:
    """Name the next state of the garment that feels, and return how it hangs.

    Args:
        latent: [N, L] the next code.
        decoded: as of `Hung`.
        rows, advance: as of `next_code`.
    """
    g("Sub", latent, "latent", name="next_change")
    shape = np.array([0, 3, len(onnx_forces.parts(model).cloth.mass)], np.int64)
    steps = drape.relaxation_steps(model)
    if steps == 0:
        canonical = g("Reshape", decoded, shape, name="next_garment")
        placed = onnx_forces.moved(g, rows, canonical)
    else:
        garment = g("Reshape", decoded, shape)
        skinned = onnx_forces.moved(g, rows, garment)
        placed = _relaxed(g, model, skinned, steps, model.config.model.relaxation_momentum)
        back = _unapplied(g, rows, g("Sub", placed, skinned))
        canonical = g("Add", garment, back, name="next_garment")
    position = g("Transpose", placed, perm=[0, 2, 1], name="next_position")
    g("Sub", g("Add", position, g("Transpose", advance, perm=[0, 2, 1])), "position", name="next_velocity")
    return Hung(decoded, canonical, placed)


def shown_outside(
    g: Graph, model: Model, garment: str, hung: Hung, touched: Touched, rows: str, transforms: str, advance: str
) -> str:
    """Return the vertices [N, 3, V'] m that are shown, as `drape.shown_outside` does, relative to the root's place.

    Args:
        garment: [N, 3 V'] m, that is shown, as it is decoded; not used if it is the one that feels.
        touched: of `next_code`.
        rows, transforms, advance: as of `next_code`.
    """
    predictor, outside = onnx_forces.parts(model).predictor, hung.placed
    felt, edges = predictor.felt, np.asarray(predictor.mesh.edges)

    def targets(positions: str, planes: Planes) -> tuple[str, str, str]:
        point, normal = g("Sub", planes[0], advance), planes[1]
        farthest = g("Add", g.dot(g("Sub", positions, point), normal), np.float32(drape.DEEPEST))
        return point, normal, g("Min", farthest, np.float32(model.config.physics.collision_offset))

    if felt is not None and felt.mesh is not None:
        outside = g.skinned(garment, transforms, model.network.weights)
        how = drape.shown_relaxation(model)
        outside = _relaxed(g, model, outside, how.steps, how.momentum, alone=True)
        sides = np.concatenate([np.asarray(felt.mesh.faces, np.int64)[:, [i, (i + 1) % 3]] for i in range(3)])
        sides = np.unique(np.sort(sides, axis=1), axis=0)
        for _ in range(how.rounds):
            planes = _nearest_beside(g, g("Add", outside, advance), touched, felt)
            of_shown = targets(outside, onnx_forces.raised(g, planes, outside, sides, len(felt.around), drape.RAISED))
            pushed = partial(_pushed_out, g, point=of_shown[0], normal=of_shown[1], apart=of_shown[2])
            outside = pushed(_relaxed(g, model, outside, how.turns, how.outside_momentum, pushed, alone=True))
        return outside
    of_vertices = targets(outside, touched.vertices)
    of_edges = None
    if touched.edges is not None:
        point, normal, apart = targets(_middles(g, outside, edges), touched.edges)
        of_edges = point, normal, g("Where", touched.far, np.float32(-inference.FARTHEST), apart)

    def pushed_out(garment: str) -> str:
        if of_edges is not None:
            garment = _edges_pushed_out(g, model, garment, edges, *of_edges)
        return _pushed_out(g, garment, *of_vertices)

    outside = pushed_out(_relaxed(g, model, outside, drape.relaxation_steps(model), 0.0, pushed_out))
    if felt is None:
        return outside
    back = _unapplied(g, rows, g("Sub", outside, hung.placed))
    garment = shown_apart(g, model, garment, hung._replace(canonical=g("Add", hung.canonical, back)), transforms)
    near = (g("Gather", row, np.asarray(felt.nearest, np.int64), axis=2) for row in of_vertices)
    return _pushed_out(g, g.skinned(garment, transforms, model.network.weights), *near)


def _nearest_beside(g: Graph, position: str, touched: Touched, felt: Felt) -> Planes:
    """Return the planes of vertices [N, 3, V] m as of `drape._nearest_beside`; positions are where the planes are."""
    (point, normal), place = touched.vertices, None
    if touched.edges is not None:
        assert touched.far is not None
        place = g("Where", touched.far, np.float32(inference.FARTHEST), touched.edges[0])
        normal = g("Concat", normal, touched.edges[1], axis=2)
    beside = np.asarray(felt.beside, np.int64)
    place = point if place is None else g("Concat", point, place, axis=2)
    among = g.reshape(g("Gather", place, beside.reshape(-1), axis=2), 3, *beside.shape)
    normals = g.reshape(g("Gather", normal, beside.reshape(-1), axis=2), 3, *beside.shape)
    apart = g("Sub", among, g("Unsqueeze", position, np.array([3], np.int64)))
    apart = g("ReduceSumSquare", apart, axes=[1], keepdims=1)  # [N, 1, V, n]
    chosen = g("ArgMin", apart, axis=3, keepdims=1)
    chosen = g("Concat", chosen, chosen, chosen, axis=1)
    point, normal = (g.reshape(g("GatherElements", rows, chosen, axis=3), 3, len(beside)) for rows in (among, normals))
    return point, normal


def shown_apart(g: Graph, model: Model, garment: str, hung: Hung, transforms: str) -> str:
    """Return the garment [N, 3 V'] m that is shown where another feels: with its part of how that one has moved.

    If it is relaxed by itself, it is with how it moves.

    Args:
        garment: [N, 3 V'] m, as it is decoded.
        hung: of the other one.
        transforms: [N, J', 12] of the joints.
    """
    it = onnx_forces.parts(model)
    felt = it.predictor.felt
    assert felt is not None
    if felt.mesh is not None:
        rows = onnx_forces.blended(g, transforms, np.asarray(model.network.weights))
        decoded = g.reshape(garment, 3, len(felt.around))
        skinned = onnx_forces.moved(g, rows, decoded)
        how = drape.shown_relaxation(model)
        placed = _relaxed(g, model, skinned, how.steps, how.momentum, alone=True)
        back = _unapplied(g, rows, g("Sub", placed, skinned))
        return g.reshape(g("Add", decoded, back), 3 * len(felt.around))
    moved = g("Sub", hung.canonical, g.reshape(hung.decoded, 3, len(it.cloth.mass)))
    taken = g("Gather", moved, np.asarray(felt.around, np.int64), axis=2)  # [N, 3, V', 3]
    taken = g("ReduceSum", g("Mul", taken, np.asarray(felt.shares)), np.array([3], np.int64), keepdims=0)
    return g("Add", garment, g.reshape(taken, 3 * len(felt.around)))


def _pushed_out(g: Graph, position: str, point: str, normal: str, apart: str) -> str:
    """Return vertices [N, 3, V] m, pushed out of planes as by `contact_search.pushed_out`."""
    return g("Add", position, g("Mul", _depth(g, position, point, normal, apart), normal))


def _edges_pushed_out(
    g: Graph, model: Model, position: str, edges: np.ndarray, point: str, normal: str, apart: str
) -> str:
    """Return vertices [N, 3, V] m, the ends of edges moved as by `contact_search.edges_pushed_out`."""
    depth = _depth(g, _middles(g, position, edges), point, normal, apart)
    pushes = g("Cast", g("Greater", depth, np.float32(0.0)), to=g.onnx.TensorProto.FLOAT)
    rows = g("Concat", g("Mul", depth, normal), pushes, axis=1)
    total = onnx_forces.at_vertices(g, [rows, rows], [edges], len(onnx_forces.parts(model).cloth.mass))
    mean = g("Div", g.slice(total, 1, 0, 3), g("Max", g.slice(total, 1, 3, 4), np.float32(1.0)))
    return g("Add", position, mean)


def _depth(g: Graph, position: str, point: str, normal: str, apart: str) -> str:
    """Return how far positions [N, 3, n] m are to be pushed out of planes, [N, 1, n] m."""
    gap = g.dot(g("Sub", position, point), normal)
    return g("Min", g("Relu", g("Sub", apart, gap)), np.float32(drape.DEEPEST))


def _middles(g: Graph, positions: str, edges: np.ndarray) -> str:
    """Return the middles [N, 3, E] m of edges [E, 2] of positions [N, 3, V] m."""
    start, end = (g("Gather", positions, edges[:, k], axis=2) for k in range(2))
    return g("Mul", g("Add", start, end), np.float32(0.5))


def _relaxed(
    g: Graph,
    model: Model,
    position: str,
    steps: int,
    momentum: float,
    placed: Callable[[str], str] | None = None,
    alone: bool = False,
) -> str:
    """Return positions [N, 3, V] m after some of the steps of `relaxation.relaxed`.

    Args:
        placed: as there.
        alone: they are of the garment of `Felt.mesh`, not of the one that feels.
    """
    it = onnx_forces.parts(model)
    mesh, rest, mobility = it.predictor.mesh, it.cloth.rest, it.cloth.mobility
    if alone:
        assert it.predictor.felt is not None and it.predictor.felt.mesh is not None and it.cloth.shown is not None
        mesh, (rest, mobility) = it.predictor.felt.mesh, it.cloth.shown
    faces, mobility, longest = np.asarray(mesh.faces), np.asarray(mobility), np.float32(relaxation.LONGEST**-2)
    before, share = position, np.float32(momentum)
    for _ in range(steps):
        position = position if placed is None else placed(position)
        gradients = onnx_forces.stretching(g, rest, it.cloth.material, position, faces)
        pull = onnx_forces.at_vertices(g, gradients, [faces], len(mobility))
        move = g("Mul", pull, -(1 + share) * mobility)
        length = g("Sqrt", g("Add", g("Mul", g.dot(move, move), longest), np.float32(1.0)))
        move = g("Div", move, length)
        if momentum > 0 and before is not position:
            move = g("Add", move, g("Mul", g("Sub", position, before), share))
        position, before = g("Add", position, move), position
    return position


def _unapplied(g: Graph, rows: str, vectors: str) -> str:
    """Return vectors [N, 3, V] carried back by transforms [N, 3, 4, V], as by `skinning.unapply_direction`."""
    a, b, c = (g("Squeeze", g.slice(rows, 2, k, k + 1), np.array([2], np.int64)) for k in range(3))
    normals = [g.cross(*pair) for pair in ((b, c), (c, a), (a, b))]
    determinant, least = g.dot(a, normals[0]), np.float32(1e-3)
    nearest = g("Where", g("Less", determinant, np.float32(0.0)), -least, least)
    safe = g("Where", g("Less", g("Abs", determinant), least), nearest, determinant)
    return g("Div", g("Concat", *(g.dot(normal, vectors) for normal in normals), axis=1), safe)


def _awake(g: Graph, turned: str, advance: str) -> str:
    """Name the next `still` as `drape.stood` does; return the share [N, 1] that is left of a change of the code."""
    moved = g("ReduceMax", g("Abs", turned), axes=[1, 2], keepdims=0)
    moved = g("Max", moved, g("ReduceMax", g("Abs", advance), axes=[1, 2], keepdims=0))
    quiet = g("Equal", g("ReduceMax", g("Abs", onnx_forces.external(g)), axes=[1], keepdims=0), np.float32(0.0))
    quiet = g("And", g("Less", moved, np.float32(drape.STILL)), quiet)
    one, zero = np.float32(1.0), np.float32(0.0)
    still = g("Where", quiet, g("Add", "still", one), zero, name="next_still")
    share = g("Pow", np.float32(drape.SLOWING), g("Relu", g("Sub", still, np.float32(drape.AWAKE))))
    return g("Unsqueeze", share, np.array([1], np.int64))


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
    inputs = psi.DIRECTED * size
    change = g("MatMul", "change", np.asarray(scales.whitening.to))
    seen = g("Concat", "latent", change, g.reshape(pulls, len(KINDS) * size), axis=1)
    spread = psi.BOUND * np.asarray(scales.spread)[:inputs]
    seen = g("Tanh", g("Div", g("Sub", seen, np.asarray(scales.middle)[:inputs]), spread))
    seen = g("Mul", seen, np.float32(psi.BOUND))
    constants = np.asarray(psi.scaled_inputs(scales, it.cloth.constants))

    def reading(layer: dict) -> Layer:
        kernel = np.asarray(layer["kernel"])
        return Layer(kernel[:inputs], np.asarray(layer["bias"]) + constants @ kernel[inputs:])

    x = g.layer(seen, reading(params["mlp"]["dense_0"]))
    for number in range(1, len(params["mlp"])):
        layer = params["mlp"][f"dense_{number}"]
        x = g.layer(g("Relu", x), Layer(layer["kernel"], layer["bias"]))
    if model.config.stage2.gated:
        products = g.reshape(g("Mul", x, seen), psi.DIRECTED, size)
        x = g("ReduceSum", products, np.array([1], np.int64), keepdims=0)
    moved_by = g("Add", g.layer(seen, reading(params["linear"])), x)
    change = g("MatMul", moved_by, np.asarray(scales.output) * np.asarray(scales.whitening.back))
    return g("Add", "latent", g("Mul", share, change))
