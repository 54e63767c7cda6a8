"""The doctor tells what is there and what is missing."""

import subprocess
import sys
from importlib import metadata

from clothjax import doctor
from clothjax.runtime import trained


def test_a_whole_installation():
    done = subprocess.run([sys.executable, "-m", "clothjax", "doctor"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    said = done.stdout
    assert metadata.version("jax") in said and "jax runs on" in said and "MISSING" not in said
    assert all(f"{name:20} ready" in said for name in trained.shipped())


def test_every_extra_is_for_something():
    required, extras = doctor.requirements()
    names = {wanted.name for wanted in required}
    assert {"jax", "flax", "numpy", "packaging"} <= names and "onnxruntime" not in names
    assert set(extras) == set(doctor.COMMANDS)
    assert "onnxruntime" in {wanted.name for wanted in extras["export"]}


def test_it_starts_where_a_package_is_missing(tmp_path):
    (tmp_path / "optax.py").write_text("raise ModuleNotFoundError('No module named optax')")
    program = f"""
import sys
from importlib import metadata
sys.path.insert(0, {str(tmp_path)!r})
version = metadata.version
def told(name):
    if name == "optax":
        raise metadata.PackageNotFoundError(name)
    return version(name)
metadata.version = told
sys.argv = ["clothjax", "doctor"]
import runpy
runpy.run_module("clothjax", run_name="__main__")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert done.returncode == 1 and not done.stderr
    assert "optax                MISSING" in done.stdout and "pip install 'optax>=0.2.8'" in done.stdout


def test_what_is_missing_or_too_old_is_named_with_its_remedy(monkeypatch):
    version = metadata.version

    def pretend(**versions):
        def told(name):
            if versions.get(name, "there") is None:
                raise metadata.PackageNotFoundError(name)
            return versions.get(name) or version(name)

        monkeypatch.setattr(metadata, "version", told)

    pretend(onnxruntime=None)
    lines, sound = doctor.report()
    assert sound and any("without onnxruntime: pip install 'clothjax[export]'" in line for line in lines)
    pretend(jraph=None, optax="0.1.0")
    lines, sound = doctor.report()
    assert not sound and "'optax>=0.2.8'" in lines[-1] and "'jraph>=" in lines[-1] and "jax>" not in lines[-1]
    assert any("0.1.0, not >=0.2.8" in line for line in lines)


def test_an_installation_that_cannot_run_is_unsound(monkeypatch, tmp_path):
    damaged = tmp_path / "skirt"
    damaged.mkdir()
    for name in (trained.WEIGHTS, trained.CONFIG):
        (damaged / name).write_bytes((trained.MODELS / "skirt" / name).read_bytes()[:1000])
    with monkeypatch.context() as patched:
        patched.setattr(trained, "MODELS", tmp_path)
        lines, sound = doctor.report()
        assert not sound and "skirt" in lines[-1] and "ready" not in lines[-1]
    with monkeypatch.context() as patched:
        patched.setattr(doctor, "_devices", lambda: ("broken: jax finds no device", False))
        assert not doctor.report()[1]

    def absent(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "requires", absent)
    lines, sound = doctor.report()
    assert not sound and "pip install -e ." in lines[-1]
