"""ONNX: one frame of a model as a graph with the state as plain tensors."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import inference
from clothjax.inference import Model, State
from clothjax.types import Motion, Pose

OPSET, IR_VERSION = 17, 8  # the newest that ONNX Runtime 1.15, still in engines, loads
INPUTS = ("latent", "previous_rotations", "previous_translations", "rotations", "translation")
OUTPUTS = ("next_latent", "next_rotations", "next_translations", "ok", "vertices")


def to_onnx(model: Model, path: str | Path, first: Pose) -> Path:
    """Writes one frame of a model as ONNX, and beside it a JSON that tells an engine how to drive it.

    The graph's inputs are the state (`latent` [L], `previous_rotations` [2, J, 3, 3], `previous_translations`
    [2, 3] m) and the pose to come (`rotations` [J, 3, 3] local, `translation` [3] m); its outputs are the next state
    in the same order, `ok` (see `inference`) and the garment's `vertices` [V, 3] m in the world.

    Args:
        first: a pose; the first state in the JSON is of a character standing in it.

    Raises:
        ImportError: if the extra `export` is not installed.
    """
    try:
        import onnx
        from jax2onnx import to_onnx as convert
    except ImportError as error:
        raise ImportError("ONNX export needs jax2onnx and onnx: pip install clothjax[export]") from error
    path = Path(path)
    state = inference.initial_state(model, first)
    pose = Pose(state.rotations[0], state.translation[0])

    def frame(latent, rotations, translations, new_rotations, new_translation):
        following, vertices = inference.step(
            model, State(latent, rotations, translations, True), Pose(new_rotations, new_translation)
        )
        return *following, vertices

    shapes = [jax.ShapeDtypeStruct(x.shape, jnp.float32) for x in (*state[:-1], *pose)]
    graph = convert(frame, shapes, opset=OPSET, input_names=list(INPUTS), output_names=list(OUTPUTS))
    graph.ir_version = IR_VERSION
    onnx.checker.check_model(graph)
    onnx.save(graph, str(path))
    config = model.config
    about = {
        "garment": config.garment,
        "units": "m",
        "up": "+Y",
        "fps": config.fps,
        "inputs": {name: list(shape.shape) for name, shape in zip(INPUTS, shapes)},
        "outputs": dict(zip(OUTPUTS, [*(list(x.shape) for x in state), list(model.garment.vertices.shape)])),
        "ok": "false where the pose, the wearer or the code was outside the range of training and was brought into it",
        "rotations": "3 x 3 matrices, row-major, local to the parent joint; the identity is the body's canonical pose",
        "translation": "of the root joint from its canonical place",
        "parents": list(model.parents),
        "state": "feed next_latent, next_rotations, next_translations back; previous_* hold the newest pose first",
        "first_latent": np.asarray(state.latent).tolist(),
        "first_previous": "both entries are the first pose",
        "faces": np.asarray(model.garment.faces).tolist(),
    }  # fmt: skip
    path.with_suffix(".json").write_text(json.dumps(about))
    return path


def check_onnx(path: str | Path, model: Model, motion: Motion) -> float:
    """The largest vertex difference in m between ONNX Runtime and jax over a motion, each in its own closed loop.

    Raises:
        ImportError: if onnxruntime is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError("checking ONNX needs onnxruntime: pip install clothjax[export]") from error
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    rotations = np.asarray(motion.rotations, np.float32)
    translation = np.asarray(motion.translation, np.float32)
    reference = np.asarray(inference.animate(model, motion)[0])
    state = [np.asarray(x) for x in inference.initial_state(model, Pose(rotations[0], translation[0]))[:-1]]
    worst = 0.0
    for t in range(len(rotations)):
        *state, _, vertices = session.run(None, dict(zip(INPUTS, (*state, rotations[t], translation[t]))))
        worst = max(worst, float(np.linalg.norm(vertices - reference[t], axis=-1).max()))
    return worst
