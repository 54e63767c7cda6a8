"""Stress-test the energies, the reference solver and a trained run.

    python -m experiments.stability --json stability.json                   # the energies and the solver
    python -m experiments.stability runs/quickstart --json stability.json   # and rollouts of the run
    python -m experiments.stability runs/quickstart --quick                 # two minutes

1. physics      random, extreme and degenerate configurations of every term in float32: how many have an energy, a
                gradient or a Hessian product that is not finite. And float32 against float64 on a 4 000-vertex garment.
2. solver       timesteps from 1/240 to 1/3 s, materials at the sixteen corners of the training ranges, a garment
                squeezed to 1 % of its height, a body 20 cm from where it was. A case is `recovered`, `reported` (the
                last frame's `SolverInfo.ok` is false) or `silent`: broken, but reported as ok.
3. rollouts     Psi over thousands of frames, on bodies, cloths and frame rates beyond its training, with its pose
                frozen, and after shocks: a jump of 10 m, a frame of NaN, a half-turn of one frame. Recovery is counted
                in frames until the energy is within 10 % of the undisturbed loop's and stays there; drift is the way of
                the farthest vertex over 2 000 frames of one pose. Phi's figures stand beside Psi's.

`clothjax/runtime/inference.py` describes how a state recovers.
"""

import json
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

from clothjax import cli
from clothjax.config import Config
from clothjax.progress import progress_bar
from clothjax.runtime import trained
from experiments.stability import physics, rollouts, solver

matplotlib.use("Agg")

ORIGINS = (0.0, 100.0)  # m


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.stability", __doc__)
    cli.model_argument(parser, nargs="?", about="; default: only the energies and the solver")
    parser.add_argument("--json", type=Path, default=Path("stability.json"))
    parser.add_argument("--quick", action="store_true", help="a tenth of it")
    arguments = parser.parse_args(argv)
    report, curves = stress(arguments.model and trained.find(arguments.model), arguments.quick)
    arguments.json.parent.mkdir(parents=True, exist_ok=True)
    arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    picture = arguments.json.with_suffix(".png")
    plot(report, curves, picture)
    print(readable(report))
    print(f"written to {arguments.json} and {picture}")


def stress(run: Path | None, quick: bool = False) -> tuple[dict, dict]:
    """Run the three layers; return the content of the JSON file, and the curves of the third for the picture."""
    report = {"physics": _physics(1000 if quick else 10000), "float32": _precision(quick)}
    frames = 3 if quick else 10
    with progress_bar("solver", 7 if quick else 24) as done:
        outcomes = solver.stress(Config(), frames, quick, done)
    results = [outcome.result for outcome in outcomes.values()]
    report["solver"] = {
        "cases": len(results),
        "recovered": results.count("recovered"),
        "reported": results.count("reported"),
        "silent_failures": results.count("silent"),
        "outcomes": {name: outcome._asdict() for name, outcome in outcomes.items()},
    }
    for size, count in ((1000, 8 if quick else 60), (4000, 0 if quick else 12)):
        if count:
            timed = solver.seconds_per_frame(Config(garment=f"tshirt_{size}"), count)
            report["solver"] |= {f"seconds_per_frame_{size}": timed["seconds"], f"walk_{size}": timed}
    if run is None:
        return report, {}
    with progress_bar("rollouts", 4) as done:
        measured = rollouts.stress(run, 1000 if quick else 10000, quick, done)
    loops, shocks = measured["loops"], measured["shocks"]
    recovery = {name: shock.recovery for name, shock in shocks.items()}
    report["closed_loop"] = {
        "frames": sum(loop.frames for loop in loops.values()),
        "nonfinite": sum(loop.nonfinite for loop in loops.values()) + measured["phi"]["nonfinite"],
        "recovery_frames": None if None in recovery.values() else max(recovery.values()),
        "drift_mm": float(measured["drift_mm"].max()),
        "phi_recovery_frames": measured["phi"]["recovery_frames"],
        "phi_drift_mm": float(measured["phi"]["drift_mm"].max()),
        "loops": {name: loop._asdict() for name, loop in loops.items()},
        "recovery": recovery,
    }
    curves = {
        "drift": {"Psi": measured["drift_mm"], "Phi": measured["phi"]["drift_mm"]},
        "energy": {name: shock.energy for name, shock in shocks.items()} | {"teleport, Phi": measured["phi"]["energy"]},
    }
    return report, curves


def _physics(count: int) -> dict:
    terms = physics.count_nonfinite(count)
    kinds = ("energy", "gradient", "hessian")
    return {
        "configurations": sum(term["configurations"] for term in terms.values()),
        "nonfinite": sum(term.get(kind, 0) for term in terms.values() for kind in kinds),
        "terms": terms,
    }


