"""Train, measure, draw and export the embedded t-shirt: from nothing to a garment moving on a body.

    python -m experiments.quickstart                      # the same as `make quickstart`
    python -m experiments.quickstart --stage1.steps 400   # any setting may be changed

It writes into `runs/quickstart/`: the checkpoints of all stages, report.json, report.md, comparison.png, walk.webp,
tshirt.onnx (with tshirt.json, how to drive it) and tshirt.glb. Run again, it goes on where it stopped.
"""

import json
import time
from pathlib import Path

import jax
import numpy as np

from clothjax import cli
from clothjax.config import Config
from clothjax.evaluation import pictures
from clothjax.evaluation.report import evaluate, table
from clothjax.export.onnx import run_onnx, to_onnx
from clothjax.files import configuration
from clothjax.render.gltf import to_glb
from clothjax.runtime import inference, loading, specialise
from clothjax.simulation import assembly
from clothjax.training.pipeline import run_directory, train
from clothjax.types import Motion

CONFIG = str(Path("configs") / "quickstart.yaml")
ONNX_FRAMES, USUAL = 100, 95  # and the share of them in percent whose error is told


def main(argv: list[str]) -> None:
    started = time.monotonic()
    cli.Parser("experiments.quickstart", __doc__, settings=True, add_help=False).parse_known_args(argv)
    if {"-h", "--help"} & set(argv):
        print(__doc__)
    config = configuration.cli(Config, [CONFIG, *argv])
    directory = run_directory(config, [CONFIG])
    clock = train(config, directory)
    trained = time.monotonic() - started

    print("measuring against the reference solver")
    report = evaluate(directory, settings=config.evaluation)
    experiment = assembly.assemble(config)
    motion = config.evaluation.motions[0]
    betas = assembly.betas(config)

    print("exporting and drawing")
    model = loading.load(directory, betas=betas)
    clip = assembly.motion(experiment, motion)
    origin = clip.translation[0]
    part = Motion(clip.rotations[:ONNX_FRAMES], (clip.translation[:ONNX_FRAMES] - origin).astype(np.float32), clip.fps)
    onnx = to_onnx(specialise.specialise(model), directory / "tshirt.onnx")
    onnx_errors = 1e3 * np.linalg.norm(run_onnx(onnx, model, part) - inference.animate(model, part)[0], axis=-1)
    performance = pictures.perform(directory, experiment, motion, config.evaluation.animation_frames)
    glb_error = to_glb(directory / "tshirt.glb", performance)
    pictures.write_comparison(directory, experiment, motion, directory / "comparison.png")
    pictures.WRITERS[".webp"](directory / "walk.webp", performance)

    report = {
        "quickstart": {
            "train_seconds": sum(clock.values()),
            **clock,
            "this_session_training_seconds": trained,
            "this_session_seconds": time.monotonic() - started,
            # a few frames are left out: in one, rounding may decide whether an edge touches, and so moves its ends
            "onnx_error_mm": float(np.percentile(onnx_errors.max(axis=1), USUAL)),
            "onnx_worst_error_mm": float(onnx_errors.max()),
            "onnx_frames": len(part.rotations),
            "glb_error_mm": {name: 1e3 * error for name, error in glb_error.items()},
            "device": str(jax.devices()[0]),
        },
        **report,
    }  # fmt: skip
    (directory / "report.json").write_text(json.dumps(report, indent=1) + "\n")
    (directory / "report.md").write_text(readable(report, config))
    print(table(report["evaluation"]))
    print(onnx_sentence(report["quickstart"]))
    print(f"look at {directory / 'comparison.png'} and {directory / 'walk.webp'}; figures in {directory / 'report.md'}")


def onnx_sentence(figures: dict) -> str:
    """Return how near ONNX Runtime is to jax, in a sentence."""
    usual, worst = figures["onnx_error_mm"], figures["onnx_worst_error_mm"]
    return (
        f"In {USUAL} % of {figures['onnx_frames']} frames no vertex of ONNX Runtime is farther than {usual:.4f} mm "
        f"from that of jax, in the worst frame {worst:.4f} mm."
    )


def readable(report: dict, config: Config) -> str:
    """Return the report as readable text."""
    figures = report["quickstart"]
    return f"""# Quickstart report

Garment {config.garment}, motion {", ".join(config.evaluation.motions)} (not trained on), betas of seed
{config.evaluation.betas_seed} within {config.evaluation.betas} standard deviations. Training took
{figures["train_seconds"]:.0f} s: blend shapes and preconditioner {figures["start_seconds"]:.0f} s, stage 1
{figures["stage1_seconds"]:.0f} s, labels {figures["teacher_seconds"]:.0f} s, stage 2
{figures["stage2_seconds"]:.0f} s, its fine-tuning {figures.get("tuning_seconds", 0.0):.0f} s, compilation
{figures["compile_seconds"]:.0f} s.

The rows are explained in the docstring of `clothjax/commands/evaluate.py`. Gaps are over {config.evaluation.gap_frames}
frames of each motion; 0 is the reference solver, 1 plain skinning (`energy_gap`) or a garment that keeps its last
canonical displacement (`hold_gap`).

{table(report["evaluation"])}

{onnx_sentence(figures)}
"""


if __name__ == "__main__":
    cli.run(main)
