"""ONNX graphs: building, saving and running them.

Opset 17 and IR 8 are the newest that ONNX Runtime 1.15, still in engines, loads.
"""

import tempfile
from pathlib import Path

import numpy as np

from clothjax.runtime.models import Layer
from clothjax.runtime.specialise import smoothing_scale
from clothjax.types import Array

OPSET, IR_VERSION = 17, 8
AXES = ([1, 2, 0], [2, 0, 1])  # of the factors of a cross product
Value = Array | np.generic  # of a constant


class Graph:
    """An ONNX graph under construction: its nodes and constants.

    Args:
        int8: whether dense layers get matrices of eight bits, quantised dynamically.

    Raises:
        ImportError: if the extra `export` is not installed.
    """

    def __init__(self, int8: bool = False):
        try:
            import onnx
        except ImportError as error:
            raise ImportError("ONNX export needs onnx: pip install clothjax[export]") from error
        self.onnx, self.nodes, self.constants, self.int8 = onnx, [], [], int8

    def __call__(self, operator: str, *inputs: str | Value, name: str | None = None, **attributes) -> str:
        """Add a node; arrays among its inputs become constants. Return the name of its output."""
        names = [x if isinstance(x, str) else self.constant(x) for x in inputs]
        name = name or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, names, [name], name=name, **attributes))
        return name

    def constant(self, array: Value) -> str:
        """Add a constant, float32 if it was float64; return its name."""
        array = np.asarray(array)
        if array.dtype == np.float64:
            array = array.astype(np.float32)
        name = f"constant_{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(array, order="C"), name))
        return name

    def reshape(self, x: str, *shape: int) -> str:
        """Reshape x to [N, *shape]; its first axis, of characters, stays."""
        return self("Reshape", x, np.array((0, *shape), np.int64))  # 0: the axis stays

    def slice(self, x: str, axis: int, start: int, end: int, name: str | None = None) -> str:
        """Return entries [start, end) of x along an axis."""
        return self("Slice", x, *(np.array([i], np.int64) for i in (start, end, axis)), name=name)

    def within(self, x: str, low: Array, high: Array, name: str | None = None) -> tuple[str, str]:
        """Clip x to [low, high], NaN to the middle; return it and how far it was clipped, of NaN NaN."""
        low, high = np.asarray(low), np.asarray(high)
        whole = self("Where", self("IsNaN", x), 0.5 * (low + high), x)
        inside = self("Min", self("Max", whole, low), high, name=name)
        return inside, self("Abs", self("Sub", inside, x))

    def layer(self, x: str, layer: Layer) -> str:
        """Apply a dense layer to x [N, inputs]; return the name of [N, outputs]."""
        return self("Add", self.product(x, layer.kernel), layer.bias)

    def product(self, x: str, kernel: str | Array) -> str:
        """Multiply x [N, inputs] by a kernel [inputs, outputs]; it is a product that `int8` quantises."""
        return self("MatMul", x, kernel, name=f"dense_{len(self.nodes)}")

    def twice(self, x: str, layer: Layer) -> str:
        """Apply a dense layer; with matrices of eight bits, to the quantised inputs and to their quantised remainder.

        The inputs then have enough bits to carry the gains of all rows of the kernel.
        """
        if not self.int8:
            return self.layer(x, layer)
        gain = np.maximum(np.abs(np.asarray(layer.kernel)).max(axis=1), 1e-6)
        x, kernel = self("Mul", x, gain), self.constant(np.asarray(layer.kernel) / gain[:, None])
        quantised = f"quantised_{len(self.nodes)}"
        names = [quantised, f"{quantised}_scale", f"{quantised}_zero"]
        self.nodes.append(self.onnx.helper.make_node("DynamicQuantizeLinear", [x], names, name=quantised))
        coarse = self("DequantizeLinear", *names)
        rest = self("Sub", x, coarse)
        return self("Add", self("Add", self.product(coarse, kernel), self.product(rest, kernel)), layer.bias)

    def balanced(self, x: str, limits: Array, layer: Layer) -> str:
        """Apply a dense layer to inputs within +-`limits`; with eight bits both are scaled by `smoothing_scale`."""
        if not self.int8:
            return self.layer(x, layer)
        scale = smoothing_scale(limits, layer.kernel)
        return self.layer(self("Mul", x, 1.0 / scale), Layer(np.asarray(layer.kernel) * scale[:, None], layer.bias))

    def lowest(self, x: str, count: int) -> str:
        """Return the places, in order, of the `count` lowest entries along the last axis of x."""
        names = [f"lowest_{len(self.nodes)}", f"places_{len(self.nodes)}"]
        given = [x, self.constant(np.array([count], np.int64))]
        self.nodes.append(self.onnx.helper.make_node("TopK", given, names, name=names[0], largest=0))
        return names[1]

    def all(self, flags: str, axis: int) -> str:
        """Return whether all of the bools along an axis are true; the axis stays, with size 1."""
        least = self("ReduceMin", self("Cast", flags, to=self.onnx.TensorProto.FLOAT), axes=[axis], keepdims=1)
        return self("Greater", least, np.float32(0.5))

    def skinned(self, garment: str, transforms: str, weights: Array) -> str:
        """Skin a garment [N, 3 V] by transforms [N, J, 12] of joints with weights [J, V]; return vertices [N, 3, V].

        The garment has one coordinate after the other.
        """
        vertices = np.shape(weights)[1]
        rows = self("MatMul", self("Transpose", transforms, perm=[0, 2, 1]), np.asarray(weights), name="skinning")
        one_more = np.array([0, 0, 0, 0, 0, 0, 1, 0], np.int64)
        homogeneous = self("Pad", self.reshape(garment, 1, 3, vertices), one_more, np.float32(1.0))
        moved = self("Mul", self.reshape(rows, 3, 4, vertices), homogeneous)
        return self("ReduceSum", moved, np.array([2], np.int64), keepdims=0)

    def dot(self, a: str, b: str) -> str:
        """Return the products [N, 1, n] of rows of vectors [N, 3, n]."""
        return self("ReduceSum", self("Mul", a, b), np.array([1], np.int64), keepdims=1)

    def cross(self, a: str, b: str) -> str:
        """Return the cross products [N, 3, n] of rows of vectors [N, 3, n]."""
        turned = [[self("Gather", x, np.array(axes, np.int64), axis=1) for axes in AXES] for x in (a, b)]
        return self("Sub", self("Mul", turned[0][0], turned[1][1]), self("Mul", turned[0][1], turned[1][0]))

    def save(self, path: Path, inputs: dict[str, tuple], outputs: dict[str, tuple], flags: tuple[str, ...] = ()):
        """Check the graph and write it.

        Args:
            inputs, outputs: shapes of tensors by name.
            flags: names of those that are bool; the others are float32.

        Raises:
            ImportError: with `int8`, if onnxruntime is not installed.
        """
        helper, kinds = self.onnx.helper, self.onnx.TensorProto
        described = [
            [
                helper.make_tensor_value_info(x, kinds.BOOL if x in flags else kinds.FLOAT, shape)
                for x, shape in y.items()
            ]
            for y in (inputs, outputs)
        ]
        graph = helper.make_graph(self.nodes, "clothjax", *described, self.constants)
        opset = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opset, producer_name="clothjax", ir_version=IR_VERSION)
        self.onnx.checker.check_model(model, full_check=True)
        if not self.int8:
            self.onnx.save(model, str(path))
            return
        try:
            from onnxruntime.quantization import QuantType, quantize_dynamic
        except ImportError as error:
            raise ImportError("int8 needs onnxruntime: pip install clothjax[export]") from error
        with tempfile.TemporaryDirectory() as folder:
            full = Path(folder) / "full.onnx"
            self.onnx.save(model, str(full))
            dense = [node.name for node in self.nodes if node.name.startswith("dense_")]
            quantize_dynamic(
                full, path, weight_type=QuantType.QInt8, per_channel=True, nodes_to_quantize=dense,
                extra_options={"MatMulConstBOnly": True},
            )  # fmt: skip


def session(path: str | Path):
    """Open a file in ONNX Runtime, on one thread of a CPU.

    Raises:
        ImportError: if onnxruntime is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError("running ONNX needs onnxruntime: pip install clothjax[export]") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
