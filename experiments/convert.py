"""Writes Psi of a run, or a garment that comes with the library, for another runtime, and compares the two there.

    python -m experiments.convert runs/quickstart --to onnx --int8
    python -m experiments.convert --pretrained skirt --to stablehlo --out skirt.stablehlo
    python -m experiments.convert --pretrained dress --to c --out engine/dress.psi
    python -m experiments.convert --pretrained tshirt --to onnx --batch dynamic --blendshapes 192 --betas 1 0 -0.5

    onnx          ONNX Runtime 1.15 and newer, and engines built on it; for eight bits, --int8; to skin the garment in
                  the engine, --output canonical; for a garment that nobody sees, --output none
    stablehlo     any process with jax or XLA, on CPU, GPU or TPU, without clothjax
    litert        LiteRT (TensorFlow Lite), as on phones; for eight bits, --int8
    c             plain C without any runtime, in eight bits: psi.c and psi.h come with it
    safetensors   the arrays alone, for whoever builds a runtime

A JSON beside the file tells how it is driven. The model is specialised first (`clothjax/runtime/specialise.py`).
The distance of vertices to jax's unspecialised model over a rollout of 300 frames is printed and written to the JSON.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from clothjax.cli import fail_clearly, setup
from clothjax.export import litert, native, onnx, safetensors, stablehlo
from clothjax.files import storage
from clothjax.runtime import inference, specialise, trained
from clothjax.runtime.inference import Model
from clothjax.simulation import assembly
from clothjax.types import Material, Motion

FRAMES = 300


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run")
    parser.add_argument("--pretrained", choices=trained.shipped())
    parser.add_argument("--to", choices=["onnx", "stablehlo", "litert", "c", "safetensors"], default="onnx")
    parser.add_argument("--out", type=Path, default=None, help="default: GARMENT.onnx and so on, in the run's folder")
    parser.add_argument("--int8", action="store_true")
    parser.add_argument("--batch", type=_batch, default=1, metavar="N|dynamic", help="characters a call")
    parser.add_argument("--output", choices=["world", "canonical", "none"], default="world")
    parser.add_argument("--blendshapes", type=int, default=None)
    parser.add_argument("--max_influences", type=int, default=None)
    parser.add_argument("--betas", type=float, nargs="+", default=None, help="of the body; default: the mean body")
    parser.add_argument("--material", type=float, nargs=4, default=None, metavar=Material._fields)
    arguments = parser.parse_args(argv)
    if (arguments.run is None) == (arguments.pretrained is None):
        raise ValueError("give the folder of a run, or --pretrained with the name of a garment")
    if arguments.to != "onnx" and (arguments.batch != 1 or arguments.output != "world"):
        raise ValueError(f"--batch and --output are of ONNX, not of {arguments.to}")
    if arguments.to not in ("onnx", "litert") and arguments.int8:
        raise ValueError(f"--int8 is of ONNX and LiteRT, not of {arguments.to}")
    run = arguments.run or trained.folder(arguments.pretrained)
    betas = None
    if arguments.betas is not None:
        count = storage.load_body(trained.psi(run)[0].body).shapedirs.shape[-1]
        if len(arguments.betas) > count:
            raise ValueError(f"--betas: {len(arguments.betas)} given, this body takes {count}")
        betas = np.array(arguments.betas + [0.0] * (count - len(arguments.betas)))
    material = None if arguments.material is None else Material(*arguments.material)
    model = inference.load(run, betas=betas, material=material)
    suffix = {"c": "psi", "litert": "tflite"}.get(arguments.to, arguments.to)
    out = arguments.out or (arguments.run or Path(".")) / f"{model.config.garment}.{suffix}"
    convert(model, out, arguments)


def _batch(given: str) -> int | None:
    """Characters a call, None for any number."""
    return None if given == "dynamic" else int(given)


def convert(model: Model, out: Path, arguments: argparse.Namespace) -> None:
    """Writes the file and its JSON, and says how far it is from the model."""
    small = specialise.specialise(model, blendshapes=arguments.blendshapes, max_influences=arguments.max_influences)
    if arguments.to == "litert" and arguments.int8:
        small = specialise.evened(small)
    about = {"betas": arguments.betas or "the mean body", "material": arguments.material or "as configured"}
    motion = validation(model)
    out.parent.mkdir(parents=True, exist_ok=True)
    if arguments.to == "onnx":
        onnx.to_onnx(small, out, batch=arguments.batch, int8=arguments.int8, output=arguments.output, about=about)
        found = onnx.run_onnx(out, small, motion) if arguments.output == "world" else None
    elif arguments.to == "stablehlo":
        stablehlo.to_stablehlo(small, out, about)
        found = stablehlo.run_stablehlo(out, small, motion)
    elif arguments.to == "litert":
        litert.to_litert(small, out, int8=arguments.int8, about=about)
        found = litert.run_litert(out, small, motion)
    elif arguments.to == "c":
        native.to_c(small, out, about)
        found = _in_c(out, motion)
    else:
        safetensors.to_safetensors(small, out)
        found = np.asarray(inference.animate(safetensors.from_safetensors(out), motion)[0])
    print(f"written to {out}: {out.stat().st_size / 1e6:.2f} MB")
    if found is None:
        print("not compared: " + ("no C compiler" if arguments.to == "c" else "its vertices are not in the world"))
        return
    apart = 1e3 * np.linalg.norm(found - np.asarray(inference.animate(model, motion)[0]), axis=-1)
    error = {"frames": len(found), "mean_mm": float(apart.mean()), "max_mm": float(apart.max())}
    print(
        f"over {len(found)} frames of closed loop: {error['mean_mm']:.4f} mm on average, {error['max_mm']:.4f} at most"
    )
    if out.with_suffix(".json").is_file() and arguments.to != "safetensors":
        told = json.loads(out.with_suffix(".json").read_text())
        out.with_suffix(".json").write_text(json.dumps(told | {"distance_to_jax": error}))


def _in_c(path: Path, motion: Motion) -> np.ndarray | None:
    """Vertices [T, V, 3] m of a .psi; None on a machine without a C compiler."""
    if native.compiler() is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        return native.run_c(native.build(folder), path, motion)


def validation(model: Model) -> Motion:
    """The first validation motion that is here, for FRAMES frames."""
    names = [name for name in model.config.evaluation.motions if storage.asset(name).is_file()]
    clip = storage.load_motion(names[0] if names else "walk_3", model.names)
    clip = assembly.there_and_back(clip, FRAMES)
    return Motion(clip.rotations, np.asarray(clip.translation - clip.translation[:1], np.float32), clip.fps)


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
