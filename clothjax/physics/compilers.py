"""This machine's compilers, and functions in C++ that XLA calls: built once for a machine, and kept.

Libraries are kept in `clothjax` in the user's folder for caches: that of `XDG_CACHE_HOME`, or `~/.cache`.
"""

import ctypes
import hashlib
import os
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


def run(language: str, arguments: Sequence[str | Path]) -> str:
    """Run the compiler for `C` or `C++`, and return what it prints.

    Raises:
        OSError: if there is no compiler, or it fails; with what it says.
    """
    program = compiler(language)
    if program is None:
        raise OSError(f"no compiler for {language} on the path: install gcc or clang")
    command = [program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"{' '.join(command)} failed: {done.stderr.strip()}")
    return done.stdout


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
        handlers = ctypes.CDLL(str(_library(source, plain)))
        for name in names:
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(handlers, name)), platform="cpu")
        _registered.update(names)


def _library(source: Path, plain: Path | None) -> Path:
    """Return the library of a source: the one that was kept, if nothing that it is made of has changed since."""
    machine = run("C++", [*FLAGS, "-dM", "-E", "-x", "c++", os.devnull])  # compiler and processor define these
    files = sorted(path for path in source.parent.iterdir() if path.suffix in (".c", ".cc", ".h"))
    made_of = [machine, *FLAGS, jax.__version__, *(path.read_text() for path in files)]
    key = hashlib.sha256("\0".join(made_of).encode()).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "clothjax"
    library = folder / f"{source.stem}-{key}.so"
    if library.is_file():
        return library
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:  # it cannot be kept
        folder = Path(tempfile.mkdtemp())
    with tempfile.TemporaryDirectory(dir=folder) as unfinished:
        built, objects = Path(unfinished) / library.name, []
        if plain is not None:
            objects = [Path(unfinished) / f"{plain.stem}.o"]
            run("C", [*FLAGS, "-fPIC", "-c", plain, "-o", *objects])
        include = f"-isystem{jax.ffi.include_dir()}"
        run("C++", ["-std=c++17", *FLAGS, "-fPIC", "-shared", include, source, *objects, "-o", built])
        os.replace(built, folder / library.name)
    return folder / library.name
