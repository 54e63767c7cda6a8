"""Files that are damaged, of another kind, or of a newer version of this library."""

import struct
import tokenize
import zipfile
import zlib
from pathlib import Path

# exceptions that readers of files raise for damaged files or files of another kind
UNREADABLE = (
    ValueError, LookupError, TypeError, AttributeError, OSError, EOFError, RuntimeError, ArithmeticError, MemoryError,
    SyntaxError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


class OtherFormat(ValueError):
    """A file was written by another version of this library, which this one does not read."""


def refuse_newer(path: str | Path, version: int, known: int) -> None:
    """Refuse a file that a newer version of this library wrote.

    Args:
        version, known: numbers of the file's format, and of the newest that is known here.

    Raises:
        OtherFormat: if `version` is the larger.
    """
    if version > known:
        raise OtherFormat(f"{path}: has format {version}, this version of clothjax reads up to {known}; update it")
