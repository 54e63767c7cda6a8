"""Measures how fast and how small the parts are, each beside something it is compared with, in one interleaved run.

    python -m experiments.benchmark --part stage1 --json benchmark.json            # the paper's Phi, 4 000 vertices
    python -m experiments.benchmark --part stage1 --quick                          # the embedded 1 000 vertices
    python -m experiments.benchmark --part inference --json inference.json         # Psi on one thread, beside NCS
    python -m experiments.benchmark tshirt runs/ncs --part pareto --json pareto.json    # error against time

Every time is the median of rounds in which all variants take turns. The processor is measured with and without
recomputing its blocks in the backward pass (`model.remat`); beside each piece of a training step stand its flops and
bytes (counted by the compiler, without recomputing) and the fractions of this machine's peaks, measured in the same
run, that they make. `scenes` are of the quickstart's network on the same garment. Beside the JSON comes a plot of the
cost against the vertices, or of error against time.

`inference` times one frame on one thread, with weights in the cache: the paper's Psi (random weights, 4 000 vertices),
NCS's network at its published sizes, and a trained garment of the library in its variants (in plain C too where there
is a compiler), whose `error_mm` is the mean distance of vertices to jax's unspecialised model over 300 frames of closed
loop. `floor_us` is how long this machine takes to read as many bytes.

`pareto` gives time and error, on one thread, of every way to move a garment: skinning, Psi and Phi in their variants,
the solver stopped early, and runs of peers (`configs/ncs.yaml`). It takes folders of runs and names of shipped
garments, by default all of these; what is compared on a garment must be trained for the same physics, wearers and
motions. Phi and the solver are loops and take no turns: their times are of whole loops, or medians of their frames.
Errors are those of `experiments.evaluate`, in closed loop on motions held out of training; `swing_error` is the rms
error of the velocity of what skinning does not do, over the solver's. With `--compare OLD.json` it says whether two
reports put the points in the same order (Kendall's tau).
"""

import argparse
import json
import os
import platform
import sys
from pathlib import Path

import jax

from clothjax import configuration, trained
from clothjax.config import Config
from experiments.benchmarks import inference, pareto, scaling, scenes, stage1
from experiments.session import fail_clearly, setup

SCENES = ["configs/quickstart.yaml"]
PAPER = ["configs/paper_tshirt.yaml"]
ROUNDS = 100  # of inference
QUICK_INFERENCE = {"rounds": 3, "frames": 20, "crowds": (1, 4)}
PARETO = {"rounds": 30, "frames": 60, "gaps": 6}
QUICK_PARETO = {"rounds": 3, "frames": 12, "gaps": 1, "motions": ("walk_3",)}
QUICK = ["configs/quickstart.yaml", "--model.body_nodes", "updated"]


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("runs", nargs="*", help="of --part pareto: folders of runs, names of shipped garments")
    parser.add_argument("--part", choices=["stage1", "inference", "pareto"], default="stage1")
    parser.add_argument("--json", type=Path, default=Path("benchmark.json"))
    parser.add_argument("--quick", action="store_true", help="a small network and few rounds")
    parser.add_argument("--compare", type=Path, default=None, help="of --part pareto: the JSON of an earlier run")
    arguments = parser.parse_args(argv)
    if arguments.part != "pareto" and (arguments.runs or arguments.compare):
        raise ValueError("runs and --compare are for --part pareto")
    if arguments.part == "pareto":
        inference.one_thread()
        before = earlier(arguments.compare) if arguments.compare else []
        names = arguments.runs or trained.shipped()
        runs = [trained.folder(name) if name in trained.shipped() else Path(name) for name in names]
        measured = pareto.measure(runs, **(QUICK_PARETO if arguments.quick else PARETO))
        if before:
            measured["rank_tau"] = pareto.rank_tau(measured["points"], before)
    elif arguments.part == "inference":
        inference.one_thread()
        measured = inference.measure(**QUICK_INFERENCE) if arguments.quick else inference.measure(ROUNDS)
    else:
        measured = training_step(arguments.quick)
    report = {"machine": machine(), arguments.part: measured}
    path = arguments.json
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=1) + "\n")
    {"stage1": scaling, "inference": inference, "pareto": pareto}[arguments.part].plot(
        measured, path.with_suffix(".png")
    )
    print(json.dumps(report, indent=1))
    print(f"written to {path} and {path.with_suffix('.png')}")


def earlier(path: Path) -> list[dict]:
    """The points of an earlier report.

    Raises:
        ValueError: if it is none.
    """
    try:
        return json.loads(path.read_text())["pareto"]["points"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a report of --part pareto ({error!r})") from error


def training_step(quick: bool) -> dict:
    """All figures of stage 1."""
    config = configuration.cli(Config, QUICK if quick else PAPER)
    small = configuration.cli(Config, [*SCENES, "--garment", config.garment])
    rounds = 3 if quick else 5
    parts = {
        "the processor, the convolution, compilation, the step": lambda: stage1.measure(config, rounds),
        "growth with the vertices": lambda: scaling.measure(config, rounds, scaling.SMALL if quick else scaling.SIZES),
        "scenes": lambda: {"scenes": scenes.measure(small, rounds)},
    }
    report = {}
    for name, measure in parts.items():
        print(f"measuring {name}", flush=True)
        report |= measure()
    return report


def machine() -> dict:
    """What the figures were measured on."""
    return {
        "device": str(jax.devices()[0].device_kind),
        "devices": jax.device_count(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
    }


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
