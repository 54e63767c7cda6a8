"""Imports between modules run one way. Read from the sources, so that nothing has to be imported."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HOST = {"config", "configuration", "graph_sampling", "plausibility", "run_folder", "storage", "topology"}
TRAINING = {"fit", "stage1", "stage2"}


def imports(path: Path) -> set[str]:
    """Dotted names of all that a file imports, at its top and inside functions."""
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


MODULES = {module_name(path): path for path in sorted((ROOT / "clothjax").rglob("*.py"))}


def own(path: Path) -> set[str]:
    """The modules of clothjax that a file imports."""
    found = set()
    for name in imports(path):
        while name and name not in MODULES:  # `clothjax.types.Body` is of `clothjax.types`
            name = name.rpartition(".")[0]
        if name:
            found.add(name)
    return found


GRAPH = {name: own(path) - {name} for name, path in MODULES.items()}


def reachable(start: str) -> set[str]:
    seen, waiting = set(), [start]
    while waiting:
        for name in GRAPH[waiting.pop()] - seen:
            seen.add(name)
            waiting.append(name)
    return seen


def test_the_walk_sees_imports():
    assert "clothjax.checkpoint" in GRAPH["clothjax.fit"]
    assert "clothjax.types" in GRAPH["clothjax.topology"]
    assert "jax" in imports(MODULES["clothjax.fit"])


def test_the_library_does_not_know_its_users():
    for name, path in MODULES.items():
        users = {i for i in imports(path) if i.partition(".")[0] in ("experiments", "data_prep", "tests")}
        assert not users, f"{name} imports {sorted(users)}"


@pytest.mark.parametrize("name", sorted(HOST))
def test_host_modules_are_numpy_only(name):
    device = {"jax", "jaxlib", "flax", "optax", "jraph", "orbax"}
    found = {i for i in imports(MODULES[f"clothjax.{name}"]) if i.partition(".")[0] in device}
    assert not found, f"clothjax.{name} imports {sorted(found)}"


def test_what_users_run_does_not_need_training():
    deployed = [n for n in MODULES if n == "clothjax.inference" or n.startswith("clothjax.export")]
    assert deployed
    for name in deployed:
        training = reachable(name) & {f"clothjax.{module}" for module in TRAINING}
        assert not training, f"{name} needs {sorted(training)}"


def test_only_checkpoint_imports_orbax():
    for name, path in MODULES.items():
        if name != "clothjax.checkpoint":
            assert not {i for i in imports(path) if i.startswith("orbax")}, name


def test_the_training_loop_knows_nothing_of_cloth():
    assert reachable("clothjax.fit") == {"clothjax.checkpoint", "clothjax.devices", "clothjax.run_folder"}


def test_no_cycles():
    for name in MODULES:
        if name != "clothjax":  # the package itself gathers the public names
            assert name not in reachable(name), f"{name} imports itself through {sorted(reachable(name))}"


def test_inside_the_library_nothing_imports_the_package_itself():
    for name in MODULES:
        assert "clothjax" not in GRAPH[name] or name == "clothjax", f"{name} imports the public names of clothjax"
