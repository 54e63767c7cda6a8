"""StableHLO: one frame of a model with its weights, for any process that has XLA; clothjax need not be there."""

import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import inference
from clothjax.export import sidecar
from clothjax.inference import Model, State
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
    gives the next state in that order, `ok`, and the vertices [V, 3] m in the world. It runs on CPUs, GPUs and TPUs.
    """
    path = Path(path)

    def frame(latent, rotations, positions, translations, pose_rotations, pose_translation):
        state = State(latent, rotations, positions, translations, jnp.asarray(True))
        following, vertices = inference.step(model, state, Pose(pose_rotations, pose_translation))
        return *following, vertices

    joints = len(model.parents)
    shapes = (model.network.first.shape, (2, joints, 3, 3), (2, joints, 3), (2, 3), (joints, 3, 3), (3,))
    arguments = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    exported = jax.export.export(jax.jit(frame), platforms=("cpu", "cuda", "tpu"))(*arguments)
    path.write_bytes(exported.serialize())
    names = ("latent", "previous_rotations", "previous_positions", "previous_translations", "rotations", "translation")
    told = {
        "arguments": {name: list(shape) for name, shape in zip(names, shapes)},
        "results": ["latent", "rotations", "positions", "translations", "ok", "vertices"],
        "state": "feed the first four results back; of previous_*, entry 0 is the newest frame",
        "first_state": "latent is first_latent. Run once with the first pose, which is also both entries of "
        "previous_rotations and previous_translations; entry 0 of the positions that come back, twice, is "
        "previous_positions",
    }
    sidecar.write(model, path, "world", told | (about or {}))
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
