"""The work around every program: arguments in one spelling, compilation cache, one clear line for a user's mistake."""

import argparse
import contextlib
import dataclasses
import errno
import logging
import os
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

Arguments = TypeVar("Arguments")
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

MODEL = "RUN_OR_NAME"
NAMED_MODELS = ("--pretrained", "--run", "--garment", "--garments")  # flags that once named a model
RENAMED = {"--motion": "--motions"}  # flags by their old spelling; an underscore in one is now a hyphen


class Parser(argparse.ArgumentParser):
    """A program's arguments: no abbreviations, `--help` shows the examples, an old spelling gets a clear error.

    Args:
        program: as it is typed after `python -m`.
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
    """Adds the positional argument `model`, as text for `model_folder`."""
    parser.takes_model = True
    parser.add_argument(
        "model",
        metavar=MODEL,
        nargs=nargs,
        default=default,
        help="a run's folder, a packed folder, or the name of a garment that comes with clothjax" + about,
    )


def model_folder(text: str | Path) -> Path:
    """The folder of a model: of a run, of a packed model, or of a garment that comes with clothjax, by its name.

    Raises:
        ValueError: if there is no such folder and no such garment.
    """
    from clothjax.runtime import trained

    return trained.find(text)


def refuse_old_spellings(
    argv: Sequence[str], known: Collection[str], takes_model: bool = False, settings: bool = False
) -> None:
    """Names the new spelling of the first flag that has an old one.

    Args:
        known: the flags of the program.
        takes_model: whether it takes a model.
        settings: whether it takes settings of a configuration, of which `--garment` and `--motions` are two.

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


def arguments(kind: type[Arguments], program: str, about: str, argv: Sequence[str] | None = None) -> Arguments:
    """A dataclass of arguments from the command line, as `Parser` reads them.

    Args:
        kind: the dataclass; program, about: as of `Parser`.
        argv: default: those of this process.
    """
    import tyro

    argv = sys.argv[1:] if argv is None else argv
    fields = dataclasses.fields(kind)  # pyright: ignore[reportArgumentType]  # a TypeVar cannot say dataclass
    refuse_old_spellings(argv, [f"--{field.name.replace('_', '-')}" for field in fields])
    if {"-h", "--help"} & set(argv):
        print(about)  # as it is: tyro would fold its lines
    return tyro.cli(kind, args=list(argv), prog=f"python -m {program}")


def run(main: Callable[[list[str]], None]) -> None:
    """A program from its arguments to its exit code."""
    setup()
    with fail_clearly():
        main(sys.argv[1:])


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
