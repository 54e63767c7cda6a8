"""Imports between modules run one way. Read from the sources, so that nothing has to be imported."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HOST = {  # NumPy only
    "config",
    "files.configuration",
    "files.damage",
    "files.hdf5",
    "files.storage",
    "geometry.mesh_hierarchy",
    "geometry.topology",
    "body.plausibility",
    "training.run_folder",
}
# from the ground up: a folder may import those before it
FLOORS = [
    "types",
    "config",
    "progress",
    "material",
    "geometry",
    "body",
    "files",
    "physics",
    "simulation",
    "networks",
    "training",
    "runtime",
    "export",
    "render",
    "evaluation",
    "cli",
    "commands",
    "doctor",
    "__main__",
]
# what may never reach what, by any chain of imports
NEVER = {
    # a Psi with forces computes them, so runtime and export reach physics
    "clothjax.runtime": {"training", "evaluation", "simulation", "export", "render", "commands", "cli"},
    "clothjax.export": {"training", "evaluation", "simulation", "render", "commands", "cli"},
    "clothjax.simulation": {"networks", "training", "evaluation", "runtime", "export", "render"},
    "clothjax.evaluation.metrics": {"networks", "training", "runtime", "export", "render"},
    "clothjax.physics": {"simulation", "networks", "training", "evaluation", "runtime", "files"},
    "clothjax.networks": {"training", "evaluation", "runtime", "files", "export", "render"},
    "clothjax.training": {"evaluation", "runtime", "export", "render", "commands", "cli"},
    "clothjax.geometry": set(FLOORS) - {"types", "config", "geometry"},
    "clothjax.body": set(FLOORS) - {"types", "config", "geometry", "body"},
    "clothjax.files": set(FLOORS) - {"types", "config", "geometry", "files"},
    "clothjax.render": set(FLOORS) - {"types", "progress", "render"},
}


def imports(path: Path) -> set[str]:
    """Return the dotted names of all that a file imports, at its top and inside functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; write the full name"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    module_name(path): path
    for top in ("clothjax", "experiments", "data_prep")
    for path in sorted((ROOT / top).rglob("*.py"))
}


def own(path: Path) -> set[str]:
    """Return the modules of this project that a file imports."""
    found = set()
    for name in imports(path):
        while name and name not in MODULES:  # `clothjax.types.Body` is of `clothjax.types`
            name = name.rpartition(".")[0]
        if name:
            found.add(name)
    return found


GRAPH = {name: own(path) - {name} for name, path in MODULES.items()}
LIBRARY = [name for name in MODULES if name.startswith("clothjax.")]


def folder(name: str) -> str:
    """Return the folder of a module of the library, or the module itself where it is on top."""
    return name.split(".")[1]


def reachable(start: str) -> set[str]:
    seen, waiting = set(), [start]
    while waiting:
        for name in GRAPH[waiting.pop()] - seen:
            seen.add(name)
            waiting.append(name)
    return seen


def test_the_walk_sees_imports():
    assert "clothjax.files.checkpoint" in GRAPH["clothjax.training.loop"]
    assert "clothjax.types" in GRAPH["clothjax.geometry.topology"]
    assert "jax" in imports(MODULES["clothjax.training.loop"])
    assert "clothjax.physics.energies" in reachable("clothjax.evaluation.report")


def test_every_folder_says_what_it_is_and_imports_nothing():
    for path in (ROOT / "clothjax").glob("*/__init__.py"):
        assert ast.get_docstring(ast.parse(path.read_text())), path
        assert not imports(path), path


def test_few_modules_are_on_top():
    assert len(list((ROOT / "clothjax").glob("*.py"))) <= 8


@pytest.mark.parametrize("start", sorted(NEVER))
def test_what_may_never_reach_what(start):
    starts = [name for name in MODULES if name == start or name.startswith(f"{start}.")]
    assert starts
    for name in starts:
        wrong = {other for other in reachable(name) if other.startswith("clothjax.") and folder(other) in NEVER[start]}
        assert not wrong, f"{name} reaches {sorted(wrong)}"


def test_no_import_runs_back_up():
    assert {folder(name) for name in LIBRARY} <= set(FLOORS)
    for name in LIBRARY:
        for other in GRAPH[name] - {"clothjax"}:
            upward = FLOORS.index(folder(other)) > FLOORS.index(folder(name))
            assert not upward, f"{name} imports {other}, which is above it"


def test_the_library_does_not_know_its_users():
    for name in LIBRARY:
        users = {i for i in imports(MODULES[name]) if i.partition(".")[0] in ("experiments", "data_prep", "tests")}
        assert not users, f"{name} imports {sorted(users)}"


def test_data_prep_does_not_know_the_experiments():
    for name in MODULES:
        if name.startswith("data_prep"):
            assert not {i for i in reachable(name) if i.startswith("experiments")}, name


@pytest.mark.parametrize("name", sorted(HOST))
def test_host_modules_are_numpy_only(name):
    device = {"jax", "jaxlib", "flax", "optax", "jraph", "orbax"}
    found = {i for i in imports(MODULES[f"clothjax.{name}"]) if i.partition(".")[0] in device}
    assert not found, f"clothjax.{name} imports {sorted(found)}"


def test_only_checkpoint_imports_orbax():
    for name in LIBRARY:
        if name != "clothjax.files.checkpoint":
            assert not {i for i in imports(MODULES[name]) if i.startswith("orbax")}, name


def test_the_training_loop_knows_nothing_of_cloth():
    known = {
        "files.checkpoint",
        "files.damage",
        "progress",
        "training.devices",
        "training.run_folder",
        "training.session",
    }
    assert reachable("clothjax.training.loop") == {f"clothjax.{name}" for name in known}


def test_no_cycles():
    for name in MODULES:
        if name != "clothjax":  # the package itself gathers the public names
            assert name not in reachable(name), f"{name} imports itself through {sorted(reachable(name))}"


def test_inside_the_library_nothing_imports_the_package_itself():
    for name in LIBRARY:
        assert "clothjax" not in GRAPH[name], f"{name} imports the public names of clothjax"


def test_a_garment_in_use_loads_no_training():
    program = """
import sys
import jax.numpy as jnp
import clothjax as cj
garment = cj.load("skirt")
pose = cj.Pose(jnp.broadcast_to(jnp.eye(3), (len(garment.names), 3, 3)), jnp.zeros(3))
cj.step(garment, cj.initial_state(garment, pose), pose)
print(*[name for name in sys.modules if name.startswith("clothjax.")])
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    loaded = {name.split(".")[1] for name in done.stdout.split()}
    assert "runtime" in loaded
    assert not loaded & {"training", "evaluation", "simulation"}, loaded
