"""The doctor tells what is there and what is missing."""

import subprocess
import sys
from importlib import metadata

from clothjax import doctor, trained


def test_a_whole_installation():
    done = subprocess.run([sys.executable, "-m", "clothjax", "doctor"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    said = done.stdout
    assert metadata.version("jax") in said and "jax runs on" in said and "MISSING" not in said
    assert all(f"{name:20} ready" in said for name in trained.shipped())


def test_every_extra_is_for_something():
    required, extras = doctor.requirements()
    assert {"jax", "flax", "numpy"} <= set(required) and "onnxruntime" not in required
    assert set(extras) == set(doctor.COMMANDS) and "onnxruntime" in extras["export"]


def test_what_is_missing_is_named_with_its_remedy(monkeypatch, tmp_path):
    version = metadata.version

    def without(*gone):
        def told(name):
            if name in gone:
                raise metadata.PackageNotFoundError(name)
            return version(name)

        monkeypatch.setattr(metadata, "version", told)

    without("onnxruntime")
    lines, sound = doctor.report()
    assert sound and any("without onnxruntime: pip install 'clothjax[export]'" in line for line in lines)
    without("optax", "jraph")
    lines, sound = doctor.report()
    assert not sound and lines[-1].endswith("pip install jraph optax")
    without()
    damaged = tmp_path / "skirt"
    damaged.mkdir()
    for name in (trained.WEIGHTS, trained.CONFIG):
        (damaged / name).write_bytes((trained.MODELS / "skirt" / name).read_bytes()[:1000])
    monkeypatch.setattr(trained, "MODELS", tmp_path)
    lines, sound = doctor.report()
    assert not sound and "skirt" in lines[-1] and "ready" not in lines[-1]
