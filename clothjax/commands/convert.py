"""Write a model, of a run or of a garment that comes with the library, for another runtime; compare it with jax.

    python -m clothjax convert runs/quickstart --to onnx --int8
    python -m clothjax convert skirt --to stablehlo --out skirt.stablehlo
    python -m clothjax convert dress_fine --to c --out engine/dress.psi
    python -m clothjax convert tshirt --to onnx --batch dynamic --blendshapes 192 --betas 1 0 -0.5

    onnx          ONNX Runtime 1.15 and newer, and engines built on it. --int8 writes eight bits; --output canonical
                  is for engines that skin the garment, --output none for a garment that nobody sees
    stablehlo     any process with jax or XLA, on CPU, GPU or TPU, without clothjax
    litert        LiteRT (TensorFlow Lite), as on phones, of a model without forces; --int8 writes eight bits
    c             plain C without any runtime, in eight bits: psi.c and psi.h come with it
    safetensors   the arrays alone, for those who build a runtime

A JSON beside the file tells an engine how to drive it: skirt.json of skirt.onnx, skirt.psi.json of skirt.psi and so on.
The model is specialised first, by `clothjax/runtime/specialise.py`. The distance of vertices to jax's unspecialised
model over a rollout of 300 frames is printed and written to the JSON, if a motion fits its joints and rate.
"""

import argparse
from pathlib import Path

import numpy as np

from clothjax import cli
from clothjax.export import formats
from clothjax.export.formats import FORMATS, Options
from clothjax.files import storage
from clothjax.runtime import loading, trained
from clothjax.runtime.models import Model
from clothjax.simulation import assembly
from clothjax.types import Material, Motion

FRAMES = 300


def main(argv: list[str]) -> None:
    """Write a model for another runtime, as the arguments say.

    Raises:
        ValueError: for a mistake in the arguments, or a file that is missing or wrong.
    """
    parser = cli.Parser("clothjax convert", __doc__)
    cli.model_argument(parser)
    parser.add_argument("--to", choices=FORMATS, default="onnx")
    parser.add_argument(
        "--out",
        type=Path,
        default=None,
        help="default: GARMENT.onnx and so on in the run's folder; skirt.onnx of the library's skirt, here",
    )
    parser.add_argument("--int8", action="store_true", help="eight bits")
    parser.add_argument("--batch", type=_batch, default=1, metavar="N|dynamic", help="characters a call")
    parser.add_argument("--output", choices=["world", "canonical", "none"], default="world", help="of the vertices")
    parser.add_argument("--coarse", action="store_true", help="the level of detail of a garment of model.felt")
    parser.add_argument("--blendshapes", type=int, default=None, help="largest number; default: all")
    parser.add_argument("--max-influences", type=int, default=None, help="joints that move a vertex; default: all")
    parser.add_argument("--betas", type=float, nargs="+", default=None, help="of the body; default: the mean body")
    parser.add_argument("--material", type=float, nargs=4, default=None, metavar=Material._fields)
    arguments = parser.parse_args(argv)
    options = Options(**{name: getattr(arguments, name) for name in Options._fields})
    formats.check(arguments.to, options)
    run = trained.find(arguments.model)
    count = storage.load_body(trained.configured(run).body).shapedirs.shape[-1]
    betas = cli.betas(arguments.betas, count)
    material = None if arguments.material is None else Material(*arguments.material)
    model = loading.load(run, betas=betas, material=material, coarse=arguments.coarse)
    form = FORMATS[arguments.to]
    default = run / f"{Path(model.config.garment).stem}.{form.suffix}"
    if arguments.model in trained.shipped():  # several are of one garment
        default = Path(f"{arguments.model}{'_coarse' if arguments.coarse else ''}.{form.suffix}")
    out = arguments.out or default
    about = {"betas": arguments.betas or "the mean body", "material": arguments.material or "as configured"}
    try:
        motion, not_run = validation(model), form.not_run
    except ValueError as reason:
        motion, not_run = None, str(reason)
    error = formats.export(model, arguments.to, out, options, about, motion)
    print(f"written to {out}: {out.stat().st_size / 1e6:.2f} MB")
    if error is None:
        print(f"not compared: {not_run}")
    else:
        print(
            f"over {error['frames']} frames of autoregressive rollout: {error['mean_mm']:.4f} mm on average, "
            f"{error['max_mm']:.4f} at most"
        )


def _batch(given: str) -> int | None:
    """Return the number of characters a call, None for any number.

    Raises:
        ArgumentTypeError: for anything else.
    """
    if given == "dynamic":
        return None
    if not given.isdecimal() or int(given) < 1:
        raise argparse.ArgumentTypeError(f"{given!r} is neither a number from 1 nor `dynamic`")
    return int(given)


def validation(model: Model) -> Motion:
    """Return the first validation motion that is there and fits, or else the embedded walk, for FRAMES frames.

    Raises:
        ValueError: if none fits the joints and the rate of the model, with the reasons.
    """
    reasons, fps = [], model.config.fps
    for name in dict.fromkeys((*model.config.evaluation.motions, "walk_3")):
        try:
            clip = storage.load_motion(name, model.names)
            if abs(clip.fps - fps) > 1e-3:
                raise ValueError(f"{name} has {clip.fps:g} frames a second, the model {fps:g}")
        except ValueError as error:
            reasons.append(str(error))
        else:
            clip = assembly.there_and_back(clip, FRAMES)
            return Motion(clip.rotations, np.asarray(clip.translation - clip.translation[:1], np.float32), clip.fps)
    raise ValueError("; ".join(reasons))
