"""ONNX: one frame of a model as a small graph of standard operators, with the state as plain tensors.

The graph is written out, not traced: a frame takes microseconds, and every operator of a runtime costs about one.
Opset 17 and IR 8 are the newest that ONNX Runtime 1.15, still in engines, loads.
"""

import tempfile
from pathlib import Path

import numpy as np

from clothjax import folding, inference
from clothjax.export import sidecar
from clothjax.export.sidecar import Output
from clothjax.inference import Layer, Model
from clothjax.types import Array, Motion, Pose

OPSET, IR_VERSION = 17, 8
INPUTS = ("latent", "history", "rotations", "translation")
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
    """Writes one frame of a model as ONNX, and beside it a JSON that tells an engine how to drive it.

    Inputs, all with a leading axis [N] of characters, are the state (`latent` [C] and `history` [2, 12 J + 3], of the
    last two frames) and the pose to come (`rotations` [J, 3, 3] local, `translation` [3] m); outputs are the next
    state (`next_latent`, `next_history`), `ok` (see `inference`) and `vertices`.

    Args:
        batch: N; None for one that may differ from call to call. All wear the same body and cloth.
        int8: matrices in eight bits, quantised dynamically.
        output: `vertices` [V, 3] m in the world, those in the canonical pose for an engine to skin, or none, for a
            garment that nobody sees.
        about: more entries for the JSON.

    Raises:
        ImportError: if the extra `export` is not installed.
    """
    try:
        import onnx
    except ImportError as error:
        raise ImportError("ONNX export needs onnx: pip install clothjax[export]") from error
    path = Path(path)
    graph = _frame(model, batch, int8, output)
    made = onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)], producer_name="clothjax", ir_version=IR_VERSION
    )
    onnx.checker.check_model(made, full_check=True)
    if int8:
        quantise(made, path)
    else:
        onnx.save(made, str(path))
    shapes = {
        value.name: [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]
        for value in (*graph.input, *graph.output)
    }
    sidecar.write(model, path, output, sidecar.STATE | {"shapes": shapes} | (about or {}))
    return path


def first_state(model: Model, pose: Pose, batch: int = 1) -> list[np.ndarray]:
    """`latent` and `history` before the first frame, for `batch` characters that stand in `pose`."""
    state = inference.initial_state(model, pose)
    rows = (state.rotations, state.translation, state.positions)
    history = np.concatenate([np.asarray(x).reshape(2, -1) for x in rows], axis=1)
    return [np.repeat(np.asarray(x)[None], batch, axis=0) for x in (state.latent, history)]


def run_onnx(path: str | Path, model: Model, motion: Motion) -> np.ndarray:
    """Vertices [T, V, 3] m of a file over a motion, in ONNX Runtime on one thread.

    Args:
        model: that was written, for the state before the first frame.

    Raises:
        ImportError: if onnxruntime is not installed.
    """
    run = session(path)
    rotations, translation = (np.asarray(x, np.float32)[:, None] for x in (motion.rotations, motion.translation))
    batch = run.get_inputs()[0].shape[0]
    batch = batch if isinstance(batch, int) else 1
    state = first_state(model, Pose(rotations[0, 0], translation[0, 0]), batch)
    vertices = []
    for pose in zip(rotations, translation):
        pose = [np.repeat(x, batch, axis=0) for x in pose]
        *state, shown = run.run([*FOLLOWING[:-1], "vertices"], dict(zip(INPUTS, (*state, *pose), strict=True)))
        vertices.append(shown[0])
    return np.stack(vertices)


def session(path: str | Path):
    """An ONNX Runtime session of a file, on one thread."""
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError("running ONNX needs onnxruntime: pip install clothjax[export]") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


