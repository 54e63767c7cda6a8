"""Measure how fast and how small the parts are, each beside its comparison, in one interleaved run.

    python -m experiments.benchmark --json benchmark.json --plot benchmark.png     # all parts, one after the other
    python -m experiments.benchmark --quick                                        # checks that it all works
    python -m experiments.benchmark --compare old.json                             # ratios, and flags beyond noise
    python -m experiments.benchmark --part stage1                                  # the paper's Phi, 4 000 vertices
    python -m experiments.benchmark --part inference                               # Psi on one thread, beside NCS
    python -m experiments.benchmark runs/thesis/tshirt/{ours,ncs} --part pareto    # error against time

Every time is the median of rounds in which all variants take turns; `noise` is the factor by which such a median
differs from itself. The plots are named after the parts (`benchmark.stage1.png`).

`stage1`: the processor is measured with and without recomputing its blocks in the backward pass (`model.remat`);
beside each piece of a training step stand its flops and bytes (counted by the compiler, without recomputing) and the
fractions of this machine's peaks, measured in the same run, that they make. `scenes` are of the quickstart's network
on the same garment. The plot is of the cost against the vertices.

`inference` times one frame on one thread, with weights in the cache: the paper's Psi (random weights, 4 000 vertices),
NCS's network at its published sizes, and a trained garment of the library in its variants (in plain C too where there
is a compiler), whose `error_mm` is the mean distance of vertices to jax's unspecialised model over a rollout of 300
frames. `floor_us` is the time in which this machine reads as many bytes.

`pareto` gives time and error, on one thread, of every way to move a garment: skinning, Psi and Phi in their variants,
the solver stopped early, and runs of baselines (`configs/ncs.yaml`). It takes folders of runs and names of shipped
garments, by default all of these; runs of one garment must be trained for the same physics, bodies and motions. Phi
and the solver are loops and take no turns: their times are of complete loops, or medians of their frames.
Errors are those of `clothjax evaluate`, in rollouts on motions held out of training; `swing_error` is the rms
error of the velocity that skinning does not explain, over the solver's.

`--quick` only checks that the parts run: a small Phi, few rounds and frames, one garment. It leaves out what needs
programs of its own. Of `stage1` that is compilation, blocks that are not recomputed, float64, batches, flops and bytes,
the growth with vertices and the scenes. Of `inference` it is the paper's size and NCS, garments that rest, 4 000
vertices, parts of a garment and fewer blend shapes. Of `pareto` it is Phi of many steps, the solver stopped early and
fewer shapes.

`--compare OLD.json` sets the times of both reports side by side and flags ratios beyond the noise of both. For `pareto`
it also tells whether both put the points in the same order (Kendall's tau).
"""

import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import jax

from clothjax import cli
from clothjax.config import Config
from clothjax.files import configuration
from clothjax.runtime import trained
from experiments.benchmark import comparison, inference, pareto, scaling, scenes, stage1, timing, variants

PARTS = ("stage1", "inference", "pareto")
SCENES = ["configs/quickstart.yaml"]
PAPER = ["configs/paper_tshirt.yaml"]
ROUNDS, QUICK_ROUNDS = 5, 3  # of training steps
INFERENCE = {"rounds": 100}
QUICK_INFERENCE = {"rounds": 3, "frames": 20, "crowds": (1, 4), "whole": False}
PARETO = {"rounds": 30, "frames": 60, "gaps": 5}
QUICK_PARETO = {
    "rounds": 3, "frames": 12, "gaps": 1, "motions": ("walk_3",),
    "descent_steps": variants.DESCENT_STEPS[:1], "iterations": variants.ITERATIONS[-1:], "shapes": {},
}  # fmt: skip
QUICK_GARMENTS = ("tshirt",)
QUICK = [  # what compiles soonest
    "configs/quickstart.yaml", "--model.body_nodes", "updated", "--model.width", "16",
    "--model.latent_update", "absolute", "--physics.contact_surface", "centroids", "--physics.no-edge_contact",
    "--stage2.no-forces", "--model.relaxation", "0",
]  # fmt: skip


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.benchmark", __doc__)
    cli.model_argument(parser, nargs="*", about="; for the part pareto, several")
    parser.add_argument("--part", choices=PARTS, default=None, help="default: all")
    parser.add_argument("--json", type=Path, default=Path("benchmark.json"))
    parser.add_argument("--plot", type=Path, default=None, help="default: beside the JSON")
    parser.add_argument("--quick", action="store_true", help="a small network, few rounds, little compilation")
    parser.add_argument("--compare", type=Path, default=None, help="the JSON of an earlier run")
    arguments = parser.parse_args(argv)
    if arguments.part not in (None, "pareto") and arguments.model:
        raise ValueError("runs are for the part pareto")
    before = earlier(arguments.compare) if arguments.compare else None
    path, plot = arguments.json, arguments.plot or arguments.json.with_suffix(".png")
    if arguments.part is None:
        report = each_part(arguments.model, arguments.quick, path, plot)
    else:
        report = measure(arguments.part, arguments.model, arguments.quick)
        draw(report, arguments.part, plot.with_suffix(f".{arguments.part}{plot.suffix}"))
    if before:
        report["compare"] = comparison.compare(report, before)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=1) + "\n")
    print(json.dumps(report, indent=1))
    if before:
        print("\n".join(comparison.lines(report["compare"])))
    print(f"written to {path}")


