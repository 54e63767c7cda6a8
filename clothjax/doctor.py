"""Check an installation: versions, devices, assets and optional parts.

    python -m clothjax doctor

The report names the missing packages of each command. The exit status is 1 if clothjax cannot run.
"""

import platform
import re
import shutil
from importlib import metadata

from packaging.requirements import Requirement

from clothjax import cli

COMMANDS = {
    "data": "data_prep.gltf: characters that are not one closed surface; data_prep.anny",
    "export": "clothjax convert, experiments.benchmark, experiments.thesis: ONNX, safetensors",
    "render": "clothjax render, experiments.gallery, quickstart, benchmark, stability, thesis: pictures, video",
    "sweep": "experiments.sweep: several trainings at once",
    "demo": "experiments.demo: the live page",
    "docs": "make docs: the reference of the library",
    "compare": "experiments.compare_solvers, XPBD in experiments.benchmark: beside NVIDIA Newton",
    "dev": "make test",
}
PROGRAMS = {  # kind -> names of the program, and its use
    "C": (("cc", "gcc", "clang"), "the plain C runtime"),
    "C++": (
        ("c++", "g++", "clang++"),
        "training on a CPU in less time; jax that calls the plain C runtime",
    ),
    "Node.js": (("npm",), "experiments.web, and its tests"),
    "Chromium": (("chromium", "google-chrome"), "the tests of the demo and of the web page"),
}


def main(argv: list[str]) -> None:
    """Print the report, and exit with 1 if clothjax cannot run."""
    cli.Parser("clothjax doctor", __doc__ or "").parse_args(argv)
    lines, sound = report()
    print("\n".join(lines))
    raise SystemExit(0 if sound else 1)


def report() -> tuple[list[str], bool]:
    """Return the lines of the report, and whether clothjax can run."""
    lines = [f"clothjax {_version('clothjax')}, Python {platform.python_version()}, {platform.platform()}", ""]
    try:
        required, extras = requirements()
    except metadata.PackageNotFoundError:
        return [*lines, "broken: clothjax is not installed here, only its files: pip install -e ."], False
    unmet = [wanted for wanted in required if not _met(wanted)]
    lines += [f"  {wanted.name:20} {_state(wanted)}" for wanted in required]
    if unmet:
        command = " ".join(f"'{wanted.name}{wanted.specifier}'" for wanted in unmet)
        return [*lines, "", f"broken: pip install {command}"], False
    devices, running = _devices()
    lines += ["", devices, ""]
    for extra, wanted in extras.items():
        absent = [each.name for each in wanted if not _met(each)]
        state = f"without {', '.join(absent)}: pip install 'clothjax[{extra}]'" if absent else "ready"
        lines.append(f"  {extra:8} {state:60} {COMMANDS.get(extra, '')}".rstrip())
    for program, (names, use) in PROGRAMS.items():
        path = next(filter(None, map(shutil.which, names)), None)
        absent = f"no {' or '.join(names)} on the PATH"
        lines.append(f"  {program:8} {path or absent:60} {use}")
    garments, sound = _garments()
    return [*lines, "", *garments], sound and running


def requirements() -> tuple[list[Requirement], dict[str, list[Requirement]]]:
    """List the packages that clothjax needs, and those of each of its extras.

    Raises:
        importlib.metadata.PackageNotFoundError: if clothjax is not installed.
    """
    required, extras = [], {}
    for line in metadata.requires("clothjax") or []:
        wanted = Requirement(line)
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", str(wanted.marker))
        (extras.setdefault(extra.group(1), []) if extra else required).append(wanted)
    return required, extras


def _version(name: str) -> str | None:
    """Return the version of an installed package, or None."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _met(wanted: Requirement) -> bool:
    """Return whether a package is installed in a version that is enough."""
    version = _version(wanted.name)
    return version is not None and wanted.specifier.contains(version, prereleases=True)


def _state(wanted: Requirement) -> str:
    """Describe the version of a required package."""
    version = _version(wanted.name)
    if version is None:
        return "MISSING"
    return version if _met(wanted) else f"{version}, not {wanted.specifier}"


def _devices() -> tuple[str, bool]:
    """Return a line about the devices of jax, and whether there are any."""
    import jax

    try:
        devices = [f"{device.platform} ({device.device_kind})" for device in jax.devices()]
    except RuntimeError as error:
        return f"broken: jax finds no device: {error}", False
    return f"jax runs on {', '.join(devices)}", True


def _garments() -> tuple[list[str], bool]:
    """Return lines about the garments that come with the library, and whether all of them can be read."""
    from clothjax.runtime import trained

    lines, sound = [], True
    for name in trained.shipped():
        try:
            trained.psi(trained.find(name))
            lines.append(f"  {name:20} ready")
        except ValueError as error:
            lines.append(f"  {name:20} {error}")
            sound = False
    if not lines:
        return ["broken: no garment comes with this installation; install clothjax again"], False
    return ["garments that come with the library:", *lines], sound
