"""This machine's compilers, and functions in C++ that XLA calls: built when a process first needs them."""

import ctypes
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import jax

PROGRAMS = {"C": ("cc", "gcc", "clang"), "C++": ("c++", "g++", "clang++")}
FLAGS = ("-O3", "-march=native")

_registered: set[str] = set()
_one_at_a_time = threading.Lock()  # a name cannot be registered twice


def compiler(language: str) -> str | None:
    """Return the path of this machine's compiler for `C` or `C++`, None if there is none."""
    return next(filter(None, map(shutil.which, PROGRAMS[language])), None)


def run(language: str, arguments: Sequence[str | Path]) -> None:
    """Run the compiler for `C` or `C++`, and raise what it says if it fails.

    Raises:
        OSError: if there is no compiler, or it fails.
    """
    program = compiler(language)
    if program is None:
        raise OSError(f"no compiler for {language} on the path: install gcc or clang")
    command = [program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"{' '.join(command)} failed: {done.stderr.strip()}")


def register(source: Path, names: tuple[str, ...], plain: Path | None = None) -> None:
    """Compile handlers of `jax.ffi` for the CPU and register them by their names, once a process.

    Args:
        source: C++ that defines them.
        plain: C to link with.

    Raises:
        OSError: if a compiler is missing or fails.
    """
    with _one_at_a_time:
        if _registered.issuperset(names):
            return
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            library, objects = Path(folder) / f"lib{source.stem}.so", []
            if plain is not None:
                objects = [Path(folder) / f"{plain.stem}.o"]
                run("C", [*FLAGS, "-fPIC", "-c", plain, "-o", *objects])
            include = f"-isystem{jax.ffi.include_dir()}"
            run("C++", ["-std=c++17", *FLAGS, "-fPIC", "-shared", include, source, *objects, "-o", library])
            handlers = ctypes.CDLL(str(library))  # it stays loaded when its file is gone
        for name in names:
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(handlers, name)), platform="cpu")
        _registered.update(names)
