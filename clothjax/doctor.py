"""Looks at an installation: versions, devices, assets, and which optional parts are there."""

import platform
import re
import shutil
from importlib import metadata

COMMANDS = {
    "data": "data_prep.anny: makes the embedded body anew",
    "export": "experiments.convert, experiments.benchmark: ONNX, safetensors",
    "render": "experiments.render, experiments.quickstart: pictures, glTF, USD, video",
    "sweep": "experiments.sweep: several trainings at once",
    "demo": "experiments.demo: the live page",
    "compare": "experiments.compare_solvers: beside NVIDIA Newton",
    "dev": "make test",
}
PROGRAMS = {
    "cc": ("a C compiler", "the plain C runtime, and jax that calls it"),
    "node": ("Node.js", "experiments.web, and its tests"),
    "chromium": ("Chromium", "the tests of the demo and of the web page"),
}


def report() -> tuple[list[str], bool]:
    """Lines for a person, and whether all is there that clothjax cannot do without."""
    required, extras = requirements()
    lines = [f"clothjax {_version('clothjax')}, Python {platform.python_version()}, {platform.platform()}", ""]
    missing = [name for name in required if _version(name) is None]
    lines += [f"  {name:20} {_version(name) or 'MISSING'}" for name in required]
    if missing:
        lines += ["", f"broken: install what is missing: pip install {' '.join(missing)}"]
        return lines, False
    lines += ["", *_devices(), ""]
    for extra, names in extras.items():
        absent = [name for name in names if _version(name) is None]
        state = f"without {', '.join(absent)}: pip install 'clothjax[{extra}]'" if absent else "ready"
        lines.append(f"  {extra:8} {state:60} {COMMANDS.get(extra, '')}".rstrip())
    for program, (name, use) in PROGRAMS.items():
        found = shutil.which(program)
        lines.append(f"  {program:8} {found or f'{name} is not on the PATH':60} {use}")
    garments, sound = _garments()
    return [*lines, "", *garments], sound


def requirements() -> tuple[list[str], dict[str, list[str]]]:
    """Names of the packages that clothjax needs, and of those of each of its extras."""
    required, extras = [], {}
    for line in metadata.requires("clothjax") or []:
        name = re.match(r"[\w.-]+", line).group()
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", line)
        (extras.setdefault(extra.group(1), []) if extra else required).append(name)
    return required, extras


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _devices() -> list[str]:
    import jax

    try:
        found = [f"{device.platform} ({device.device_kind})" for device in jax.devices()]
    except RuntimeError as error:
        return [f"jax finds no device: {error}"]
    return [f"jax runs on {', '.join(found)}"]


def _garments() -> tuple[list[str], bool]:
    """Whether the garments that come with the library can be read."""
    from clothjax import trained

    lines, sound = [], True
    for name in trained.shipped():
        try:
            trained.psi(trained.folder(name))
            lines.append(f"  {name:20} ready")
        except ValueError as error:
            lines.append(f"  {name:20} {error}")
            sound = False
    if not lines:
        return ["broken: no garment comes with this installation; install clothjax again"], False
    return ["garments that come with the library:", *lines], sound
