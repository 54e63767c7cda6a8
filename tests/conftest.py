"""JAX as strict as it can be, on the CPU; and fixtures of more than one folder."""

import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh

# before JAX is imported; child processes inherit them
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")  # of what `compiled_once` keeps

import jax

# Broadcasting over ranks and mixed dtypes are how mistakes in physics code go unseen.
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

LONGEST = ("test_experiments.py", "test_drape.py")


def pytest_collection_modifyitems(items):
    """What takes longest begins first, with `--no-loadscope-reorder`: at the end no process waits long for another."""
    items.sort(key=lambda item: item.path.name not in LONGEST)


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory, worker_id):
    """What one test has compiled, no other test of this run compiles again, whatever process it runs in."""
    base = tmp_path_factory.getbasetemp()
    cache = (base if worker_id == "master" else base.parent) / "compiled"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))  # for child processes
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])


@pytest.fixture(scope="module", autouse=True)
def programs_let_go():
    """A process maps memory for each program that it keeps, and Linux ends one that has 65 530 maps."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 20_000:
        jax.clear_caches()


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the repository, which not everyone has."""
    path = Path(__file__).parents[2] / "shared"
    if not path.is_dir():
        pytest.skip("needs the reference data in ../shared")
    return path


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the project in it, and what the commands of the documents call a user's own."""
    import recorded  # after the settings above
    import rigged
    import samples

    from clothjax.files import storage

    folder = tmp_path_factory.mktemp("workplace")
    for name in ("clothjax", "configs", "experiments", "data_prep"):
        (folder / name).symlink_to(samples.ROOT / name)
    for name, clip in {"my_walk": "walk_1", "my_run": "run_1", "my_take": "dance_1", "other": "walk_2"}.items():
        shutil.copy(storage.asset(clip), folder / f"{name}.h5")
    for name, text in zip(("02.asf", "02_01.amc"), samples.standing()):
        (folder / name).write_text(text)
    taken = recorded.take("walk", 0, 30)
    recorded.write_bvh(folder / "walk.bvh", taken, "0.0333333", ["zxy"] * len(taken.names))
    np.savez(folder / "02_01_poses.npz", **samples.recording())
    (folder / "SMPL_FEMALE.pkl").write_bytes(pickle.dumps(samples.smpl_arrays(), protocol=2))
    rigged.another(folder / "character.glb")
    cloth = storage.load_garment("tshirt_1000", storage.load_body("body"))
    trimesh.Trimesh(100 * np.asarray(cloth.vertices), np.asarray(cloth.faces), process=False).export(
        folder / "shirt.obj"
    )
    return folder
