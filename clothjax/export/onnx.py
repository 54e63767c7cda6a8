"""ONNX: one frame of a model as a small graph of standard operators, with the state as plain tensors.

The graph is written out, not traced: a frame takes microseconds, and every operator of a runtime costs about one.
"""

from pathlib import Path

import numpy as np

from clothjax.export import onnx_drape, onnx_forces, sidecar
from clothjax.export.onnx_graph import Graph, session
from clothjax.export.sidecar import Output
from clothjax.runtime import drape, inference, specialise
from clothjax.runtime.models import FoldedLayer, ForcePredictor, Layer, Model, PosePredictor
from clothjax.types import Array, Motion, Pose

STATE = ("latent", "history")  # and with forces `onnx_drape.DRAPE`
POSE = ("rotations", "translation")
INPUTS = (*STATE, *POSE)  # without forces
FOLLOWING = ("next_latent", "next_history", "ok")


def to_onnx(
    model: Model,
    path: str | Path,
    *,
    batch: int | None = 1,
    int8: bool = False,
    output: Output = "world",
    about: dict | None = None,
) -> Path:
    """Write one frame of a model as ONNX, and beside it a JSON that tells an engine how to drive it.

    All inputs and outputs have a leading axis [N] of characters. The state is `latent` [C]
    and `history` [2, 12 J + 3] of the last two frames, the pose to come `rotations` [J, 3, 3] local and `translation`
    [3] m.
    Outputs are the next state (`next_latent`, `next_history`), `ok` (see `inference`) and `vertices`. With forces the
    state also has the arrays of `models.Drape`, and an input `external` [3] m/s^2.

    Args:
        batch: N; None if it may differ from call to call. All characters have the same body and cloth.
        int8: matrices in eight bits, quantised dynamically.
        output: `vertices` [V, 3] m in the world; in the canonical pose, for an engine to skin; or none, for a garment
            that nobody sees.
        about: more entries for the JSON.

    Raises:
        ValueError: for a model with forces whose body has pose blend shapes.
        ImportError: if the extra `export` is not installed.
    """
    path = Path(path)
    inputs, outputs, graph = _frame(model, "N" if batch is None else batch, int8, output)
    graph.save(path, inputs, outputs, flags=("ok",))
    shapes = {"shapes": {name: list(shape) for name, shape in (inputs | outputs).items()}}
    state = sidecar.STATE if model.wearer.cloth is None else sidecar.STATE_WITH_FORCES
    sidecar.write(model, path, output, state | shapes | (about or {}))
    return path


def first_state(model: Model, pose: Pose, batch: int = 1) -> list[np.ndarray]:
    """Return `latent` [N, C], `history` [N, 2, 12 J + 3] and, with forces, the drape before the first frame.

    They are of N = `batch` characters that have been standing in `pose`.
    """
    state = inference.initial_state(model, pose)
    rows = (state.rotations, state.translation, state.positions)
    history = np.concatenate([np.asarray(x).reshape(2, -1) for x in rows], axis=1)
    return [np.repeat(np.asarray(x)[None], batch, axis=0) for x in (state.latent, history, *(state.drape or ()))]


def run_onnx(path: str | Path, model: Model, motion: Motion) -> np.ndarray:
    """Run a file over a motion in ONNX Runtime on one thread; return vertices [T, V, 3] m.

    Args:
        model: the one that was written, for the state before the first frame.

    Raises:
        ImportError: if onnxruntime is not installed.
    """
    run = session(path)
    rotations, translation = (np.asarray(x, np.float32)[:, None] for x in (motion.rotations, motion.translation))
    batch = run.get_inputs()[0].shape[0]
    batch = batch if isinstance(batch, int) else 1
    state = first_state(model, Pose(rotations[0, 0], translation[0, 0]), batch)
    names = (*STATE, *onnx_drape.DRAPE)[: len(state)]
    external = {"external": np.zeros((batch, 3), np.float32)} if len(state) > len(STATE) else {}
    vertices = []
    for pose in zip(rotations, translation, strict=True):
        pose = [np.repeat(x, batch, axis=0) for x in pose]
        given = dict(zip((*names, *POSE), (*state, *pose), strict=True)) | external
        results = run.run([*(f"next_{name}" for name in names), "vertices"], given)
        *state, frame_vertices = map(np.asarray, results)
        vertices.append(frame_vertices[0])
    return np.stack(vertices)


