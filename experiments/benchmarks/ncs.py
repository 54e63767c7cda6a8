"""The peer at inference: the network of NCS (Bertiche et al. 2022) at its published sizes, one frame as ONNX.

Static encoder 135-64-128-256-512; dynamic encoder 12-32-32 for each of 15 joints, then 480-512-512, then a GRU of 512,
all without biases; decoder 512-512-512-512 of their sum; 512 blend shapes; skinning. Weights are random: it is timed,
not looked at. It is spared what Psi does itself: features and skinning transforms of the joints come as inputs.
"""

from pathlib import Path

import numpy as np

from clothjax.export.onnx_graph import Graph, session
from clothjax.inference import Layer

JOINTS, STATIC, DYNAMIC, WIDTH = 15, 9, 12, 512


def write(path: Path, vertices: int, *, int8: bool = False, whole: bool = True) -> Path:
    """Writes the graph for a garment of so many vertices; not `whole`: the network, without shapes and skinning."""
    random, g = np.random.default_rng(0), Graph(int8)

    def layer(inputs: int, outputs: int) -> Layer:
        kernel = (random.standard_normal((inputs, outputs)) * np.sqrt(2 / inputs)).astype(np.float32)
        return Layer(kernel, np.zeros(outputs, np.float32))

    def product(x: str, inputs: int, outputs: int) -> str:
        return g.product(x, layer(inputs, outputs).kernel)

    x = "static"
    for inputs, outputs in ((JOINTS * STATIC, 64), (64, 128), (128, 256), (256, WIDTH)):
        x = g("Relu", g.layer(x, layer(inputs, outputs)))
    dynamic = g("Relu", product(g("Relu", product("dynamic", DYNAMIC, 32)), 32, 32))
    y = g("Reshape", dynamic, np.array([1, JOINTS * 32], np.int64))
    for inputs in (JOINTS * 32, WIDTH):
        y = g("Relu", product(y, inputs, WIDTH))
    hidden = _gru(g, product(y, WIDTH, 3 * WIDTH), product("hidden", WIDTH, 3 * WIDTH))
    code = g("Add", x, hidden)
    for _ in range(3):
        code = g("Relu", g.layer(code, layer(WIDTH, WIDTH)))
    given = {"static": (1, JOINTS * STATIC), "dynamic": (JOINTS, DYNAMIC), "hidden": (1, WIDTH)}
    found = {"next_hidden": (1, WIDTH)}
    if whole:
        given["transforms"] = (1, JOINTS, 12)
        found["vertices"] = (1, vertices, 3)
        garment = g.layer(code, Layer(layer(WIDTH, 3 * vertices).kernel, random.standard_normal(3 * vertices)))
        weights = random.dirichlet(np.ones(JOINTS), vertices).astype(np.float32).T
        g("Transpose", g.skinned(garment, "transforms", weights), perm=[0, 2, 1], name="vertices")
    else:
        found["code"] = (1, WIDTH)
        g("Identity", code, name="code")
    g.save(path, given, found)
    return path


def feed(path: Path) -> dict[str, np.ndarray]:
    """Random inputs of a graph."""
    random = np.random.default_rng(1)
    return {value.name: random.standard_normal(value.shape).astype(np.float32) for value in session(path).get_inputs()}


def _gru(g: Graph, of_input: str, of_hidden: str) -> str:
    """A gated recurrent unit (reset after the product, as in Keras), from both products [1, 3 WIDTH]."""

    def gates(x: str) -> list[str]:
        return [g.slice(x, 1, i * WIDTH, (i + 1) * WIDTH) for i in range(3)]

    (update, reset, new), (update_hidden, reset_hidden, new_hidden) = gates(of_input), gates(of_hidden)
    update = g("Sigmoid", g("Add", update, update_hidden))
    reset = g("Sigmoid", g("Add", reset, reset_hidden))
    new = g("Tanh", g("Add", new, g("Mul", reset, new_hidden)))
    # update * hidden + (1 - update) * new
    return g("Add", new, g("Mul", update, g("Sub", "hidden", new)), name="next_hidden")
