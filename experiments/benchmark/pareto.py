"""Error against time of every method that moves a garment, with winners and Pareto fronts."""

import tempfile
from pathlib import Path
from typing import BinaryIO

import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import kendalltau

from clothjax.evaluation import metrics
from clothjax.evaluation.rollouts import SETTLING_FRAMES, skinned_trajectory, windows
from clothjax.progress import progress_bar
from clothjax.runtime import trained
from experiments.benchmark.inference import interleaved
from experiments.benchmark.variants import DESCENT_STEPS, ITERATIONS, SHAPES, Case, every, prepare

matplotlib.use("Agg")

USABLE = 1.1  # errors of NCS in a smaller form, over those of the form that was trained
ERRORS = {
    "energy_gap": "energy gap: 0 the solver, 1 skinning",
    "step_error_mm": "distance to the solver's step, mm",
    "swing_error": "error of swing over the solver's swing",
}
COLOURS = {
    "skinning": "gray", "psi": "tab:blue", "phi": "tab:green", "ncs": "tab:red", "snug": "tab:orange",
    "direct": "tab:purple", "xpbd": "tab:brown", "solver": "black",
}  # fmt: skip
MARKERS = {"onnx": "o", "c": "^", "jax": "s", "warp": "D"}
LEAST = {"energy_gap": 1e-5, "step_error_mm": 1e-3, "swing_error": 1e-3}  # where the plots begin
MOST = {"energy_gap": 10.0, "step_error_mm": 100.0, "swing_error": 10.0}  # and end: cloth that has gone wrong


def measure(
    runs: list[Path],
    rounds: int,
    frames: int,
    gaps: int,
    motions: tuple[str, ...] = (),
    descent_steps: tuple[int, ...] = DESCENT_STEPS,
    iterations: tuple[int, ...] = ITERATIONS,
    shapes: dict[str, float] = SHAPES,
) -> dict:
    """Measure the points of all runs, and find winners for garments with runs of both NCS and Psi.

    Args:
        runs: folders of runs and of packed models; those of one garment are compared with each other.
        frames: of each motion; gaps: number of these at which the solver is asked.
        motions: default: those on which all runs of a garment are evaluated.
        descent_steps: of Phi; iterations: of the solver, of which the last is until it has converged.
        shapes: names of the forms of Psi and of baselines with fewer blend shapes, and the part of them that they have.

    Raises:
        ValueError: if runs of a garment differ in body, physics, cloth or motions.
    """
    garments: dict[str, list[Path]] = {}
    for run in dict.fromkeys(runs):
        garments.setdefault(trained.configured(run).garment, []).append(run)
    cases = [prepare(of_it, motions, frames) for of_it in garments.values()]
    points = []
    with progress_bar("garments", len(garments)) as report, tempfile.TemporaryDirectory() as folder:
        for index, (case, (garment, of_it)) in enumerate(zip(cases, garments.items(), strict=True)):
            variants, solved = every(case, of_it, Path(folder), descent_steps, iterations, shapes)
            us = interleaved({key: each.call for key, each in variants.items() if each.call}, rounds)
            for key, each in variants.items():
                point = {"name": key[1], "run": _short(key[0]), "family": each.family, "garment": garment}
                point |= {"runtime": each.runtime, "us": us.get(key, each.us), "converged": each.converged}
                points.append(point | _errors(case, each.tracks, solved, gaps))
            report(index + 1)
    for point in points:
        others = [p for p in points if p["garment"] == point["garment"]]
        point["front"] = {error: not any(_better(other, point, error) for other in others) for error in ERRORS}
    return {"points": points} | wins(points)


def _short(run: str) -> str:
    """Return the name of a run that holds on every machine: a garment of the library by its name."""
    return Path(run).name if run and trained.packed(run) else run


def wins(points: list[dict]) -> dict:
    """Find garments on which Psi beats NCS: in every error at no more time, and in time at no greater error.

    Both are in ONNX Runtime, and in forms of the same kinds: as trained, with fewer blend shapes, in eight bits. NCS is
    represented by its fastest form with errors at most USABLE times those of the trained form. Of several runs
    (seeds) the medians of a form are compared.
    """
    won = {"wins_at_equal_time": [], "wins_at_equal_error": [], "compared": []}
    for garment in dict.fromkeys(point["garment"] for point in points):
        ours, theirs = (
            _medians([p for p in points if (p["garment"], p["family"], p["runtime"]) == (garment, family, "onnx")])
            for family in ("psi", "ncs")
        )
        if not (ours and theirs):
            continue
        won["compared"].append(garment)
        published = theirs["ncs"]
        if not all(np.isfinite(published[error]) for error in ERRORS):
            raise ValueError(f"the errors of NCS on {garment} are not finite: its training diverged; train it again")
        usable = [p for p in theirs.values() if all(p[error] <= USABLE * published[error] for error in ERRORS)]
        fastest = min(usable, key=lambda p: p["us"])
        in_time = [p for p in ours.values() if p["us"] <= fastest["us"]]
        if any(all(p[error] < fastest[error] for error in ERRORS) for p in in_time):
            won["wins_at_equal_time"].append(garment)
        as_good = [p for p in ours.values() if all(p[error] <= fastest[error] for error in ERRORS)]
        if any(p["us"] < fastest["us"] for p in as_good):
            won["wins_at_equal_error"].append(garment)
    return won


