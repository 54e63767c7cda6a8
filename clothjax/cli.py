"""What every program here does around its work: compilation cache, progress, one clear line for a user's mistake."""

import contextlib
import errno
import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def setup() -> None:
    """Keeps compiled programs between runs, in `.jax_cache` or where JAX_COMPILATION_CACHE_DIR says."""
    import jax

    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(Path(".jax_cache").absolute()))


@contextlib.contextmanager
def fail_clearly() -> Iterator[None]:
    """Ends the program with one line and exit code 1 on a mistake of the user's or a training that diverged."""
    try:
        yield
    except (ValueError, OSError, FloatingPointError, ImportError) as error:
        if os.environ.get("CLOTHJAX_TRACEBACK"):
            raise
        full = isinstance(error, OSError) and error.errno in FULL
        hint = (
            "; make room, and run the same command again: a training goes on from its last checkpoint" if full else ""
        )
        logging.getLogger("asyncio").disabled = True  # what Orbax left would be said after what matters
        print(f"error: {error}{hint}", file=sys.stderr)
        raise SystemExit(1) from None
