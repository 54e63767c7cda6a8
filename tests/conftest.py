"""JAX as strict as it can be, on the CPU."""

import os
from pathlib import Path

import pytest

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before JAX is imported; child processes inherit it

import jax

# Broadcasting over ranks and mixed dtypes are how mistakes in physics code go unseen.
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture(scope="session", autouse=True)
def compiled_once(tmp_path_factory, worker_id):
    """What one test has compiled, no other test of this run compiles again, whatever process it runs in."""
    base = tmp_path_factory.getbasetemp()
    cache = (base if worker_id == "master" else base.parent) / "compiled"
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))  # for child processes
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of reference data beside the repository, which not everyone has."""
    path = Path(__file__).parents[2] / "shared"
    if not path.is_dir():
        pytest.skip("needs the reference data in ../shared")
    return path
