"""Reads damaged files, one after the other, and says on its output what came of each: run by `test_fuzz.py`.

    python tests/fuzzed.py READER SEED FOLDER START COUNT

A line a file, of which the first, number 0, is whole: its number, then `valid`, `refused`, `unclear` (a ValueError that
does not name the file) or `bad` with what was raised. A file has SECONDS, and the process as much memory more than it
starts with as MEMORY says.
"""

import re
import resource
import shutil
import signal
import sys
import warnings
from pathlib import Path

import numpy as np

SECONDS, MEMORY = 20, 2 * 2**30
WORDS = (b"nan", b"inf", b"-1", b"0", b"1e999", b"99999999999", b"", b"x", b"{", b"}", b"-", b"\xff", b"[", b":")


def readers() -> dict:
    """What reads each kind of file, by the name that the file has."""
    from clothjax.config import Config
    from clothjax.files import checkpoint, configuration, storage
    from clothjax.runtime import trained
    from data_prep import amass, asf_amc, bvh, character, gltf, gltf_motion, mesh_file, smpl

    def rigged(path: Path) -> None:
        gltf.motions(character.read(path), 30.0)
        gltf_motion.read_gltf(path, 30.0)

    return {
        "body.h5": storage.load_body,
        "garment.h5": lambda path: storage.load_garment(path, storage.load_body(path.parent / "whole.body.h5")),
        "motion.h5": storage.load_motion,
        "take.npz": amass.read_amass,
        "smpl.npz": smpl.body,
        "smpl.pkl": smpl.body,
        "walk.bvh": bvh.read_bvh,
        "bones.asf": asf_amc.read_asf,
        "take.amc": lambda path: asf_amc.read_amc(path, asf_amc.read_asf(path.parent / "whole.asf")),
        "config.yaml": lambda path: configuration.load(Config, path),
        "mesh.obj": mesh_file.read,
        "mesh.ply": mesh_file.read,
        "mesh.stl": mesh_file.read,
        "mesh.off": mesh_file.read,
        "mesh.glb": mesh_file.read,
        "figure.glb": rigged,
        "model.npz": lambda path: trained.psi(path.parent),
        "checkpoint": lambda path: checkpoint.read(path, "params"),
    }


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """A file cut, spliced or overwritten somewhere; of text, with other words in it."""
    text = data[:4000].isascii() and b"\x00" not in data[:4000]
    for _ in range(rng.integers(1, 4)):
        kind, at = rng.integers(7), int(rng.integers(len(data) + 1))
        span = int(rng.integers(1, max(2, min(64, len(data) // 4))))
        if text and kind >= 3:
            words = [match.span() for match in re.finditer(rb"\S+", data)] or [(0, 0)]
            start, end = words[rng.integers(len(words))]
            data = data[:start] + WORDS[rng.integers(len(WORDS))] + data[end:]
        elif kind == 0:
            data = data[:at]
        elif kind == 1:
            data = data[:at] + data[at + span :]
        elif kind == 2:
            data = data[:at] + data[max(0, at - span) : at] + data[at:]
        elif kind == 3:
            data = data[:at] + rng.bytes(span) + data[at:]
        elif kind == 4:
            data = data[:at] + bytes([rng.choice([0, 255])]) * span + data[at + span :]
        else:
            changed = bytearray(data)
            for _ in range(rng.integers(1, 5) if data else 0):
                changed[rng.integers(len(data))] = rng.integers(256)
            data = bytes(changed)
    return data


def otherwise(data: dict[str, np.ndarray], rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Arrays of which one is missing, of another shape or kind, or has a wrong entry."""
    name = str(rng.choice(sorted(data)))
    array, changed = np.array(data[name]), dict(data)
    kind = rng.integers(7)
    if kind == 0:
        del changed[name]
    elif kind == 1:
        changed[name] = array[..., : array.shape[-1] // 2] if array.ndim else array[None]
    elif kind == 2:
        changed[name] = (
            array.astype(rng.choice(["f2", "i1", "u8", "c8", "S8", "?"])) if _numbers(array) else array.reshape(-1)[:0]
        )
    elif kind == 3:
        changed[name] = np.zeros((0, *array.shape[1:]), array.dtype)
    elif kind == 4:
        changed[name] = np.array(str(array.dtype))
    elif array.size and _numbers(array):
        wrong = array.copy()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            wrong.flat[rng.integers(array.size)] = np.array(rng.choice([np.nan, np.inf, -1, 1e30])).astype(array.dtype)
        changed[name] = wrong
    return changed


def _numbers(array: np.ndarray) -> bool:
    return array.dtype.kind in "fiub"


def write(path: Path, seed: Path, rng: np.random.Generator) -> None:
    """A damaged copy of a file, or of a folder of which one file is damaged."""
    if seed.is_dir():
        copy(path, seed)
        files = sorted(p for p in path.rglob("*") if p.is_file())
        victim = files[rng.integers(len(files))]
        victim.write_bytes(damaged(victim.read_bytes(), rng))
    elif seed.suffix == ".npz" and rng.integers(2):
        with np.load(seed) as file:
            np.savez(path, **otherwise(dict(file), rng))
    elif seed.suffix == ".h5" and rng.integers(2):
        _rewrite(path, seed, rng)
    else:
        path.write_bytes(damaged(seed.read_bytes(), rng))


def copy(path: Path, seed: Path) -> None:
    """A whole one."""
    if seed.is_dir():
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(seed, path)
    else:
        shutil.copy(seed, path)


def _rewrite(path: Path, seed: Path, rng: np.random.Generator) -> None:
    import h5py

    with h5py.File(seed) as old, h5py.File(path, "w") as new:
        new.attrs.update(old.attrs)
        for name, array in otherwise({name: np.asarray(old[name]) for name in old}, rng).items():
            kind = h5py.string_dtype() if array.dtype.kind in "OSU" else None
            new.create_dataset(name, data=array.astype(object) if kind else array, dtype=kind)


def main(reader: str, seed: str, folder: str, start: str, count: str) -> None:
    read, path = readers()[reader], Path(folder) / reader
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))

    def late(*_):
        raise TimeoutError(f"more than {SECONDS} s")

    signal.signal(signal.SIGALRM, late)
    warnings.simplefilter("ignore")
    for number in range(int(start), int(start) + int(count)):
        if number:
            write(path, Path(seed), np.random.default_rng([number, len(reader)]))
        else:
            copy(path, Path(seed))
        signal.alarm(SECONDS)
        try:
            read(path)
            outcome = "valid"
        except ValueError as error:
            outcome = "refused" if path.name in str(error) else f"unclear {str(error)[:200]!r}"
        except BaseException as error:  # what must not come out of a reader
            outcome = f"bad {type(error).__name__}: {str(error)[:200]!r}"
        signal.alarm(0)
        print(number, outcome, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
