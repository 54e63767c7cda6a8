"""NCS and SNUG's network (`clothjax/networks/baselines.py`) at inference: one frame as ONNX.

Unlike Psi they get features, and skinning transforms of the joints, as inputs.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import Config, PeerConfig, Stage1Config, Stage2Config
from clothjax.export.onnx_graph import Graph, session
from clothjax.networks import baselines
from clothjax.networks.mlp import Params
from clothjax.runtime import specialise
from clothjax.runtime.models import Layer

JOINTS = 15  # that NCS reads, as published


class Baseline(NamedTuple):
    """A network in its garment, on a character."""

    network: str  # ncs or snug
    params: Params
    shapes: Layer  # from the network's code to displacements [3 V] m
    mix: Layer | None  # before it, where there are fewer shapes than the code is long
    template: np.ndarray  # [V, 3] m
    weights: np.ndarray  # [J, V] skinning weights
    free: np.ndarray  # [V] false where pinned


def published(vertices: int) -> Baseline:
    """Build NCS at its published sizes, with random weights, to be timed."""
    config = Config(peer=PeerConfig("ncs"), stage1=Stage1Config(start_timestep=0.0), stage2=Stage2Config(forces=False))
    params = jax.jit(lambda k: baselines.init(k, JOINTS, 0, jnp.zeros((1, vertices, 3)), config))(jax.random.key(0))
    random = np.random.default_rng(0)
    weights = random.dirichlet(np.ones(JOINTS), vertices).T
    return assemble("ncs", params, random.standard_normal((vertices, 3)), weights, np.ones(vertices, bool))


def assemble(network: str, params: Params, template: np.ndarray, weights: np.ndarray, free: np.ndarray) -> Baseline:
    """Build a network with all its shapes; the arguments are fields of `Baseline`."""
    params = jax.tree.map(np.asarray, params)
    if network == "ncs":
        shapes = Layer(params["blendshapes"], np.zeros(params["blendshapes"].shape[1], np.float32))
    else:
        shapes = Layer(**params["output"])
    return Baseline(network, params, shapes, None, template, weights, free)


def fewer(baseline: Baseline, codes: np.ndarray, count: int) -> Baseline:
    """Reduce a network to `count` shapes, the principal ones for codes [n, K], in the way of `specialise`."""
    mix, rows, moved = specialise.principal_rows(codes, baseline.shapes.kernel, count)
    return baseline._replace(mix=mix, shapes=Layer(rows, baseline.shapes.bias + moved))


def write(path: Path, baseline: Baseline, *, int8: bool = False, skinned: bool = True) -> Path:
    """Write the graph; if not `skinned`, the network without shapes and skinning.

    Its inputs are `hidden` [1, M], for NCS `static` [1, S] and `dynamic` [J, 12], for SNUG `inputs` [1, N]; skinned,
    also `transforms` [1, J, 12]. Its outputs are `next_hidden`, and `vertices` [1, V, 3] or `code`.
    """
    g, params = Graph(int8), baseline.params
    if baseline.network == "ncs":
        units = [params["unit"]]
        locals_, joints = params["local"], params["dynamic"]["0"]["kernel"].shape[0] // baselines.LOCAL
        inputs = {"static": (1, len(params["static"]["0"]["kernel"])), "dynamic": (joints, len(locals_["0"]["kernel"]))}
    else:
        units = list(params["units"].values())
        inputs = {"inputs": (1, len(units[0]["input"]["kernel"]))}
    width = len(units[0]["state"]["kernel"])
    inputs["hidden"] = (1, len(units) * width)
    outputs = {"next_hidden": inputs["hidden"]}
    code = _ncs(g, params, joints) if baseline.network == "ncs" else _snug(g, units)
    if skinned:
        inputs["transforms"] = (1, len(baseline.weights), 12)
        outputs["vertices"] = (1, len(baseline.template), 3)
        code = g.layer(code, baseline.mix) if baseline.mix else code
        garment = g.layer(code, _by_coordinate(baseline))
        moved = g.skinned(garment, "transforms", baseline.weights.astype(np.float32))
        g("Transpose", moved, perm=[0, 2, 1], name="vertices")
    else:
        outputs["code"] = (1, len(baseline.shapes.kernel))
        g("Identity", code, name="code")
    g.save(path, inputs, outputs)
    return path


def feed(path: Path) -> dict[str, np.ndarray]:
    """Return random inputs of a graph."""
    random = np.random.default_rng(1)
    return {value.name: random.standard_normal(value.shape).astype(np.float32) for value in session(path).get_inputs()}


def run(path: Path, inputs: list[dict[str, np.ndarray]]) -> np.ndarray:
    """Return vertices [T, V, 3] m of an autoregressive rollout; codes [T, K] of a graph that is not skinned.

    Args:
        inputs: of each frame, except `hidden`; entries that the graph does not read are ignored.
    """
    one, frames = session(path), []
    read, last = {value.name for value in one.get_inputs()}, one.get_outputs()[-1].name
    hidden = np.zeros(next(value.shape for value in one.get_inputs() if value.name == "hidden"), np.float32)
    for frame in inputs:
        fed = {name: value for name, value in frame.items() if name in read}
        hidden, result = one.run(["next_hidden", last], fed | {"hidden": hidden})
        frames.append(result[0])
    return np.stack(frames)


def _by_coordinate(baseline: Baseline) -> Layer:
    """Turn a layer that gives displacements [3 V] into one that gives the garment, all x first."""

    def ordered(rows):
        rows = rows.reshape(*rows.shape[:-1], -1, 3) * baseline.free[:, None]
        return np.swapaxes(rows, -1, -2).reshape(*rows.shape[:-2], -1)

    bias = ordered(baseline.shapes.bias) + baseline.template.T.reshape(-1)
    return Layer(ordered(baseline.shapes.kernel).astype(np.float32), bias.astype(np.float32))


def _ncs(g: Graph, params: Params, joints: int) -> str:
    static, dynamic = "static", "dynamic"
    for layer in params["static"].values():
        static = g("Relu", g.layer(static, Layer(**layer)))
    for layer in params["local"].values():
        dynamic = g("Relu", g.product(dynamic, layer["kernel"]))
    dynamic = g("Reshape", dynamic, np.array([1, joints * baselines.LOCAL], np.int64))
    for layer in params["dynamic"].values():
        dynamic = g("Relu", g.product(dynamic, layer["kernel"]))
    memory = _gru(g, params["unit"], dynamic, "hidden", "next_hidden")
    code = g("Add", static, memory)
    for layer in params["decoder"].values():
        code = g("Relu", g.layer(code, Layer(**layer)))
    return code


def _snug(g: Graph, units: list[Params]) -> str:
    x, states, width = "inputs", [], len(units[0]["state"]["kernel"])
    for index, unit in enumerate(units):
        x = _gru(g, unit, x, g.slice("hidden", 1, index * width, (index + 1) * width))
        states.append(x)
    g("Concat", *states, axis=1, name="next_hidden")
    return x


def _gru(g: Graph, params: Params, x: str, state: str, name: str | None = None) -> str:
    """Add a gated recurrent unit, the same as in `clothjax.networks.baselines`."""
    width = len(params["state"]["kernel"])

    def gates(layer: Params, x: str) -> list[str]:
        product = g.layer(x, Layer(**layer)) if "bias" in layer else g.product(x, layer["kernel"])
        return [g.slice(product, 1, i * width, (i + 1) * width) for i in range(3)]

    (update, reset, new), (update_state, reset_state, new_state) = (
        gates(params["input"], x),
        gates(params["state"], state),
    )
    update = g("Sigmoid", g("Add", update, update_state))
    reset = g("Sigmoid", g("Add", reset, reset_state))
    new = g("Tanh", g("Add", new, g("Mul", reset, new_state)))
    # update * state + (1 - update) * new
    return g("Add", new, g("Mul", update, g("Sub", state, new)), name=name)
