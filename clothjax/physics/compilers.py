"""This machine's compilers, and functions in C++ that XLA calls: built once for a machine, and kept.

Libraries are kept in `clothjax` in the user's folder for caches: that of `XDG_CACHE_HOME`, or `~/.cache`.
"""

import contextlib
import ctypes
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

import jax
import jaxlib.version

from clothjax import progress

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
        handlers = _load(source, plain)
        for name in names:
            jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(handlers, name)), platform="cpu")
        _registered.update(names)


def _load(source: Path, plain: Path | None) -> ctypes.CDLL:
    """Load the library of a source: one that was kept, or else one that is built now."""
    kept = _place(source, plain)
    if kept is not None and all(map(_own, (kept, kept.parent))):
        try:
            return ctypes.CDLL(str(kept))
        except OSError:  # not whole, or not to be loaded from there
            pass
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        library, objects = Path(folder) / f"lib{source.stem}.so", []
        if plain is not None:
            objects = [Path(folder) / f"{plain.stem}.o"]
            run("C", [*FLAGS, "-fPIC", "-c", plain, "-o", *objects])
        include = f"-isystem{jax.ffi.include_dir()}"
        run("C++", ["-std=c++17", *FLAGS, "-fPIC", "-shared", include, source, *objects, "-o", library])
        if kept is not None:
            _keep(library, kept)
        return ctypes.CDLL(str(library))  # it stays loaded when its file is gone


def _place(source: Path, plain: Path | None) -> Path | None:
    """Return where a library is kept: another place for another source, compiler, machine or version of XLA."""
    languages = ("C++",) if plain is None else ("C++", "C")
    machine = [run(each, [*FLAGS, "-dM", "-E", "-x", each.lower(), os.devnull]) for each in languages]
    files = sorted(path for folder in {source.parent, Path(__file__).parent} for path in folder.iterdir())
    read = [path.read_bytes() for path in files if path.suffix in (".c", ".cc", ".h") or path == Path(__file__)]
    named = "\n".join([*machine, *FLAGS, *platform.libc_ver(), jaxlib.version.__version__])
    key = hashlib.sha256(b"\0".join([named.encode(), *read])).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    return folder / "clothjax" / f"{source.stem}-{key}.so" if folder.is_absolute() else None


def _own(path: Path) -> bool:
    """Return whether a path is there, and nobody else can write to it."""
    try:
        found = path.stat()
    except OSError:
        return False
    mine = os.name == "posix" and found.st_uid == os.geteuid()
    return mine and not found.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _keep(library: Path, place: Path) -> None:
    partial = place.with_name(f".{os.getpid()}.{place.name}")
    try:
        place.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        shutil.copyfile(library, partial)
        os.replace(partial, place)
    except OSError as error:
        progress.say(f"{place}: not kept, and so built in each process ({error.strerror})")
        with contextlib.suppress(OSError):
            partial.unlink()
