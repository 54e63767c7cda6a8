"""StableHLO: one frame of a model with its weights, for any process that has XLA, without clothjax."""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.export import frame, sidecar
from clothjax.runtime import inference
from clothjax.runtime.models import Model
from clothjax.types import Motion, Pose

RUN = """
import sys
import jax
import numpy as np
from jax import export

frame = jax.jit(export.deserialize(bytearray(open(sys.argv[1], "rb").read())).call)
inputs = np.load(sys.argv[2])
state, vertices = [inputs[name] for name in inputs.files if name.startswith("state_")], []
external = [inputs["external"]] if "external" in inputs.files else []
for rotations, translation in zip(inputs["rotations"], inputs["translation"]):
    *state, ok, frame_vertices = frame(*state, rotations, translation, *external)
    vertices.append(frame_vertices)
assert not any(name.split(".")[0] == "clothjax" for name in sys.modules)
np.save(sys.argv[3], np.stack(vertices))
"""


def to_stablehlo(model: Model, path: str | Path, about: dict | None = None) -> Path:
    """Write one frame of a model as serialised StableHLO, for `jax.export.deserialize`, and a JSON as `to_onnx` does.

    Arguments (`frame.arguments`) are the state and the pose to come. The state is `latent` [C], `previous_rotations`
    [2, J, 3, 3], `previous_positions` [2, J, 3] m and `previous_translations` [2, 3] m, and with forces that of
    `models.Drape`; the pose is `rotations` [J, 3, 3] local and `translation` [3] m. Results (`frame.results`) are the
    next state in that order, `ok`, and the vertices [V, 3] m in the world. It runs on CPUs, GPUs and TPUs.
    """
    path = Path(path)
    arguments = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in frame.shapes(model).values()]
    exported = jax.export.export(jax.jit(frame.function(model)), platforms=("cpu", "cuda", "tpu"))(*arguments)
    path.write_bytes(exported.serialize())
    sidecar.write(model, path, "world", frame.describe(model) | (about or {}))
    return path


def run_stablehlo(path: str | Path, model: Model, motion: Motion) -> np.ndarray:
    """Run a file over a motion in a process without clothjax; return vertices [T, V, 3] m.

    Args:
        model: the one that was written, for the state before the first frame.
    """
    rotations, translation = (np.asarray(x, np.float32) for x in (motion.rotations, motion.translation))
    state = frame.state_arrays(inference.initial_state(model, Pose(rotations[0], translation[0])))
    external = {"external": np.zeros(3, np.float32)} if "external" in frame.arguments(model) else {}
    with tempfile.TemporaryDirectory() as folder:
        inputs, outputs = Path(folder) / "inputs.npz", Path(folder) / "outputs.npy"
        arrays: dict[str, Any] = {f"state_{i}": x for i, x in enumerate(state)} | external
        np.savez(inputs, rotations=rotations, translation=translation, **arrays)
        command = [sys.executable, "-c", RUN, str(Path(path).resolve()), str(inputs), str(outputs)]
        subprocess.run(command, check=True, cwd=folder)
        return np.load(outputs)