class Graph:
    """Nodes and constants of a graph under construction."""

    def __init__(self, int8: bool = False):
        self.nodes, self.constants, self.int8 = [], [], int8

    def __call__(self, operator: str, *inputs: str | Array, name: str | None = None, **attributes) -> str:
        """Adds a node; arrays among its inputs become constants. Returns the name of its output."""
        import onnx

        inputs = [x if isinstance(x, str) else self.constant(x) for x in inputs]
        name = name or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(onnx.helper.make_node(operator, inputs, [name], name=name, **attributes))
        return name

    def constant(self, array: Array) -> str:
        import onnx

        array = np.asarray(array)
        if array.dtype == np.float64:
            array = array.astype(np.float32)
        name = f"constant_{len(self.constants)}"
        self.constants.append(onnx.numpy_helper.from_array(np.asarray(array, order="C"), name))
        return name

    def reshape(self, x: str, *shape: int) -> str:
        # zero keeps the axis of characters
        return self("Reshape", x, np.array((0, *shape), np.int64))

    def slice(self, x: str, axis: int, start: int, end: int, name: str | None = None) -> str:
        return self("Slice", x, *(np.array([i], np.int64) for i in (start, end, axis)), name=name)

    def within(self, x: str, low: Array, high: Array, name: str | None = None) -> tuple[str, str]:
        """x brought into [low, high], and how far it was moved."""
        inside = self("Min", self("Max", x, np.asarray(low)), np.asarray(high), name=name)
        return inside, self("Abs", self("Sub", inside, x))

    def layer(self, x: str, layer: Layer) -> str:
        return self("Add", self("MatMul", x, np.asarray(layer.kernel), name=f"dense_{len(self.nodes)}"), layer.bias)

    def even(self, x: str, limits: Array, layer: Layer) -> str:
        """`layer` of inputs within +-`limits`, both scaled so that no input is small beside the others (Xiao et al.
        2023): eight bits, where they are used, are shared by all of a row."""
        kernel = np.asarray(layer.kernel)
        if not self.int8:
            return self.layer(x, layer)
        scale = np.sqrt(np.maximum(limits, 1e-6) / np.maximum(np.abs(kernel).max(axis=1), 1e-6)).astype(np.float32)
        return self.layer(self("Mul", x, 1.0 / scale), Layer(kernel * scale[:, None], layer.bias))


def _frame(model: Model, batch: int | None, int8: bool, output: Output):
    """The graph of one frame, operator for operator `inference.step`."""
    import onnx

    g, network, wearer = Graph(int8), model.network, model.wearer
    joints, count = np.asarray(wearer.joints, np.float32), len(model.parents)
    sound, pose, last = _sound(g, count)
    chain = _chain(g, g.reshape(g.slice(pose, 2, 0, 9 * count), count, 3, 3), joints, np.array(model.parents))
    places = g.reshape(_places(g, chain, joints), 1, 3 * count)
    frames = g("Concat", g("Concat", pose, places, axis=2), "history", axis=1)
    g.slice(frames, 1, 0, 2, "next_history")
    inputs, order = _inputs(g, frames, last, joints[model.kept[0]], model)
    inputs = g("Sub", inputs, np.asarray(network.pose_mean)[order])
    bounds = network.pose_bounds
    inputs, moved = g.within(inputs, np.asarray(bounds.low)[order], np.asarray(bounds.high)[order])
    latent, strayed = predicted(g, inputs, model, order)
    slack = np.concatenate([np.asarray(bounds.slack)[order], np.asarray(network.code_bounds.slack)])
    fine = g("LessOrEqual", g("Concat", moved, strayed, axis=1), slack)
    least = g("ReduceMin", g("Cast", fine, to=onnx.TensorProto.FLOAT), axes=[1], keepdims=0)
    fine = g("Greater", least, np.float32(0.5 if wearer.known else 2.0))
    g("And", fine, g("Reshape", sound, np.array([-1], np.int64)), name="ok")

    vertices = len(wearer.template[0])
    if output != "none":
        template = np.asarray(wearer.template).reshape(-1)
        garment = g.even(shape_weights(g, latent, model), _weight_limits(model), Layer(network.shapes, template))
        if output == "world":
            _skin(g, garment, chain, g.slice(pose, 2, 9 * count, 9 * count + 3), model, vertices)
        else:
            g("Transpose", g.reshape(garment, 3, vertices), perm=[0, 2, 1], name="vertices")

    number = "N" if batch is None else batch

    def described(**shapes: tuple[int, ...]) -> list:
        float32 = onnx.TensorProto.FLOAT
        return [onnx.helper.make_tensor_value_info(x, float32, (number, *shape)) for x, shape in shapes.items()]

    latent, history = (len(network.first),), (2, 12 * count + 3)
    given = described(latent=latent, history=history, rotations=(count, 3, 3), translation=(3,))
    following = described(next_latent=latent, next_history=history)
    following.append(onnx.helper.make_tensor_value_info("ok", onnx.TensorProto.BOOL, (number,)))
    shown = [] if output == "none" else described(vertices=(vertices, 3))
    return onnx.helper.make_graph(g.nodes, "clothjax", given, following + shown, g.constants)