def _frame(model: Model, batch: int | str, int8: bool, output: Output) -> tuple[dict, dict, Graph]:
    """Return the inputs, the outputs and the graph of one frame, which follows `inference.step`."""
    g, network, wearer, predictor = Graph(int8), model.network, model.wearer, model.network.predictor
    joints, count = np.asarray(wearer.joints, np.float32), len(model.parents)
    sound, pose, last = _sound(g, count)
    chain = _chain(g, g.reshape(g.slice(pose, 2, 0, 9 * count), count, 3, 3), joints, np.array(model.parents))
    places = g.reshape(_places(g, chain, joints), 1, 3 * count)
    frames = g("Concat", g("Concat", pose, places, axis=2), "history", axis=1)
    g.slice(frames, 1, 0, 2, "next_history")
    moving = g("Gather", chain, np.array(model.moving, np.int64), axis=1)
    transforms = g.slice(g.reshape(moving, len(model.moving), 16), 2, 0, 12)
    slack = np.asarray(network.code_bounds.slack)
    rows = advance = ""
    touched = None
    if isinstance(predictor, ForcePredictor):
        stepped = g("Sub", g.slice(pose, 2, 9 * count, 9 * count + 3), g.slice(last, 2, 9 * count, 9 * count + 3))
        advance = g("Transpose", stepped, perm=[0, 2, 1])
        rows = onnx_forces.blended(g, transforms, np.asarray(onnx_forces.parts(model).felt.weights))
        turned = g("Sub", g.slice(pose, 2, 0, 9 * count), g.slice(last, 2, 0, 9 * count))
        shown = output == "world"
        code, touched = onnx_drape.next_code(g, model, rows, transforms, advance, turned, shown)
        latent, strayed = g.within(code, *network.code_bounds[:2], name="next_latent")
        sound = g("And", sound, g("Unsqueeze", onnx_forces.pushed(g), np.array([1], np.int64)))
    else:
        inputs, order = _inputs(g, frames, last, joints[model.input_joints[0]], model)
        inputs = g("Sub", inputs, np.asarray(predictor.pose_mean)[order])
        bounds = predictor.pose_bounds
        inputs, moved = g.within(inputs, np.asarray(bounds.low)[order], np.asarray(bounds.high)[order])
        latent, strayed = predicted(g, inputs, model, order)
        slack = np.concatenate([np.asarray(bounds.slack)[order], slack])
        strayed = g("Concat", moved, strayed, axis=1)
    fine = g.all(g("LessOrEqual", strayed, slack), axis=1)  # NaN is not within the slack
    known = np.array([[bool(wearer.known)]])
    ok = g("And", g("And", fine, known), g("Reshape", sound, np.array([-1, 1], np.int64)))
    g("Reshape", ok, np.array([-1], np.int64), name="ok")

    latent_shape, history_shape = (batch, len(network.first)), (batch, 2, 12 * count + 3)
    given = {"latent": latent_shape, "history": history_shape}
    given |= {"rotations": (batch, count, 3, 3), "translation": (batch, 3)}
    following = {"next_latent": latent_shape, "next_history": history_shape, "ok": (batch,)}
    vertices, hung = wearer.template.shape[1], None
    if isinstance(predictor, ForcePredictor):
        state = {name: (batch, *shape) for name, shape in onnx_drape.shapes(model).items()}
        given |= state | {"external": (batch, 3)}
        following |= {f"next_{name}": shape for name, shape in state.items()}
        felt = onnx_forces.parts(model)
        decoded = canonical(g, latent, model, felt.felt.shapes, felt.template)
        hung = onnx_drape.follow(g, model, latent, decoded, rows, advance)
    if output == "none":
        return given, following, g
    apart = isinstance(predictor, ForcePredictor) and predictor.felt is not None
    garment = canonical(g, latent, model) if hung is None or apart else hung.canonical
    if output == "world":
        if hung is None or touched is None:
            placed = g.skinned(garment, transforms, network.weights)
        else:
            placed = onnx_drape.shown_outside(g, model, garment, hung, touched, rows, transforms, advance)
        placed = g("Add", placed, g.reshape(g.slice(pose, 2, 9 * count, 9 * count + 3), 3, 1))
    else:
        if hung is not None and apart and drape.relaxation_steps(model) > 0:
            garment = onnx_drape.shown_apart(g, model, garment, hung, transforms)
        placed = g.reshape(garment, 3, vertices)
    g("Transpose", placed, perm=[0, 2, 1], name="vertices")
    return given, following | {"vertices": (batch, vertices, 3)}, g


