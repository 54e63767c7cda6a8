"""Strict loading of frozen dataclasses from YAML files and the command line."""

import dataclasses
import difflib
import math
import sys
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from clothjax.config import ANYTHING

Config = TypeVar("Config")


def load(cls: type[Config], path: str | Path, overrides: Sequence[str] = (), stored: bool = False) -> Config:
    """Load a YAML file over its `extends:` parents, then apply command-line overrides.

    Mappings are merged key by key; every other value, lists included, replaces its parent's.

    Args:
        cls: a frozen dataclass whose fields are bool, int, float, str, Literal, tuples of these, Optional,
            `dict[str, X]` and dataclasses.
        path: the YAML file; `extends: other.yaml` is relative to it.
        overrides: such as `["--stage1.learning_rate", "3e-4"]`.
        stored: as of `from_dict`.

    Raises:
        ValueError: for a file that is missing or not YAML, a cycle of `extends:`, an unknown key, a value of the
            wrong type or one that `__post_init__` refuses. The message has the file and the dotted path.
        SystemExit: for a mistake in `overrides`, after a message, or for `--help`.
    """
    reader = _Reader(str(path), stored)
    try:
        config = reader.build(cls, reader.read(Path(path), ()), "")
    except RecursionError:
        raise ValueError(f"{path}: a value contains itself (an anchor, `&name`, around its own `*name`)") from None
    return _override(cls, config, overrides, prog=f"... {path}") if overrides else config


def cli(cls: type[Config], argv: Sequence[str]) -> Config:
    """Return the configuration of a command line: a YAML file, then overrides such as `--stage1.seed 3`.

    Without a file, the overrides change the defaults of `cls`.

    Args:
        argv: the arguments, without the program's name. `--help` alone lists every setting with its default.
    """
    if argv and not argv[0].startswith("-"):
        try:
            return load(cls, argv[0], argv[1:])
        except ValueError as error:
            sys.exit(str(error))
    usage = "[CONFIG.yaml] [--SETTING VALUE ...]"
    if {"-h", "--help"} & set(argv):
        return _override(cls, cls(), ["--help"], prog=usage)
    if not argv:
        sys.exit(f"give a configuration file, settings, or both: {usage}; `--help` lists the settings")
    return _override(cls, cls(), argv, prog=usage)


