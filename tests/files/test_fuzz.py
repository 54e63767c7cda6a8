"""No damaged file gets more than one clear error out of a reader: none crashes it, hangs it or eats the memory."""

import json
import os
import pickle
import queue
import subprocess
import sys
import threading
from pathlib import Path

import faults
import fuzzed
import jax.numpy as jnp
import numpy as np
import pytest
import rigged
import trimesh
from samples import AMC, ASF, BVH, recording, smpl_arrays, spin, three_joints, two_faces
from toy import small, untrained_psi

from clothjax.files import checkpoint, configuration, storage
from clothjax.networks import normalisation
from clothjax.runtime import trained

FEW, MANY = 15, 5000
NAMES = ["root", "mid", "top"]


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    """Whole files, small ones, by the name of their reader; each in a folder of its own, which mutants are put in."""
    root = tmp_path_factory.mktemp("seeds")
    about = {"source": "test", "licence": "CC0-1.0"}

    def place(name: str) -> Path:
        (root / name).mkdir()
        return root / name / f"whole.{name}"

    paths = {name: place(name) for name in fuzzed.readers()}
    body = three_joints(posed=True)
    for path in (paths["body.h5"], paths["garment.h5"].parent / "whole.body.h5"):
        storage.save_body(path, body, NAMES, name="b", **about)
    garment = two_faces(body)._replace(cloth=np.ones((4, 3)))
    storage.save_garment(paths["garment.h5"], garment, NAMES, name="g", body="b", **about)
    storage.save_motion(paths["motion.h5"], spin(), NAMES, name="m", **about)
    np.savez(paths["take.npz"], **recording(frames=9))
    arrays = smpl_arrays()
    np.savez(paths["smpl.npz"], **(arrays | {"J_regressor": arrays["J_regressor"].toarray()}))
    paths["smpl.pkl"].write_bytes(pickle.dumps(arrays, protocol=2))
    for name, text in {"walk.bvh": BVH, "bones.asf": ASF, "take.amc": AMC}.items():
        paths[name].write_text(text)
    (paths["take.amc"].parent / "whole.asf").write_text(ASF)
    configuration_text = json.dumps(configuration.to_dict(small()), indent=1)
    paths["config.yaml"].write_text(configuration_text)
    ball = trimesh.creation.icosphere(1)
    for name in ("mesh.obj", "mesh.ply", "mesh.stl", "mesh.off", "mesh.glb"):
        ball.export(paths[name])
    body, names = storage.load_rig("body")
    walk = storage.load_motion("walk_3", names)
    walk = walk._replace(rotations=walk.rotations[:4], translation=walk.translation[:4])
    rigged.write(
        paths["figure.glb"], rigged.coarse(body), names, walk, morphs={"wide": rigged.coarse(body).shapedirs[..., 1]}
    )
    _, _, _, garment, predictor, normalizers = untrained_psi(small())
    phi = {"params": {"garment": garment}, "statistics": {"nodes": normalisation.empty_statistics(3)}}
    folder = paths["model.npz"].parent
    trained.write(folder, small(), phi, predictor, normalizers)
    (folder / "model.npz").rename(paths["model.npz"])
    paths["checkpoint"].mkdir()
    state = {"step": jnp.int32(3), "params": {"w": jnp.arange(40.0).reshape(8, 5), "b": [jnp.ones(3)]}}
    checkpoint.save(paths["checkpoint"], 3, state, {"a": 1})
    return paths


def outcomes(reader: str, seed: Path, count: int) -> list[str]:
    """What came of `count` damaged files; a worker that dies or hangs is started again behind the file that did it."""
    found: list[str] = []
    while len(found) < count:
        command = [sys.executable, fuzzed.__file__, reader, seed, seed.parent, str(len(found)), str(count - len(found))]
        environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join(sys.path)}
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
        ) as worker:
            lines: queue.Queue = queue.Queue()
            threading.Thread(target=lambda w=worker, q=lines: [*map(q.put, w.stdout), q.put(None)], daemon=True).start()
            while True:
                try:
                    line = lines.get(timeout=120)  # the first one waits for jax
                except queue.Empty:
                    worker.kill()
                    found.append("bad hung")
                    break
                if line is None:
                    worker.wait()
                    if worker.returncode:
                        found.append(f"bad died of {worker.returncode}")
                    break
                found.append(line.split(maxsplit=1)[1].strip())
    return found


@pytest.mark.parametrize("reader", ["motion.h5", "smpl.pkl"])
def test_some_damaged_files(reader, seeds):
    _judge(reader, outcomes(reader, seeds[reader], FEW), FEW)


@pytest.mark.slow
@pytest.mark.parametrize("reader", list(fuzzed.readers()))
def test_many_damaged_files(reader, seeds):
    found = outcomes(reader, seeds[reader], MANY)
    kinds = {kind: sum(o.startswith(kind) for o in found) for kind in ("valid", "refused", "unclear", "bad")}
    readers = faults.recorded("fuzz").get("readers", {}) | {reader: kinds}
    wrong = sum(kinds["bad"] + kinds["unclear"] for kinds in readers.values())
    faults.record("fuzz", readers=readers, files=sum(sum(k.values()) for k in readers.values()), bad_outcomes=wrong)
    _judge(reader, found, MANY)


def _judge(reader: str, found: list[str], count: int) -> None:
    assert found[0] == "valid"
    wrong = [f"{number} {o}" for number, o in enumerate(found) if o.startswith(("bad", "unclear"))]
    assert not wrong, f"{reader}: {len(wrong)} of {count}: {wrong[:8]}"
    assert sum(o == "refused" for o in found) > 0.2 * count