def _medians(points: list[dict]) -> dict[str, dict[str, float]]:
    """Return median time and errors of each form, by name, over the runs that have it."""
    names = dict.fromkeys(p["name"] for p in points)
    return {
        name: {key: float(np.median([p[key] for p in points if p["name"] == name])) for key in ("us", *ERRORS)}
        for name in names
    }


def rank_tau(points: list[dict], others: list[dict]) -> dict[str, float | None]:
    """Return the number of `points` that two reports share, and Kendall's tau of their orders by time and error."""
    named = {(p["garment"], p["run"], p["name"]): p for p in others}
    pairs = [(p, named[key]) for p in points if (key := (p["garment"], p["run"], p["name"])) in named]
    agreement = {"points": len(pairs)}
    for key in ("us", *ERRORS):
        tau = float(kendalltau([one[key] for one, _ in pairs], [other[key] for _, other in pairs]).statistic)
        agreement[key] = tau if np.isfinite(tau) else None  # all alike have no order
    return agreement


def _better(one: dict, other: dict, error: str) -> bool:
    """Return whether a point is no worse in time and error, and better in one."""
    no_worse = one["us"] <= other["us"] and one[error] <= other[error]
    return no_worse and (one["us"], one[error]) != (other["us"], other[error])


def _errors(case: Case, tracks: list[np.ndarray], solved: list[np.ndarray], gaps: int) -> dict[str, float]:
    experiment, measures, swings = case.experiment, [], []
    for clip, track, reference in zip(case.clips, tracks, solved, strict=True):
        poses = windows(clip)
        frames = np.unique(np.linspace(SETTLING_FRAMES, len(track) - 2, gaps).astype(int))
        measures += metrics.step_measures(
            experiment.scene, case.character, jnp.asarray(track), poses, frames, experiment.config
        )
        skinned = skinned_trajectory(experiment, case.character, poses)
        beside = metrics.beside_solver(experiment.scene, *(x[SETTLING_FRAMES:] for x in (track, reference, skinned)))
        ratio, correlation = beside["swing_ratio"], beside["swing_correlation"]
        swings.append(ratio**2 + 1.0 - 2.0 * ratio * correlation)  # of |a - b|^2 / |b|^2
    mean = metrics.gaps(measures)
    return {
        "energy_gap": mean["energy_gap"],
        "hold_gap": mean["hold_gap"],
        "step_error_mm": mean["step_error_mm"],
        "swing_error": float(np.sqrt(max(np.mean(swings), 0.0))),
    }


def plot(report: dict, path: Path | BinaryIO) -> None:
    """Plot each error against time, a row for each garment, with the fronts.

    Points beyond the plot's ends are drawn at them.
    """
    points = report["points"]
    garments = list(dict.fromkeys(point["garment"] for point in points))
    size = (5 * len(ERRORS), 4.2 * len(garments))
    figure, axes = plt.subplots(len(garments), len(ERRORS), figsize=size, squeeze=False, constrained_layout=True)
    for row, garment in zip(axes, garments, strict=True):
        of_it = [point for point in points if point["garment"] == garment]
        for axis, (error, label) in zip(row, ERRORS.items(), strict=True):
            for family, runtime in dict.fromkeys((point["family"], point["runtime"]) for point in of_it):
                chosen = [point for point in of_it if (point["family"], point["runtime"]) == (family, runtime)]
                where = [p["us"] for p in chosen], np.clip([p[error] for p in chosen], LEAST[error], MOST[error])
                style = {"ms": 5, "alpha": 0.8, "color": COLOURS[family], "label": f"{family} ({runtime})"}
                axis.loglog(*where, MARKERS[runtime], **style)
            front = sorted((p["us"], max(p[error], LEAST[error])) for p in of_it if p["front"][error])
            axis.step(*zip(*front, strict=True), color="black", lw=0.8, where="post")
            axis.set(xlabel="us a frame", ylabel=label, title=garment)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(title="Pareto front: line", fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)