def to_dict(config: Any) -> Any:
    """Convert a configuration to plain dictionaries and lists, for JSON and YAML."""
    if dataclasses.is_dataclass(config):
        return {f.name: to_dict(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, Mapping):
        return {key: to_dict(value) for key, value in config.items()}
    if isinstance(config, tuple | list):
        return [to_dict(value) for value in config]
    return config


def from_dict(
    cls: type[Config], values: Mapping[str, Any], source: str = "configuration", stored: bool = False
) -> Config:
    """Invert `to_dict`; missing keys take their defaults.

    Args:
        source: name of `values` in messages, such as their file.
        stored: of a trained model. What it lacks is younger than it is, and takes the value of `BEFORE` of its section.

    Raises:
        ValueError: as `load`.
    """
    return _Reader(source, stored).build(cls, values, "")


def _override(cls: type[Config], config: Config, arguments: Sequence[str], prog: str) -> Config:
    """Apply command-line arguments to a configuration."""
    import tyro

    return tyro.cli(cls, default=config, args=list(arguments), prog=prog)


class _Reader:
    """Reads the values of YAML files and builds dataclasses of them; its errors name the files that set a value."""

    def __init__(self, default: str, stored: bool):
        self.stored = stored
        self.default = default  # the source of a value that no file set
        self.sources: dict[str, tuple[str, ...]] = {}  # dotted path of a value -> the files that set it or parts of it

    def read(self, path: Path, children: tuple[Path, ...]) -> dict:
        """Return the values of a file over those of its parents."""
        if path.resolve() in children:
            chain = " -> ".join(str(p) for p in (*children, path.resolve()))
            raise ValueError(f"{path}: `extends:` goes round in a circle: {chain}")
        try:
            text = path.read_text(encoding="utf-8")
            _refuse_duplicates(yaml.compose(text, Loader=yaml.SafeLoader), path)
            values = yaml.safe_load(text)
        except OSError as error:
            child = f" (extended by {children[-1]})" if children else ""
            raise ValueError(f"{path}{child}: cannot be read: {error.strerror or error}") from error
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            line = f", line {mark.line + 1}" if mark else ""
            raise ValueError(f"{path}{line}: is not valid YAML: {error.problem or error.context}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: is not valid YAML: {' '.join(str(error).split())}") from error
        values = {} if values is None else values
        if not isinstance(values, dict):
            raise ValueError(f"{path}: expected `key: value` lines at the top, got {values!r}")
        parent = values.pop("extends", None)
        if not isinstance(parent, str | None):
            raise ValueError(f"{path}: extends: expected the name of one file, got {parent!r}")
        inherited = {} if parent is None else self.read(path.parent / parent, (*children, path.resolve()))
        return self.merge(inherited, values, "", str(path))

    def merge(self, old: dict, new: dict, prefix: str, source: str) -> dict:
        """Merge the values `new` of the file `source` over `old`, key by key."""
        merged = dict(old)
        for key, value in new.items():
            path, inherited = _join(prefix, key), merged.get(key)
            under = inherited if isinstance(value, dict) and isinstance(inherited, dict) else None
            self.sources[path] = (*(() if under is None else self.sources.get(path, ())), source)
            if isinstance(value, dict):
                value = self.merge(under or {}, value, path, source)
            merged[key] = value
        return merged

    def fail(self, message: str, path: str) -> typing.NoReturn:
        """Raise a ValueError that names the dotted path and the files that set the value there."""
        known = path.partition("[")[0]  # an element of a list comes from where the list does
        while known and known not in self.sources:
            known = known.rpartition(".")[0]
        where = ", ".join(self.sources.get(known, (self.default,)))
        raise ValueError(f"{where}: {path}: {message}" if path else f"{where}: {message}")

    def build(self, cls: type, values: Any, path: str) -> Any:
        """Build the dataclass `cls` from the mapping at `path`."""
        if not isinstance(values, Mapping):
            self.fail(f"expected a mapping of settings, got {values!r}", path)
        fields = {f.name: f for f in dataclasses.fields(cls)}
        retired = getattr(cls, "RETIRED", {})
        for key in set(values) & set(retired):
            if retired[key] is not ANYTHING and values[key] != retired[key]:
                self.fail(f"is no longer a setting, it is always {retired[key]!r}", _join(path, key))
        before = getattr(cls, "BEFORE", {}) if self.stored else {}
        values = before | {key: value for key, value in values.items() if key not in retired}
        for key in values:
            if key not in fields:
                near = difflib.get_close_matches(str(key), fields, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"valid keys: {', '.join(sorted(fields))}"
                self.fail(f"unknown key; {hint}", _join(path, key))
        for name, field in fields.items():
            required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
            if required and name not in values:
                self.fail("is required and missing", _join(path, name))
        hints = typing.get_type_hints(cls)
        arguments = {key: self.coerce(hints[key], v, _join(path, key)) for key, v in values.items()}
        try:
            return cls(**arguments)
        except ValueError as error:  # of __post_init__: these keys belong together, so the whole mapping is named
            self.fail(str(error), path)

    def coerce(self, hint: Any, value: Any, path: str) -> Any:
        """Convert `value` to the declared type, or raise a ValueError."""
        origin, arguments = typing.get_origin(hint), typing.get_args(hint)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            return self.build(hint, value, path)
        if origin in (typing.Union, types.UnionType):
            (inner,) = (a for a in arguments if a is not type(None))  # Optional is the only union that fields use
            return None if value is None else self.coerce(inner, value, path)
        if origin is typing.Literal:
            if not any(value == a and type(value) is type(a) for a in arguments):
                self.fail(f"{value!r} is not one of {', '.join(map(repr, arguments))}", path)
            return value
        if origin is tuple:
            if not isinstance(value, list | tuple):
                self.fail(f"expected a list, got {value!r}", path)
            if len(arguments) == 2 and arguments[1] is Ellipsis:
                arguments = (arguments[0],) * len(value)
            if len(arguments) != len(value):
                self.fail(f"expected {len(arguments)} values, got {len(value)}: {value!r}", path)
            pairs = enumerate(zip(arguments, value, strict=True))
            return tuple(self.coerce(a, v, f"{path}[{i}]") for i, (a, v) in pairs)
        if origin is dict:
            if not isinstance(value, Mapping):
                self.fail(f"expected a mapping, got {value!r}", path)
            return {str(k): self.coerce(arguments[1], v, _join(path, k)) for k, v in value.items()}
        scalar = _scalar(hint, value)
        if scalar is None:
            advice = "; put text in quotes" if hint is str else ""
            self.fail(f"expected {hint.__name__}, got {value!r} ({type(value).__name__}){advice}", path)
        return scalar


def _refuse_duplicates(node: yaml.Node | None, path: Path) -> None:
    """Raise a ValueError for a key that is set twice; PyYAML silently takes the last."""
    if isinstance(node, yaml.SequenceNode):
        for child in node.value:
            _refuse_duplicates(child, path)
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, child in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise ValueError(f"{path}, line {key.start_mark.line + 1}: a setting's name must be one word")
            if key.value in seen:
                raise ValueError(f"{path}, line {key.start_mark.line + 1}: {key.value!r} is set twice")
            seen.add(key.value)
            _refuse_duplicates(child, path)


def _join(prefix: str, key: Any) -> str:
    return f"{prefix}.{key}" if prefix else str(key)


def _scalar(kind: type, value: Any) -> bool | int | float | str | None:
    """Convert `value` to a bool, int, float or str; return None if it is not one."""
    if kind in (bool, str) or isinstance(value, bool):
        return value if isinstance(value, kind) and isinstance(value, bool) == (kind is bool) else None
    try:
        number = float(value)  # YAML 1.1, and so PyYAML, reads 1e-4 as text
    except (TypeError, ValueError):
        return None
    if kind is float:
        return None if math.isnan(number) else number
    if isinstance(value, int):
        return value
    return int(number) if number.is_integer() else None
