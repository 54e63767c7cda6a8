"""A file of `storage`'s schema: opened, its datasets read and checked one at a time, or written as a whole."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import h5py
import numpy as np

VERSION = 1


class Reader:
    """An open file. A check that fails raises a ValueError that names the file.

    Shapes are in numbers and letters, such as ("V", 3). A letter new to `sizes` takes the size in the file.
    """

    def __init__(self, file: h5py.File):
        self._file = file
        self.sizes: dict[str, int] = {}

    def __contains__(self, name: str) -> bool:
        return name in self._file

    def attribute(self, name: str):
        """Return an attribute of the file, None if it has none of this name."""
        return self._file.attrs.get(name)

    def fail(self, message: str) -> NoReturn:
        """Raise a ValueError."""
        raise ValueError(f"{self._file.filename}: {message}")

    def dataset(self, name: str, shape: tuple) -> np.ndarray:
        """Read a dataset."""
        if name not in self._file:
            self.fail(f"dataset {name!r} is missing; it has {', '.join(sorted(map(str, self._file)))}")
        dataset = self._file[name]
        if not isinstance(dataset, h5py.Dataset):
            self.fail(f"{name!r} is not a dataset but a {type(dataset).__name__}")
        actual = dataset.shape
        wanted = tuple(self.sizes.get(n, n) for n in shape)
        if actual[:1] == (0,):
            what = {"T": "frames", "J": "joints"}.get(shape[0], "rows")
            self.fail(f"dataset {name!r} is empty, there are no {what} in it")
        if len(actual) != len(wanted) or any(
            isinstance(w, int) and w != n for n, w in zip(actual, wanted, strict=True)
        ):
            text = ", ".join(f"{n} = {self.sizes[n]}" if n in self.sizes else str(n) for n in shape)
            self.fail(f"dataset {name!r} has shape {actual}, expected ({text})")
        self.sizes.update({letter: n for letter, n in zip(shape, actual, strict=True) if isinstance(letter, str)})
        return dataset[()]

    def floats(self, name: str, shape: tuple, dtype: type = np.float32) -> np.ndarray:
        """Read a dataset of finite numbers."""
        value = self.dataset(name, shape)
        if value.dtype.kind not in "fiu":
            self.fail(f"dataset {name!r} must hold numbers, got {value.dtype}")
        wrong = np.argwhere(~np.isfinite(value))
        if len(wrong):
            where = tuple(int(i) for i in wrong[0])
            self.fail(f"dataset {name!r} is {value[where]} at {where} ({len(wrong)} such values): all must be finite")
        return value.astype(dtype)

    def integers(self, name: str, shape: tuple, low: int, high: int) -> np.ndarray:
        """Read a dataset of integers from `low` to `high` - 1."""
        value = self.dataset(name, shape)
        if value.dtype.kind not in "iu":
            self.fail(f"dataset {name!r} must hold integers, got {value.dtype}")
        wrong = np.argwhere((value < low) | (value >= high))
        if len(wrong):
            where = tuple(int(i) for i in wrong[0])
            self.fail(f"dataset {name!r} is {value[where]} at {where}, allowed {low} to {high - 1}")
        return value.astype(np.int32)

    def texts(self, name: str, shape: tuple) -> tuple[str, ...]:
        """Read a dataset of strings."""
        return tuple(str(_decoded(text)) for text in self.dataset(name, shape))


@contextmanager
def reading(path: Path, kind: str) -> Iterator[Reader]:
    """Open a file of a kind for reading, "" for any, and check its attributes."""
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            form = str(_decoded(file.attrs.get("format", "missing")))
            if kind and form.rpartition("/")[2] != kind:
                raise ValueError(f"{path}: attribute 'format' is {form!r}, expected 'clothjax/{kind}'")
            for key, wanted in (("version", VERSION), ("units", "m"), ("up", "+Y")):
                value = _decoded(file.attrs.get(key, wanted))
                if value != wanted:
                    raise ValueError(f"{path}: attribute {key!r} is {value!r}, expected {wanted!r}")
            yield Reader(file)
    except (OSError, RuntimeError, KeyError) as error:  # h5py raises these for a damaged file
        raise ValueError(f"{path}: not a readable HDF5 file, perhaps cut short ({error})") from error


def write(path: str | Path, kind: str, data: dict[str, np.ndarray], **attributes) -> None:
    """Write datasets and attributes under a temporary name, then rename the file."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        # this version has checksums for all of a file: libhdf5 can crash on a damaged description of the data
        with h5py.File(partial, "w", libver=("v110", "v110")) as file:
            fixed = {"format": f"clothjax/{kind}", "version": VERSION, "units": "m", "up": "+Y"}
            for key, value in {**fixed, **attributes}.items():
                file.attrs[key] = encoded([value])[0] if isinstance(value, str) else value
            for key, value in data.items():
                options = {"compression": "gzip", "compression_opts": 9, "shuffle": True, "fletcher32": True}
                file.create_dataset(key, data=value, **options)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def encoded(values: Sequence[str]) -> np.ndarray:
    """Encode strings at one length, so that the dataset holds them; HDF5 puts others in a heap without checksums."""
    texts = [value.encode() for value in values]
    return np.array(texts, h5py.string_dtype("utf-8", max(map(len, texts), default=0) or 1))


def _decoded(value: object) -> object:
    return value.decode(errors="replace") if isinstance(value, bytes) else value
