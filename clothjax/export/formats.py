"""The formats that a model is exported to: writing them, and running them again to be compared."""

import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from clothjax.export import litert, native, onnx, safetensors, sidecar, stablehlo
from clothjax.export.sidecar import Output
from clothjax.physics import compilers
from clothjax.runtime import inference, specialise
from clothjax.runtime.models import Model
from clothjax.types import Motion


class Options(NamedTuple):
    """The choices of an export. Not every format has `int8`, `batch` and `output`: `check` refuses them elsewhere."""

    int8: bool = False
    batch: int | None = 1  # characters a call, None for any number
    output: Output = "world"  # the vertices that are computed
    blendshapes: int | None = None  # the largest number; None for all
    max_influences: int | None = None  # the largest number of joints that move a vertex; None for all


class Format(NamedTuple):
    """One format: how a model is written to a file, and how the file is run again to be compared with jax."""

    suffix: str  # of the file, without the dot
    write: Callable[[Model, Path, Options, dict], Any]  # the last: more entries for its JSON
    run: Callable[[Path, Model, Motion, Options], np.ndarray | None]  # [T, V, 3] m; None: it cannot be run here
    options: tuple[str, ...] = ()  # fields of `Options` that not every format has
    described: bool = True  # whether a JSON beside the file tells how it is driven
    not_run: str = ""  # the reason if it cannot be run here


def _run_onnx(path: Path, model: Model, motion: Motion, options: Options) -> np.ndarray | None:
    return onnx.run_onnx(path, model, motion) if options.output == "world" else None


def _of_litert(model: Model, options: Options) -> Model:
    """Return the model whose code the file carries."""
    litert.refuse_forces(model)  # before any work
    return specialise.equalised(model) if options.int8 else model


def _write_litert(model: Model, path: Path, options: Options, about: dict) -> None:
    litert.to_litert(_of_litert(model, options), path, int8=options.int8, about=about)


def _run_litert(path: Path, model: Model, motion: Motion, options: Options) -> np.ndarray:
    return litert.run_litert(path, _of_litert(model, options), motion)


def _run_c(path: Path, _model: Model, motion: Motion, _options: Options) -> np.ndarray | None:
    if compilers.compiler("C") is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        return native.run_c(native.build(folder), path, motion)


FORMATS = {
    "onnx": Format(
        "onnx",
        lambda model, path, o, about: onnx.to_onnx(
            model, path, batch=o.batch, int8=o.int8, output=o.output, about=about
        ),
        _run_onnx,
        ("int8", "batch", "output"),
        not_run="its vertices are not in the world",
    ),
    "stablehlo": Format(
        "stablehlo",
        lambda model, path, _, about: stablehlo.to_stablehlo(model, path, about),
        lambda path, model, motion, _: stablehlo.run_stablehlo(path, model, motion),
    ),
    "litert": Format("tflite", _write_litert, _run_litert, ("int8",)),
    "c": Format(
        "psi", lambda model, path, _, about: native.to_c(model, path, about), _run_c, not_run="there is no C compiler"
    ),
    "safetensors": Format(
        "safetensors",
        lambda model, path, *_: safetensors.to_safetensors(model, path),
        lambda path, _model, motion, _: np.asarray(inference.animate(safetensors.from_safetensors(path), motion)[0]),
        described=False,
    ),
}  # by the name that a user gives


def check(name: str, options: Options) -> None:
    """Refuse options that a format does not have.

    Raises:
        ValueError: for such an option, with the formats that have it.
    """
    for option in ("int8", "batch", "output"):
        chosen = getattr(options, option) != getattr(Options(), option)
        if chosen and option not in FORMATS[name].options:
            of = " and ".join(each for each, form in FORMATS.items() if option in form.options)
            raise ValueError(f"--{option} is of {of}, not of {name}")


def export(model: Model, name: str, out: Path, options: Options, about: dict, motion: Motion | None) -> dict | None:
    """Write a specialised model with its JSON, and compare it to jax's unspecialised one.

    Args:
        name: of the format.
        about: more entries for the JSON.
        motion: to compare over; None to compare nothing.

    Returns:
        The `frames` of the rollout, and the mean and maximal distance of vertices, `mean_mm` and `max_mm`; None if the
        file is not compared, or cannot be run here.
    """
    check(name, options)
    form = FORMATS[name]
    small = specialise.specialise(model, blendshapes=options.blendshapes, max_influences=options.max_influences)
    out.parent.mkdir(parents=True, exist_ok=True)
    form.write(small, out, options, about)
    vertices = None if motion is None else form.run(out, small, motion, options)
    if motion is None or vertices is None:
        return None
    apart = 1e3 * np.linalg.norm(vertices - np.asarray(inference.animate(model, motion)[0]), axis=-1)
    error = {"frames": len(vertices), "mean_mm": float(apart.mean()), "max_mm": float(apart.max())}
    description = sidecar.beside(out)
    if form.described and description.is_file():
        entries = json.loads(description.read_text())
        description.write_text(json.dumps(entries | {"distance_to_jax": error}))
    return error
