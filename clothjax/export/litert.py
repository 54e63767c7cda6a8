"""LiteRT (TensorFlow Lite): one frame of a model, for phones and engines that have its runtime.

The converter is TensorFlow's, which is large and needs older packages than clothjax: give it its own environment,

    pip install clothjax tensorflow-cpu ai-edge-litert
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from clothjax.export import frame, sidecar
from clothjax.runtime import inference
from clothjax.runtime.models import ForcePredictor, Model, PosePredictor
from clothjax.types import Array, Motion, Pose


def to_litert(model: Model, path: str | Path, *, int8: bool = False, about: dict | None = None) -> Path:
    """Write one frame of a model as a .tflite of built-in operators, and a JSON as `to_onnx` does.

    The only signature has the arguments `frame.arguments` and the results `frame.results`.

    Args:
        int8: matrices in eight bits, quantised dynamically, except those that read the pose and those that skin; use
            it with a model from `specialise.equalised`.
        about: more entries for the JSON.

    Raises:
        ValueError: for a model with forces, whose search for the nearest face the converter does not know.
        ImportError: if TensorFlow is not installed.
    """
    refuse_forces(model)
    try:
        import tensorflow  # pyright: ignore[reportMissingModuleSource]  # not in the environment: too large
        from jax.experimental import jax2tf
    except ImportError as error:
        raise ImportError("TensorFlow is not installed: pip install tensorflow-cpu ai-edge-litert") from error
    path = Path(path)
    shapes = frame.shapes(model)
    arguments = [tensorflow.TensorSpec(shape, tensorflow.float32, name=name) for name, shape in shapes.items()]
    traced = jax2tf.convert(_partly_quantised(model) if int8 else frame.function(model), with_gradient=False)

    @tensorflow.function(input_signature=arguments, autograph=False)
    def named(*values):
        return dict(zip(frame.results(model), traced(*values), strict=True))

    owner: Any = tensorflow.Module()  # without one a file has no signature
    owner.frame = named
    converter = tensorflow.lite.TFLiteConverter.from_concrete_functions([named.get_concrete_function()], owner)
    if int8:
        converter.optimizations = [tensorflow.lite.Optimize.DEFAULT]
    path.write_bytes(converter.convert())
    sidecar.write(model, path, "world", frame.describe(model) | (about or {}))
    return path


def refuse_forces(model: Model) -> None:
    """Raise a ValueError for a model with forces."""
    if isinstance(model.network.predictor, ForcePredictor):
        raise ValueError(
            "LiteRT cannot run a model with forces: take ONNX or plain C, which phones run too, or StableHLO"
        )


def _partly_quantised(model: Model) -> Callable:
    """Return `frame.function` with the pose kernel and the skinning weights hidden from the converter.

    It cannot see that the term added to them is zero, and leaves them in full precision. In eight bits they would err
    by millimetres, because all inputs of a layer share a scale.
    """

    def hidden(latent: Array, *others: Array) -> tuple:
        zero = jnp.where(jnp.abs(latent[0]) < 0.0, 1.0, 0.0)  # also of NaN
        predictor = model.network.predictor
        assert isinstance(predictor, PosePredictor)
        predictor = predictor._replace(pose=predictor.pose + zero)
        network = model.network._replace(predictor=predictor, weights=model.network.weights + zero)
        return frame.function(dataclasses.replace(model, network=network))(latent, *others)

    return hidden


def run_litert(path: str | Path, model: Model, motion: Motion) -> np.ndarray:
    """Run a file over a motion in LiteRT on one thread; return vertices [T, V, 3] m.

    Args:
        model: the one that was written, for the state before the first frame.

    Raises:
        ImportError: if LiteRT is not installed.
    """
    try:
        from ai_edge_litert.interpreter import (  # pyright: ignore[reportMissingImports]  # needs TensorFlow's environment
            Interpreter,
        )
    except ImportError as error:
        raise ImportError("LiteRT is not installed: pip install ai-edge-litert") from error
    run = Interpreter(model_path=str(path), num_threads=1).get_signature_runner()
    rotations, translation = (np.asarray(x, np.float32) for x in (motion.rotations, motion.translation))
    state = frame.state_arrays(inference.initial_state(model, Pose(rotations[0], translation[0])))
    vertices = []
    for pose in zip(rotations, translation, strict=True):
        results = run(**dict(zip(frame.arguments(model), (*state, *pose), strict=True)))
        state = [results[name] for name in frame.results(model)[: len(state)]]
        vertices.append(results["vertices"])
    return np.stack(vertices)