def _sound(g: Graph, count: int) -> tuple[str, str, str]:
    """Return whether the pose is finite [N, 1, 1], the pose to use [N, 1, 9 J + 3], and the last one.

    The last pose replaces one that is not finite.
    """
    given = g("Concat", g.reshape("rotations", 1, 9 * count), g.reshape("translation", 1, 3), axis=2)
    last = g.slice(g.slice("history", 1, 0, 1), 2, 0, 9 * count + 3)
    limits = np.repeat([2.0, inference.FARTHEST], [9 * count, 3]).astype(np.float32)
    sound = g.all(g("Less", g("Abs", given), limits), axis=2)  # NaN is not less than anything
    return sound, g("Where", sound, given, last), last


def _chain(g: Graph, local: str, joints: Array, parents: Array) -> str:
    """Return skinning transforms [R | q - R J] [N, J + 1, 4, 4] of local rotations [N, J, 3, 3].

    The last is the identity. The method is pointer jumping, as in `skinning.forward_kinematics`.
    """
    count = len(parents)
    turned = g("ReduceSum", g("Mul", local, joints[None, :, None]), np.array([3], np.int64), keepdims=1)
    moves = g("Concat", local, g("Sub", joints[None, :, :, None], turned), axis=3)
    padded = g("Pad", moves, np.array([0, 0, 0, 0, 0, 1, 1, 0], np.int64))
    rest = np.zeros((1, count + 1, 4, 4), np.float32)
    rest[..., 3, 3] = 1.0
    rest[:, count] = np.eye(4)
    chain = g("Add", padded, rest)
    ancestor = np.append(np.where(parents < 0, count, parents), count)
    while (ancestor != count).any():
        chain = g("MatMul", g("Gather", chain, ancestor.astype(np.int64), axis=1), chain)
        ancestor = ancestor[ancestor]
    return chain


def _places(g: Graph, chain: str, joints: Array) -> str:
    """Return the positions [N, J, 3] m of the joints."""
    count = len(joints)
    homogeneous = np.concatenate([joints, np.ones((count, 1))], axis=1).astype(np.float32)
    part = g("Slice", chain, *(np.array(x, np.int64) for x in ([0, 0], [count, 3], [1, 2])))
    return g("ReduceSum", g("Mul", part, homogeneous[None, :, None]), np.array([3], np.int64), keepdims=0)


