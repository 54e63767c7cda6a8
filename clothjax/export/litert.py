"""LiteRT (TensorFlow Lite): one frame of a model, for phones and engines that have its runtime.

The converter is TensorFlow's, which is large and wants older packages than we do: give it an environment of its own,

    pip install clothjax tensorflow-cpu ai-edge-litert
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from clothjax.export import frame, sidecar
from clothjax.runtime import inference
from clothjax.runtime.inference import Model
from clothjax.types import Array, Motion, Pose


def to_litert(model: Model, path: str | Path, *, int8: bool = False, about: dict | None = None) -> Path:
    """Writes one frame of a model as a .tflite of built-in operators, and a JSON as `to_onnx` does.

    Its one signature has the arguments and results of `frame.ARGUMENTS` and `frame.RESULTS`.

    Args:
        int8: matrices in eight bits, quantised dynamically, but for those that read the pose and that skin; best of a
            model that `specialise.smoothed` gives.
        about: more entries for the JSON.

    Raises:
        ImportError: if TensorFlow is not installed.
    """
    try:
        import tensorflow
        from jax.experimental import jax2tf
    except ImportError as error:
        raise ImportError("TensorFlow is not installed: pip install tensorflow-cpu ai-edge-litert") from error
    path = Path(path)
    shapes = frame.shapes(model)
    given = [tensorflow.TensorSpec(shape, tensorflow.float32, name=name) for name, shape in shapes.items()]
    traced = jax2tf.convert(_partly_quantised(model) if int8 else frame.function(model), with_gradient=False)

    @tensorflow.function(input_signature=given, autograph=False)
    def named(*arguments):
        return dict(zip(frame.RESULTS, traced(*arguments), strict=True))

    owner = tensorflow.Module()  # without one a file has no signature
    owner.frame = named  # pyright: ignore[reportAttributeAccessIssue]  # how TensorFlow keeps a function
    converter = tensorflow.lite.TFLiteConverter.from_concrete_functions([named.get_concrete_function()], owner)
    if int8:
        converter.optimizations = [tensorflow.lite.Optimize.DEFAULT]
    path.write_bytes(converter.convert())
    sidecar.write(model, path, "world", frame.told(model) | (about or {}))
    return path


def _partly_quantised(model: Model) -> Callable:
    """`frame.function` whose kernel of the pose and skinning weights the converter leaves alone: it does not see that
    what is added to them is nothing. In eight bits they err by millimetres, for all inputs of a layer share a scale."""

    def hidden(latent: Array, *others: Array) -> tuple:
        nothing = jnp.where(jnp.abs(latent[0]) < 0.0, 1.0, 0.0)  # also of NaN
        network = model.network._replace(pose=model.network.pose + nothing, weights=model.network.weights + nothing)
        return frame.function(dataclasses.replace(model, network=network))(latent, *others)

    return hidden


def run_litert(path: str | Path, model: Model, motion: Motion) -> np.ndarray:
    """Vertices [T, V, 3] m of a file over a motion, in LiteRT on one thread.

    Args:
        model: for the state before the first frame.

    Raises:
        ImportError: if LiteRT is not installed.
    """
    try:
        from ai_edge_litert.interpreter import Interpreter  # pyright: ignore[reportMissingImports]  # an optional package
    except ImportError as error:
        raise ImportError("LiteRT is not installed: pip install ai-edge-litert") from error
    run = Interpreter(model_path=str(path), num_threads=1).get_signature_runner()
    rotations, translation = (np.asarray(x, np.float32) for x in (motion.rotations, motion.translation))
    state = inference.initial_state(model, Pose(rotations[0], translation[0]))[:-1]
    vertices = []
    for pose in zip(rotations, translation, strict=True):
        found = run(**dict(zip(frame.ARGUMENTS, (*map(np.asarray, state), *pose), strict=True)))
        state = [found[name] for name in frame.RESULTS[: len(state)]]
        vertices.append(found["vertices"])
    return np.stack(vertices)