def draw(report: dict, part: str, path: Path) -> None:
    """Draw the plot of a part; a quick stage 1 has no growth to draw."""
    if part == "stage1" and "seconds_by_vertices" not in report[part]:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    {"stage1": scaling, "inference": inference, "pareto": pareto}[part].plot(report[part], path)
    print(f"drawn in {path}")


def each_part(runs: list[str], quick: bool, report_path: Path, plot: Path) -> dict:
    """Run every part in its own process, because parts differ in the number of cores that jax may use.

    Args:
        report_path: file of the report so far, written after each part in case the next one fails.
    """
    report = {}
    report_path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for part in PARTS:
            path = Path(folder) / f"{part}.json"
            command = [sys.executable, "-m", "experiments.benchmark", *(runs if part == "pareto" else [])]
            command += ["--part", part, "--json", str(path), "--plot", str(plot), *(["--quick"] if quick else [])]
            print(f"part {part}", flush=True)
            if subprocess.run(command, stdout=subprocess.DEVNULL, check=False).returncode != 0:
                raise ValueError(
                    f"the part {part} failed, see above: run it alone with --part {part}; the measures of the parts "
                    f"before it are in {report_path}"
                )
            report |= json.loads(path.read_text())
            report_path.write_text(json.dumps(report, indent=1) + "\n")
    return report


def measure(part: str, names: list[str], quick: bool) -> dict:
    """Measure one part, and the machine as that part uses it."""
    if part == "stage1":
        measured = training_step(quick)
    else:
        inference.one_thread()
        if part == "inference":
            measured = inference.measure(**(QUICK_INFERENCE if quick else INFERENCE))
        else:
            names = names or (QUICK_GARMENTS if quick else trained.shipped())
            measured = pareto.measure([trained.find(name) for name in names], **(QUICK_PARETO if quick else PARETO))
    return {"machine": machine(), part: measured | {"peaks": timing.peaks(3), "noise": timing.noise()}}


def earlier(path: Path) -> dict:
    """Load an earlier report.

    Raises:
        ValueError: if the file is not a report.
    """
    try:
        report = json.loads(path.read_text())
        if isinstance(report, dict) and "machine" in report and set(report) & set(PARTS):
            return report
        error = "no part of it is there"
    except (OSError, ValueError) as raised:
        error = raised
    raise ValueError(f"{path}: not a report of experiments.benchmark ({error})")


def training_step(quick: bool) -> dict:
    """Measure stage 1."""
    config = configuration.cli(Config, QUICK if quick else PAPER)
    if quick:
        return stage1.measure(config, QUICK_ROUNDS, whole=False)
    small = configuration.cli(Config, [*SCENES, "--garment", config.garment])
    parts = {
        "the processor, the convolution, compilation, the step": lambda: stage1.measure(config, ROUNDS),
        "growth with the vertices": lambda: scaling.measure(config, ROUNDS, scaling.SIZES),
        "scenes": lambda: {"scenes": scenes.measure(small, ROUNDS)},
    }
    report = {}
    for name, measure in parts.items():
        print(f"measuring {name}", flush=True)
        report |= measure()
    return report


def machine() -> dict:
    """Describe this machine."""
    return {
        "device": str(jax.devices()[0].device_kind),
        "devices": jax.device_count(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
    }