def _inputs(g: Graph, frames: str, last: str, origin: Array, model: Model) -> tuple[str, np.ndarray]:
    """Return the inputs [N, P] of `psi.pose_inputs` in another order, and the index of each in that of `psi`.

    Args:
        frames: [N, 3, 12 J + 3] rows of the history, newest first.
        last: the row of the frame before, or the beginning of it.
    """
    count, root, others = len(model.parents), model.input_joints[0], np.array(model.input_joints[1:], np.int64)
    seen = len(others)
    # cosine and sine of the heading, up to a common factor: r00 + r22 and r02 - r20
    pick = np.zeros((9, 2), np.float32)
    pick[[0, 8], 0], pick[2, 1], pick[6, 1] = 1.0, 1.0, -1.0
    direction = g("MatMul", g.slice(last, 2, 9 * root, 9 * root + 9), pick)
    short = g("Less", g("ReduceSumSquare", direction, axes=[2], keepdims=1), np.float32(1e-12))
    direction = g("Where", short, np.array([1.0, 0.0], np.float32), direction)
    direction = g("Div", direction, g("ReduceL2", direction, axes=[2], keepdims=1))
    spread, up = np.zeros((2, 9), np.float32), np.zeros(9, np.float32)
    spread[0, [0, 8]], spread[1, 2], spread[1, 6], up[4] = 1.0, 1.0, -1.0, 1.0
    heading = g.reshape(g("Add", g("MatMul", direction, spread), up), 3, 3)

    difference = np.float32(model.config.fps) * np.array([[1, -1, 0], [0, 1, -1]], np.float32)
    steps = g("MatMul", difference, g.slice(frames, 2, 9 * count, 9 * count + 3))
    of_columns = np.array([0, 3, 6, 1, 4, 7])  # of a matrix, row by row
    columns = g.reshape(g("Gather", frames, 9 * root + of_columns, axis=2), 6, 3)
    vectors, codes = [steps, columns], []
    if seen:
        places = (9 * count + 3 + 3 * others[:, None] + np.arange(3)).reshape(-1)
        relative = g("Sub", g("Gather", frames, places, axis=2), np.tile(origin, seen))
        vectors.append(g.reshape(relative, 3 * seen, 3))
        of_others = (9 * others[:, None] + of_columns).reshape(-1)
        codes.append(g.reshape(g("Gather", frames, of_others, axis=2), 18 * seen))
    turned = g.reshape(g("MatMul", g("Concat", *vectors, axis=1), heading), 3 * (2 + 6 + 3 * seen))

    place = np.arange(6 + 18 * (seen + 1) + 9 * seen)
    velocity, rows, apart = np.split(place, [6, 6 + 18 * (seen + 1)])
    rows = rows.reshape(3, seen + 1, 6)  # frames, joints, two columns
    order = [velocity, rows[:, 0].reshape(-1), apart, rows[:, 1:].reshape(-1)]
    return g("Concat", turned, *codes, axis=1), np.concatenate(order)


def predicted(g: Graph, inputs: str, model: Model, order: np.ndarray) -> tuple[str, str]:
    """Return the next code [N, C], named `next_latent`, and the distance by which it was clipped."""
    network, predictor = model.network, model.network.predictor
    assert isinstance(predictor, PosePredictor)
    code = predictor.code
    first = np.asarray(predictor.pose)[order]
    bias = np.asarray(code.bias) + np.asarray(model.wearer.bias)
    limits = [np.maximum(-np.asarray(b.low), np.asarray(b.high)) for b in (predictor.pose_bounds, network.code_bounds)]
    limits[0] = limits[0][order]
    if isinstance(code, FoldedLayer):
        x = g("Add", g.balanced(inputs, limits[0], Layer(first, bias)), g.slice("latent", 1, 0, len(bias)))
    else:
        both = g("Concat", inputs, "latent", axis=1)
        x = g.balanced(both, np.concatenate(limits), Layer(np.concatenate([first, np.asarray(code.kernel)]), bias))
    for layer in predictor.hidden:
        x = g.layer(g("Relu", x), layer)
    decayed = g("Mul", "latent", np.float32(1.0 - model.config.stage2.latent_decay))
    bounds = network.code_bounds
    return g.within(g("Add", decayed, x), bounds.low, bounds.high, name="next_latent")


def canonical(g: Graph, latent: str, model: Model, rows: Array | None = None, template: Array | None = None) -> str:
    """Return the garment [N, 3 V] m in the canonical pose, one coordinate after the other.

    Args:
        rows, template: [K, 3 V] and [3, V] m, shapes and template of a garment that is not the one shown.
    """
    rows = model.network.shapes if rows is None else rows
    template = model.wearer.template if template is None else template
    shapes = Layer(rows, np.asarray(template).reshape(-1))
    weights = shape_weights(g, latent, model)
    if not g.int8:
        return g.layer(weights, shapes)
    return g.balanced(weights, np.abs(specialise.ordinary_weights(model)).max(axis=0), shapes)


def shape_weights(g: Graph, latent: str, model: Model) -> str:
    """Return the weights [N, K] of the blend shapes."""
    network = model.network
    size, width, code = len(network.read.bias), network.width, len(network.first)
    if isinstance(network.read, FoldedLayer):
        read = g("Add", g.slice(latent, 1, code - size, code), network.read.bias)
    else:
        read = g.twice(latent, network.read)
    x = read if size == width else g.slice(read, 1, 0, width)
    for layer in network.decoder:
        x = g.layer(g("Relu", x), layer)
    if size > width:
        x = g("Add", x, g.slice(read, 1, width, size))
    if model.config.model.blendshape_relu:
        x = g("Relu", x)
    return x if network.mix is None else g.layer(x, network.mix)