def _sound(g: Graph, count: int) -> tuple[str, str, str]:
    """Whether the pose is finite [N, 1, 1]; its rotations and translation [N, 1, 9 J + 3], or the last ones, which
    come third."""
    import onnx

    given = g("Concat", g.reshape("rotations", 1, 9 * count), g.reshape("translation", 1, 3), axis=2)
    last = g.slice(g.slice("history", 1, 0, 1), 2, 0, 9 * count + 3)
    limits = np.repeat([2.0, inference.FARTHEST], [9 * count, 3]).astype(np.float32)
    near = g("Less", g("Abs", given), limits)  # NaN is not less than anything
    least = g("ReduceMin", g("Cast", near, to=onnx.TensorProto.FLOAT), axes=[2], keepdims=1)
    sound = g("Greater", least, np.float32(0.5))
    return sound, g("Where", sound, given, last), last


def _chain(g: Graph, local: str, joints: Array, parents: Array) -> str:
    """Skinning transforms (2) [N, J + 1, 4, 4] of local rotations [N, J, 3, 3], the last the identity.

    Pointer jumping, as in `skinning.forward_kinematics`.
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
    """Positions [N, J, 3] m of the joints."""
    count = len(joints)
    homogeneous = np.concatenate([joints, np.ones((count, 1))], axis=1).astype(np.float32)
    part = g("Slice", chain, *(np.array(x, np.int64) for x in ([0, 0], [count, 3], [1, 2])))
    return g("ReduceSum", g("Mul", part, homogeneous[None, :, None]), np.array([3], np.int64), keepdims=0)


def _inputs(g: Graph, frames: str, last: str, origin: Array, model: Model) -> tuple[str, np.ndarray]:
    """The inputs [N, P] of `latent_predictor.pose_inputs`, in another order, and for each its place in that.

    Args:
        frames: [N, 3, 12 J + 3] rows of the history, the new one first.
        last: the row of the frame before, or its beginning.
    """
    count, root, others = len(model.parents), model.kept[0], np.array(model.kept[1:])
    seen = len(others)
    # cosine and sine of the heading, times something: r00 + r22 and r02 - r20
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
    places = (9 * count + 3 + 3 * others[:, None] + np.arange(3)).reshape(-1)
    relative = g("Sub", g("Gather", frames, places, axis=2), np.tile(origin, seen))
    vectors = g("Concat", steps, columns, g.reshape(relative, 3 * seen, 3), axis=1)
    turned = g.reshape(g("MatMul", vectors, heading), 3 * (2 + 6 + 3 * seen))
    codes = g.reshape(g("Gather", frames, (9 * others[:, None] + of_columns).reshape(-1), axis=2), 18 * seen)

    place = np.arange(6 + 18 * (seen + 1) + 9 * seen)
    velocity, rows, apart = np.split(place, [6, 6 + 18 * (seen + 1)])
    rows = rows.reshape(3, seen + 1, 6)  # frames, joints, two columns
    order = [velocity, rows[:, 0].reshape(-1), apart, rows[:, 1:].reshape(-1)]
    return g("Concat", turned, codes, axis=1), np.concatenate(order)


def predicted(g: Graph, inputs: str, model: Model, order: np.ndarray) -> tuple[str, str]:
    """The next code [N, C], named `next_latent`, and how far it was brought back."""
    network = model.network
    kernel, bias = network.code
    first = np.asarray(network.pose)[order]
    bias = np.asarray(bias) + np.asarray(model.wearer.bias)
    limits = [np.maximum(-np.asarray(b.low), np.asarray(b.high)) for b in (network.pose_bounds, network.code_bounds)]
    limits[0] = limits[0][order]
    if kernel is None:
        x = g("Add", g.even(inputs, limits[0], Layer(first, bias)), g.slice("latent", 1, 0, len(bias)))
    else:
        both = g("Concat", inputs, "latent", axis=1)
        x = g.even(both, np.concatenate(limits), Layer(np.concatenate([first, np.asarray(kernel)]), bias))
    for layer in network.hidden:
        x = g.layer(g("Relu", x), layer)
    kept = g("Mul", "latent", np.float32(1.0 - model.config.stage2.latent_decay))
    bounds = network.code_bounds
    return g.within(g("Add", kept, x), bounds.low, bounds.high, name="next_latent")


def shape_weights(g: Graph, latent: str, model: Model) -> str:
    """The weights [N, K] of the blend shapes."""
    network = model.network
    size, wide = len(network.read.bias), len(network.decoder[0].kernel)
    if network.read.kernel is None:
        whole = len(network.first)
        read = g("Add", g.slice(latent, 1, whole - size, whole), network.read.bias)
    else:
        bounds = network.code_bounds
        read = g.even(latent, np.maximum(-np.asarray(bounds.low), np.asarray(bounds.high)), network.read)
    x = read if size == wide else g.slice(read, 1, 0, wide)
    for layer in network.decoder:
        x = g.layer(g("Relu", x), layer)
    if size > wide:
        x = g("Add", x, g.slice(read, 1, wide, size))
    if model.config.model.blendshape_relu:
        x = g("Relu", x)
    return x if network.mix is None else g.layer(x, network.mix)


def _weight_limits(model: Model) -> np.ndarray:
    """[K] how large the weights become."""
    return np.abs(folding.ordinary_weights(model)).max(axis=0)


def _skin(g: Graph, garment: str, chain: str, translation: str, model: Model, vertices: int) -> None:
    """`vertices` [N, V, 3], one coordinate after the other until the end."""
    moving = np.array(model.moving, np.int64)
    flat = g.slice(g.reshape(g("Gather", chain, moving, axis=1), len(moving), 16), 2, 0, 12)
    rows = g("MatMul", g("Transpose", flat, perm=[0, 2, 1]), np.asarray(model.network.weights), name="skinning")
    one_more = np.array([0, 0, 0, 0, 0, 0, 1, 0], np.int64)
    homogeneous = g("Pad", g.reshape(garment, 1, 3, vertices), one_more, np.float32(1.0))
    moved = g("Mul", g.reshape(rows, 3, 4, vertices), homogeneous)
    placed = g("Add", g("ReduceSum", moved, np.array([2], np.int64), keepdims=0), g.reshape(translation, 3, 1))
    g("Transpose", placed, perm=[0, 2, 1], name="vertices")


def quantise(made, path: Path) -> None:
    """Saves a graph whose dense layers have matrices of eight bits, with a scale for each column."""
    try:
        import onnx
        from onnxruntime.quantization import QuantType, quantize_dynamic
    except ImportError as error:
        raise ImportError("int8 needs onnxruntime: pip install clothjax[export]") from error
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "whole.onnx"
        onnx.save(made, str(whole))
        dense = [node.name for node in made.graph.node if node.name.startswith("dense_")]
        quantize_dynamic(
            whole, path, weight_type=QuantType.QInt8, per_channel=True, nodes_to_quantize=dense,
            extra_options={"MatMulConstBOnly": True},
        )  # fmt: skip
