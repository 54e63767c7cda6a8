"""StableHLO: one frame of a model with its weights, for any process that has XLA; clothjax need not be there."""

import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.export import frame, sidecar
from clothjax.runtime import inference
from clothjax.runtime.inference import Model
from clothjax.types import Motion, Pose

RUN = """
import sys
import jax
import numpy as np
from jax import export

frame = jax.jit(export.deserialize(bytearray(open(sys.argv[1], "rb").read())).call)
given = np.load(sys.argv[2])
state, vertices = [given[f"state_{i}"] for i in range(4)], []
for rotations, translation in zip(given["rotations"], given["translation"]):
    *state, ok, frame_vertices = frame(*state, rotations, translation)
    vertices.append(frame_vertices)
assert not any(name.split(".")[0] == "clothjax" for name in sys.modules)
np.save(sys.argv[3], np.stack(vertices))
"""


def to_stablehlo(model: Model, path: str | Path, about: dict | None = None) -> Path:
    """Writes one frame of a model as serialised StableHLO, for `jax.export.deserialize`, and a JSON as `to_onnx` does.

    It takes the state (`latent` [C], `previous_rotations` [2, J, 3, 3], `previous_positions` [2, J, 3] m,
    `previous_translations` [2, 3] m) and the pose to come (`rotations` [J, 3, 3] local, `translation` [3] m), and
    gives the next state in that order, `ok`, and the vertices [V, 3] m in the world (`frame.ARGUMENTS` and
    `frame.RESULTS`). It runs on CPUs, GPUs and TPUs.
    """
    path = Path(path)
    arguments = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in frame.shapes(model).values()]
    exported = jax.export.export(jax.jit(frame.function(model)), platforms=("cpu", "cuda", "tpu"))(*arguments)
    path.write_bytes(exported.serialize())
    sidecar.write(model, path, "world", frame.told(model) | (about or {}))
    return path


def run_stablehlo(path: str | Path, model: Model, motion: Motion) -> np.ndarray:
    """Vertices [T, V, 3] m of a file over a motion, run by a process that has jax but not clothjax.

    Args:
        model: for the state before the first frame.
    """
    rotations, translation = (np.asarray(x, np.float32) for x in (motion.rotations, motion.translation))
    state = inference.initial_state(model, Pose(rotations[0], translation[0]))[:-1]
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "given.npz", Path(folder) / "found.npy"
        np.savez(given, rotations=rotations, translation=translation, **{f"state_{i}": x for i, x in enumerate(state)})
        command = [sys.executable, "-c", RUN, str(Path(path).resolve()), str(given), str(found)]
        subprocess.run(command, check=True, cwd=folder)
        return np.load(found)
