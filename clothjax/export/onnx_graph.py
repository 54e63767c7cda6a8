"""Building, saving and running ONNX graphs.

Opset 17 and IR 8 are the newest that ONNX Runtime 1.15, still in engines, loads.
"""

import tempfile
from pathlib import Path

import numpy as np

from clothjax.runtime.inference import Layer
from clothjax.runtime.specialise import smoothing_scale
from clothjax.types import Array

OPSET, IR_VERSION = 17, 8


class Graph:
    """Nodes and constants of a graph under construction.

    Args:
        int8: dense layers have matrices of eight bits, quantised dynamically.

    Raises:
        ImportError: if the extra `export` is not installed.
    """

    def __init__(self, int8: bool = False):
        try:
            import onnx
        except ImportError as error:
            raise ImportError("ONNX export needs onnx: pip install clothjax[export]") from error
        self.onnx, self.nodes, self.constants, self.int8 = onnx, [], [], int8

    def __call__(self, operator: str, *inputs: str | Array | np.generic, name: str | None = None, **attributes) -> str:
        """Adds a node; arrays among its inputs become constants. Returns the name of its output."""
        names = [x if isinstance(x, str) else self.constant(x) for x in inputs]
        name = name or f"{operator.lower()}_{len(self.nodes)}"
        self.nodes.append(self.onnx.helper.make_node(operator, names, [name], name=name, **attributes))
        return name

    def constant(self, array: Array | np.generic) -> str:
        array = np.asarray(array)
        if array.dtype == np.float64:
            array = array.astype(np.float32)
        name = f"constant_{len(self.constants)}"
        self.constants.append(self.onnx.numpy_helper.from_array(np.asarray(array, order="C"), name))
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
        return self("Add", self.product(x, layer.kernel), layer.bias)

    def product(self, x: str, kernel: str | Array) -> str:
        """A dense layer without a bias."""
        return self("MatMul", x, kernel, name=f"dense_{len(self.nodes)}")

    def twice(self, x: str, layer: Layer) -> str:
        """`layer`; where matrices have eight bits, of inputs in eight bits and of what these leave, in eight again. So
        the inputs can take over all of what makes a column of weights smaller than others."""
        if not self.int8:
            return self.layer(x, layer)
        gain = np.maximum(np.abs(np.asarray(layer.kernel)).max(axis=1), 1e-6)
        x, kernel = self("Mul", x, gain), self.constant(np.asarray(layer.kernel) / gain[:, None])
        quantised = f"quantised_{len(self.nodes)}"
        names = [quantised, f"{quantised}_scale", f"{quantised}_zero"]
        self.nodes.append(self.onnx.helper.make_node("DynamicQuantizeLinear", [x], names, name=quantised))
        held = self("DequantizeLinear", *names)
        left = self("Sub", x, held)
        return self("Add", self("Add", self.product(held, kernel), self.product(left, kernel)), layer.bias)

    def even(self, x: str, limits: Array | None, layer: Layer) -> str:
        """Add `layer` of inputs within +-`limits`; in eight bits both are scaled by `specialise.smoothing_scale`."""
        if limits is None or not self.int8:
            return self.layer(x, layer)
        scale = smoothing_scale(limits, layer.kernel)
        return self.layer(self("Mul", x, 1.0 / scale), Layer(np.asarray(layer.kernel) * scale[:, None], layer.bias))

    def all(self, flags: str, axis: int) -> str:
        """Add a node that tells whether all bools hold along an axis; the axis stays."""
        least = self("ReduceMin", self("Cast", flags, to=self.onnx.TensorProto.FLOAT), axes=[axis], keepdims=1)
        return self("Greater", least, np.float32(0.5))

    def skinned(self, garment: str, transforms: str, weights: Array) -> str:
        """Vertices [N, 3, V] of a garment [N, 3 V] skinned by transforms [N, J, 12] of joints with weights [J, V],
        one coordinate after the other."""
        vertices = np.shape(weights)[1]
        rows = self("MatMul", self("Transpose", transforms, perm=[0, 2, 1]), np.asarray(weights), name="skinning")
        one_more = np.array([0, 0, 0, 0, 0, 0, 1, 0], np.int64)
        homogeneous = self("Pad", self.reshape(garment, 1, 3, vertices), one_more, np.float32(1.0))
        moved = self("Mul", self.reshape(rows, 3, 4, vertices), homogeneous)
        return self("ReduceSum", moved, np.array([2], np.int64), keepdims=0)

    def save(self, path: Path, inputs: dict[str, tuple], outputs: dict[str, tuple], flags: tuple[str, ...] = ()):
        """Checks the graph and writes it.

        Args:
            inputs, outputs: shapes of float32 tensors by name, or, for the `flags` among them, of bools.
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
        made = helper.make_model(graph, opset_imports=opset, producer_name="clothjax", ir_version=IR_VERSION)
        self.onnx.checker.check_model(made, full_check=True)
        if not self.int8:
            self.onnx.save(made, str(path))
            return
        try:
            from onnxruntime.quantization import QuantType, quantize_dynamic
        except ImportError as error:
            raise ImportError("int8 needs onnxruntime: pip install clothjax[export]") from error
        with tempfile.TemporaryDirectory() as folder:
            whole = Path(folder) / "whole.onnx"
            self.onnx.save(made, str(whole))
            dense = [node.name for node in self.nodes if node.name.startswith("dense_")]
            quantize_dynamic(
                whole, path, weight_type=QuantType.QInt8, per_channel=True, nodes_to_quantize=dense,
                extra_options={"MatMulConstBOnly": True},
            )  # fmt: skip


def session(path: str | Path):
    """An ONNX Runtime session of a file, on one thread."""
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError("running ONNX needs onnxruntime: pip install clothjax[export]") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
