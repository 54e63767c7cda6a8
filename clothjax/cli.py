"""Shared by all command-line programs: the parser of arguments, the compilation cache, one-line error messages."""

import argparse
import contextlib
import dataclasses
import errno
import logging
import os
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

Arguments = TypeVar("Arguments")
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

MODEL = "RUN_OR_NAME"
NAMED_MODELS = ("--pretrained", "--run", "--garment", "--garments")  # flags that once named a model
RENAMED = {"--motion": "--motions"}  # flags by their old spelling; an underscore in one is now a hyphen


class Parser(argparse.ArgumentParser):
    """Parser of a program's arguments: no abbreviations, examples in `--help`, a clear error for an old spelling.

    Args:
        program: its name after `python -m`.
        about: the docstring with the examples.
        settings: whether settings of a configuration may follow, as `--stage1.steps 20`.
    """

    def __init__(self, program: str, about: str | None, settings: bool = False, **options):
        self.settings, self.takes_model = settings, False
        form = argparse.RawDescriptionHelpFormatter
        super().__init__(
            prog=f"python -m {program}", description=about, formatter_class=form, allow_abbrev=False, **options
        )

    def parse_known_args(self, args: Sequence[str] | None = None, namespace=None):
        args = sys.argv[1:] if args is None else args
        refuse_old_spellings(args, self._option_string_actions, self.takes_model, self.settings)
        return super().parse_known_args(args, namespace)


def model_argument(parser: Parser, nargs: str | None = None, default: Any = None, about: str = "") -> None:
    """Add the positional argument `model`, as text for `trained.find`."""
    parser.takes_model = True
    parser.add_argument(
        "model",
        metavar=MODEL,
        nargs=nargs,
        default=default,
        help="a run's folder, a packed folder, or the name of a garment that comes with clothjax" + about,
    )


def betas(given: Sequence[float] | None, count: int) -> np.ndarray | None:
    """Return the betas [count] of which a user gave the first ones, or None for the mean body.

    Raises:
        ValueError: for more of them than the body takes.
    """
    if given is None:
        return None
    if len(given) > count:
        raise ValueError(f"--betas: {len(given)} given, this body takes {count}")
    return np.array([*given, *[0.0] * (count - len(given))], np.float32)


def refuse_old_spellings(
    argv: Sequence[str], known: Collection[str], takes_model: bool = False, settings: bool = False
) -> None:
    """Refuse old spellings of flags, with the new one in the error.

    Args:
        known: the flags of the program.
        takes_model: whether the program takes a model.
        settings: whether it takes settings of a configuration, such as `--garment` and `--motions`.

    Raises:
        ValueError: for an old spelling.
    """
    for word in argv:
        flag = word.partition("=")[0]
        if not flag.startswith("--") or flag in known:
            continue
        new = RENAMED.get(flag, flag.replace("_", "-"))
        if new != flag and (new in known or (new == "--motions" and settings)):
            raise ValueError(f"{flag} is now written {new}")
        if takes_model and flag in NAMED_MODELS and not (settings and flag == "--garment"):
            raise ValueError(f"{flag} is no longer there: {MODEL} is written without a flag, as `skirt` or `runs/mine`")


def arguments(kind: type[Arguments], program: str, about: str | None, argv: Sequence[str] | None = None) -> Arguments:
    """Fill a dataclass of arguments from the command line, with the spelling of `Parser`.

    Args:
        kind: the dataclass.
        program, about: the same as for `Parser`.
        argv: default the arguments of this process.
    """
    import tyro

    argv = sys.argv[1:] if argv is None else argv
    names = [field.name for field in dataclasses.fields(cast(Any, kind))]
    refuse_old_spellings(argv, [f"--{name.replace('_', '-')}" for name in names])
    if {"-h", "--help"} & set(argv):
        print(about)  # unchanged: tyro would fold its lines
    return tyro.cli(kind, args=list(argv), prog=f"python -m {program}")


def run(main: Callable[[list[str]], None]) -> None:
    """Run a program on the arguments of this process: `setup`, then `main` within `fail_clearly`."""
    setup()
    with fail_clearly():
        main(sys.argv[1:])


def setup() -> None:
    """Compute in float32, and store compiled programs in `.jax_cache` or the folder JAX_COMPILATION_CACHE_DIR."""
    import jax

    jax.config.update("jax_enable_x64", False)  # the environment may say otherwise, JAX_ENABLE_X64
    if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        jax.config.update("jax_compilation_cache_dir", str(Path(".jax_cache").absolute()))


@contextlib.contextmanager
def fail_clearly() -> Iterator[None]:
    """End the program with one line and exit code 1 on a user's mistake or a diverged training.

    With CLOTHJAX_TRACEBACK set, the error is raised instead.

    Raises:
        SystemExit: for a ValueError, an OSError, a FloatingPointError or an ImportError.
    """
    try:
        yield
    except (ValueError, OSError, FloatingPointError, ImportError) as error:
        if os.environ.get("CLOTHJAX_TRACEBACK"):
            raise
        full = isinstance(error, OSError) and error.errno in FULL
        hint = (
            "; make room, and run the same command again: a training goes on from its last checkpoint" if full else ""
        )
        logging.getLogger("asyncio").disabled = True  # its lines about tasks that Orbax left would hide the error
        print(f"error: {error}{hint}", file=sys.stderr)
        raise SystemExit(1) from None