def _precision(quick: bool) -> dict:
    config = Config(garment="tshirt_1000" if quick else "tshirt_4000")
    terms = {f"{away:g} m": physics.precision(config, away) for away in ORIGINS}
    return {
        "energy_error": max(term["energy"] for place in terms.values() for term in place.values()),
        "gradient_error": max(term["gradient"] for place in terms.values() for term in place.values()),
        "garment": config.garment,
        "terms": terms,
    }


def readable(report: dict) -> str:
    """Return the report as Markdown."""
    places = list(report["float32"]["terms"])
    rows = [
        "| energy | configurations | not finite | " + " | ".join(f"float32 at {place}" for place in places) + " |",
        "|---" * (3 + len(places)) + "|",
    ]
    for name, counts in report["physics"]["terms"].items():
        wrong = sum(counts.get(kind, 0) for kind in ("energy", "gradient", "hessian"))
        errors = [report["float32"]["terms"][place].get(name) for place in places]
        cells = ["" if e is None else f"{e['energy']:.0e}, gradient {e['gradient']:.0e}" for e in errors]
        rows.append(f"| {name} | {counts['configurations']} | {wrong} | " + " | ".join(cells) + " |")
    rows += ["", "| solver | s/frame | iterations | strain | inside, % | |", "|---|---|---|---|---|---|"]
    for name, case in report["solver"]["outcomes"].items():
        cells = (f"{case['seconds']:.2f}", case["iterations"], f"{case['strain']:.2f}", f"{case['inside']:.1f}")
        rows.append(f"| {name} | " + " | ".join(map(str, cells)) + f" | {case['result']} |")
    for size in (1000, 4000):
        if f"walk_{size}" in report["solver"]:
            walk = report["solver"][f"walk_{size}"]
            rows.append(
                f"\nA walk on {walk['vertices']} vertices: {walk['seconds']:.2f} s a frame (median; "
                f"{walk['seconds_max']:.2f} at most), relative gradient at most {walk['relative_gradient']:.1e}."
            )
    if "closed_loop" in report:
        loop = report["closed_loop"]
        rows += ["", "| rollout | frames | not finite | outside training | code | strain |", "|---" * 6 + "|"]
        for name, case in loop["loops"].items():
            cells = (
                case["frames"],
                case["nonfinite"],
                case["flagged"],
                f"{case['latent']:.1f}",
                f"{case['strain']:.2f}",
            )
            rows.append(f"| {name} | " + " | ".join(map(str, cells)) + " |")
        rows.append(
            "\nOf the code it is the largest component, in standard deviations; with forces, in its own units."
            f" Drift on a frozen pose: Psi {loop['drift_mm']:.2f} mm, Phi {loop['phi_drift_mm']:.2f} mm. Frames after"
            f" a shock until it is back: Psi {loop['recovery_frames']}, Phi after a jump {loop['phi_recovery_frames']}."
        )
    return "\n".join(rows)


def plot(report: dict, curves: dict, path: Path) -> None:
    """Plot the layers: errors of float32, the solver's cases, the rollouts."""
    figure, axes = plt.subplots(2, 2, figsize=(13, 9), constrained_layout=True)
    first, second, third, fourth = axes.reshape(-1)
    places = report["float32"]["terms"]
    for index, (place, terms) in enumerate(places.items()):
        at = np.arange(len(terms)) + 0.4 * index - 0.2
        first.bar(at, [max(term["gradient"], 1e-12) for term in terms.values()], 0.4, label=f"{place} from the origin")
        first.set_xticks(np.arange(len(terms)), terms, rotation=30, ha="right")
    first.axhline(1e-4, color="black", linestyle=":", label="bar")
    first.set(yscale="log", title="gradient in float32 against float64", ylabel="relative error")
    first.legend()
    outcomes = report["solver"]["outcomes"]
    colours = {"recovered": "tab:blue", "reported": "tab:orange", "silent": "tab:red"}
    second.barh(
        [name.split(":")[0] for name in outcomes],
        [case["seconds"] for case in outcomes.values()],
        color=[colours[case["result"]] for case in outcomes.values()],
    )
    second.invert_yaxis()
    second.tick_params(axis="y", labelsize=7)
    second.set(title="reference solver (orange: reported, red: silent failure)", xlabel="s a frame")
    for name, drift in curves.get("drift", {}).items():
        third.plot(drift, label=name)
    third.axhline(1.0, color="black", linestyle=":")
    third.set(title="drift on a frozen pose", xlabel="frame", ylabel="farthest vertex, mm")
    for name, energy in curves.get("energy", {}).items():
        fourth.plot(np.arange(len(energy)) - rollouts.BEFORE + 3, energy, label=name)
    fourth.axhspan(1 - rollouts.WITHIN, 1 + rollouts.WITHIN, color="0.9")
    fourth.set(title="after a shock", xlabel="frame", ylabel="energy over the undisturbed", yscale="log")
    for axis in (third, fourth):
        if axis.get_legend_handles_labels()[0]:
            axis.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)
