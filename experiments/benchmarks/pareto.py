"""Error against time of every way to move a garment: Psi and Phi in their variants, peers, the solver, skinning."""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from scipy.stats import kendalltau

from clothjax import character as characters
from clothjax import experiment, folding, inference, latent_predictor, metrics, rollout, simulation, skinning, trained
from clothjax import peers as networks
from clothjax.character import Character
from clothjax.config import Config
from clothjax.experiment import Experiment
from clothjax.export import native, onnx
from clothjax.export.onnx_graph import Graph
from clothjax.types import Motion, Pose
from experiments.benchmarks import peers
from experiments.benchmarks.inference import Call, bound, c_call, interleaved, onnx_call
from experiments.evaluate import SETTLING, skinned_trajectory, windows
from experiments.session import progress
from experiments.train import load_phi

matplotlib.use("Agg")
import matplotlib.pyplot as plt

MOTIONS = ("walk_3",)  # held out of training by every configuration
DESCENT_STEPS = (1, 4, 16, 32)  # of Phi
ITERATIONS = (1, 2, 4, 8, 500)  # of the solver, of which the last is until it has converged
SHAPES = {"a half": 1 / 2, "a third": 1 / 3, "a sixth": 1 / 6, "a twelfth": 1 / 12}  # of Psi's blend shapes
ERRORS = {
    "energy_gap": "energy gap: 0 the solver, 1 skinning",
    "step_error_mm": "distance to the solver's step, mm",
    "swing_error": "error of swing over the solver's swing",
}
COLOURS = {
    "skinning": "gray", "psi": "tab:blue", "phi": "tab:green", "ncs": "tab:red", "snug": "tab:orange",
    "direct": "tab:purple", "solver": "black",
}  # fmt: skip
LEAST = {"energy_gap": 1e-5, "step_error_mm": 1e-3, "swing_error": 1e-3}  # where the plots begin


class Way(NamedTuple):
    """A way to move a garment."""

    family: str  # of COLOURS
    tracks: list[np.ndarray]  # closed loops [T - 2, V, 3] m over each of the clips, relative to the root
    call: Call | None  # one frame of it, to be timed beside the others
    us: float = 0.0  # a frame of the loop, where there is no `call`


class Stage(NamedTuple):
    """What the ways of a garment have in common."""

    whole: Experiment
    character: Character
    clips: list[Motion]


def measure(runs: list[Path], rounds: int, frames: int, gaps: int, motions: tuple[str, ...] = MOTIONS) -> dict:
    """Points of all runs, and what wins where a garment has a run of NCS beside one of Psi.

    Args:
        runs: folders of runs and of packed models; those of one garment are compared with each other.
        frames: of each motion; gaps: of them, at how many the solver is asked.
    """
    garments: dict[str, list[Path]] = {}
    for run in runs:
        garments.setdefault(trained.phi(run)[0].garment, []).append(run)
    points = []
    with progress("garments", len(garments)) as report, tempfile.TemporaryDirectory() as folder:
        for index, (garment, of_it) in enumerate(garments.items()):
            stage = _stage(of_it[0], motions, frames)
            ways, solved = _every(stage, of_it, Path(folder))
            us = interleaved({name: way.call for name, way in ways.items() if way.call}, rounds)
            for name, way in ways.items():
                found = {"name": name, "family": way.family, "garment": garment, "us": us.get(name, way.us)}
                points.append(found | _errors(stage, way.tracks, solved, gaps))
            report(index + 1)
    for point in points:
        others = [p for p in points if p["garment"] == point["garment"]]
        point["front"] = {error: not any(_better(other, point, error) for other in others) for error in ERRORS}
    return {"points": points} | wins(points)


def wins(points: list[dict]) -> dict:
    """Garments that have both, on which Psi beats NCS in its fastest usable form: in every error at no more time, and
    in time at no more of any error.

    Usable are forms of NCS whose step errs by at most a tenth more than that of its best. Psi has forms that NCS is not
    given here: fewer blend shapes, plain C.
    """
    won = {"wins_at_equal_time": [], "wins_at_equal_error": [], "compared": []}
    for garment in dict.fromkeys(point["garment"] for point in points):
        ours, theirs = (
            [p for p in points if p["garment"] == garment and p["family"] == family] for family in ("psi", "ncs")
        )
        if not (ours and theirs):
            continue
        won["compared"].append(garment)
        least = min(p["step_error_mm"] for p in theirs)
        usable = [p for p in theirs if p["step_error_mm"] <= 1.1 * least]
        fastest = min(usable, key=lambda p: p["us"])
        in_time = [p for p in ours if p["us"] <= fastest["us"]]
        if any(all(p[error] < fastest[error] for error in ERRORS) for p in in_time):
            won["wins_at_equal_time"].append(garment)
        as_good = [p for p in ours if all(p[error] <= fastest[error] for error in ERRORS)]
        if any(p["us"] < fastest["us"] for p in as_good):
            won["wins_at_equal_error"].append(garment)
    return won


def rank_tau(points: list[dict], others: list[dict]) -> dict[str, float]:
    """Kendall's tau of the order of the points that two runs have in common, by time and by each error."""
    named = {(p["garment"], p["name"]): p for p in others}
    pairs = [(p, named[p["garment"], p["name"]]) for p in points if (p["garment"], p["name"]) in named]
    return {
        key: float(kendalltau([one[key] for one, _ in pairs], [other[key] for _, other in pairs]).statistic)
        for key in ("us", *ERRORS)
    }


def _better(one: dict, other: dict, error: str) -> bool:
    """Whether a point is no worse in time and error, and better in one."""
    no_worse = one["us"] <= other["us"] and one[error] <= other[error]
    return no_worse and (one["us"], one[error]) != (other["us"], other[error])


def _stage(run: Path, motions: tuple[str, ...], frames: int) -> Stage:
    whole, _ = load_phi(run)
    config = whole.config
    character = jax.jit(lambda b, m: characters.dress(whole.scene, b, m, config.physics))(
        jnp.asarray(experiment.betas(config)), experiment.material(config)
    )
    clips = [experiment.motion(whole, name) for name in motions]
    clips = [Motion(clip.rotations[: frames + 2], clip.translation[: frames + 2], clip.fps) for clip in clips]
    return Stage(whole, character, clips)


def _every(stage: Stage, runs: list[Path], folder: Path) -> tuple[dict[str, Way], list[np.ndarray]]:
    """All ways to move one garment, and the solver's own loops."""
    ways = {"skinning": _skinning(stage, folder)}
    for run in runs:
        config = trained.phi(run)[0]
        label = "" if trained.packed(run) else f"{run.name}: "
        network = config.peer.network
        if network in ("ncs", "snug"):
            ways |= {label + name: way for name, way in _peer(stage, run, folder).items()}
            continue
        ways |= {label + name: way for name, way in _psi(stage, run, network or "psi", folder).items()}
        if not network:
            ways |= {label + name: way for name, way in _phi(stage, run).items()}
    solver, solved = _solver(stage)
    return ways | solver, solved


def _skinning(stage: Stage, folder: Path) -> Way:
    whole = stage.whole
    weights, _ = _moving(whole)
    g, path = Graph(), folder / "skinning.onnx"
    rest = np.asarray(stage.character.template, np.float32).T.reshape(1, -1)
    garment = g("Identity", g.constant(rest))
    g("Transpose", g.skinned(garment, "transforms", weights), perm=[0, 2, 1], name="vertices")
    g.save(path, {"transforms": (1, len(weights), 12)}, {"vertices": (1, weights.shape[1], 3)})
    tracks = [skinned_trajectory(whole, stage.character, windows(clip)) for clip in stage.clips]
    return Way("skinning", tracks, bound(path, peers.feed(path)))


def _psi(stage: Stage, run: Path, family: str, folder: Path) -> dict[str, Way]:
    """Psi in ONNX Runtime and in plain C, with all blend shapes and with fewer."""
    betas = np.asarray(stage.character.betas)
    model = inference.load(run, betas=betas)
    count = len(model.network.shapes)
    forms = {f"{family}, as trained": model, f"{family}, specialised": folding.specialise(model)}
    forms |= {
        f"{family}, {name} of the shapes": folding.specialise(model, blendshapes=max(1, int(part * count)))
        for name, part in SHAPES.items()
    }
    library, ways = native.build(folder) if native.compiler() else None, {}
    for name, form in forms.items():
        for int8 in (False, True):
            path = onnx.to_onnx(form, folder / f"{len(ways)}.onnx", int8=int8)
            tracks = [_local(lambda m, p=path, f=form: onnx.run_onnx(p, f, m), clip) for clip in stage.clips]
            ways[f"{name}, int8" if int8 else name] = Way(family, tracks, onnx_call(path, form))
        if library and form is not model:
            path = native.to_c(form, folder / f"{len(ways)}.psi")
            tracks = [_local(lambda m, p=path: native.run_c(library, p, m), clip) for clip in stage.clips]
            ways[f"{name}, C"] = Way(family, tracks, c_call(library, path, form))
    return ways


def _local(run: Callable[[Motion], np.ndarray], clip: Motion) -> np.ndarray:
    """As `evaluate.psi_trajectory`, of what gives vertices [T, V, 3] m of a motion."""
    part = Motion(clip.rotations[1:-1], np.asarray(clip.translation[1:-1]), clip.fps)
    local = part._replace(translation=(part.translation - part.translation[:1]).astype(np.float32))
    return run(local) - local.translation[:, None]


def _phi(stage: Stage, run: Path) -> dict[str, Way]:
    """Phi with more and fewer steps of its descent, in jax."""
    config, model = trained.phi(run)
    if config.model.latent_update != "descent":
        return {"phi": _loop(stage, config, model)}
    varied = {
        n: dataclasses.replace(config, model=dataclasses.replace(config.model, descent_steps=n)) for n in DESCENT_STEPS
    }
    return {f"phi, {n} steps": _loop(stage, each, model) for n, each in varied.items()}


def _loop(stage: Stage, config: Config, model: dict) -> Way:
    """Phi's closed loop in jax, timed as a whole."""
    scene, tracks, us = stage.whole.scene, [], []
    run = jax.jit(lambda m, c, p: rollout.play(m, scene, c, p, config)[1].position)
    for clip in stage.clips:
        poses = windows(clip)
        jax.block_until_ready(run(model, stage.character, poses))  # compiles where the clip is of another length
        began = time.perf_counter()
        tracks.append(np.asarray(run(model, stage.character, poses)))
        us.append(1e6 * (time.perf_counter() - began) / len(tracks[-1]))
    return Way("phi", tracks, None, float(np.median(us)))


def _peer(stage: Stage, run: Path, folder: Path) -> dict[str, Way]:
    """NCS or SNUG's network in ONNX Runtime."""
    whole, character = stage.whole, stage.character
    config, model = trained.phi(run)
    network = config.peer.network
    kept = latent_predictor.kept_joints(whole.names, config.stage2)
    weights, moving = _moving(whole)
    template = np.asarray(character.template)
    made = peers.Peer(network, model["params"], template, weights, ~np.asarray(whole.scene.garment.pinned))
    ways = {}
    constants = latent_predictor.constant_inputs(character.betas, character.material, config.material)

    @jax.jit
    def inputs(poses: Pose):
        def one(window):
            seen = networks.inputs(window, character.joints, constants, whole.scene.body.parents, kept, config)
            moved = skinning.joint_transforms(window.rotations[2], character.joints, whole.scene.body.parents)
            rows = {name: x if name == "dynamic" else x[None] for name, x in seen.items()}
            return rows | {"transforms": moved[moving].reshape(1, -1, 12)}

        return jax.lax.map(one, poses)

    for int8 in (False, True):
        path, tracks = peers.write(folder / f"{network}{int8}.onnx", made, int8=int8), []
        for clip in stage.clips:
            poses = windows(clip)
            seen = {name: np.asarray(x) for name, x in inputs(poses).items()}
            count = len(poses.translation)
            vertices = peers.run(path, [{name: x[t] for name, x in seen.items()} for t in range(count)])
            first = skinned_trajectory(whole, character, jax.tree.map(lambda x: x[:1], poses))
            tracks.append(np.concatenate([first, vertices[:-1]]))
        ways[f"{network}, int8" if int8 else network] = Way(network, tracks, bound(path, peers.feed(path)))
    return ways


def _solver(stage: Stage) -> tuple[dict[str, Way], list[np.ndarray]]:
    """The reference solver, stopped after some iterations; and its loops when it is not."""
    whole, ways, solved = stage.whole, {}, []
    for iterations in ITERATIONS:
        tracks, us = [], []
        for clip in stage.clips:
            poses = windows(clip)
            began = time.perf_counter()
            track, _ = simulation.simulate(whole.scene, stage.character, poses, whole.config, max_iterations=iterations)
            us.append(1e6 * (time.perf_counter() - began) / len(track))
            tracks.append(track[:-1])
        last = iterations == ITERATIONS[-1]
        name = "solver" if last else f"solver, {iterations} iteration{'s' * (iterations > 1)}"
        ways[name] = Way("solver", tracks, None, float(np.median(us)))
        solved = tracks
    return ways, solved


def _errors(stage: Stage, tracks: list[np.ndarray], solved: list[np.ndarray], gaps: int) -> dict[str, float]:
    whole, measures, swings = stage.whole, [], []
    for clip, track, reference in zip(stage.clips, tracks, solved, strict=True):
        poses = windows(clip)
        frames = np.unique(np.linspace(SETTLING, len(track) - 2, gaps).astype(int))
        measures += metrics.step_measures(whole.scene, stage.character, jnp.asarray(track), poses, frames, whole.config)
        skinned = skinned_trajectory(whole, stage.character, poses)
        beside = metrics.beside_solver(whole.scene, *(x[SETTLING:] for x in (track, reference, skinned)))
        ratio, correlation = beside["swing_ratio"], beside["swing_correlation"]
        swings.append(ratio**2 + 1.0 - 2.0 * ratio * correlation)  # of |a - b|^2 / |b|^2
    found = metrics.gaps(measures)
    return {
        "energy_gap": found["energy_gap"],
        "hold_gap": found["hold_gap"],
        "step_error_mm": found["step_error_mm"],
        "swing_error": float(np.sqrt(max(np.mean(swings), 0.0))),
    }


def _moving(whole: Experiment) -> tuple[np.ndarray, np.ndarray]:
    """Skinning weights [J', V] of the joints that move the garment, and their indices."""
    weights = np.asarray(whole.scene.garment.weights, np.float32)
    moving = np.flatnonzero(weights.max(axis=0) > 0)
    return weights[:, moving].T, moving


def plot(report: dict, path: Path) -> None:
    """Each error against time, a row for each garment, with the fronts."""
    points = report["points"]
    garments = list(dict.fromkeys(point["garment"] for point in points))
    size = (5 * len(ERRORS), 4.2 * len(garments))
    figure, axes = plt.subplots(len(garments), len(ERRORS), figsize=size, squeeze=False, constrained_layout=True)
    for row, garment in zip(axes, garments):
        of_it = [point for point in points if point["garment"] == garment]
        for axis, (error, label) in zip(row, ERRORS.items()):
            for family in dict.fromkeys(point["family"] for point in of_it):
                chosen = [point for point in of_it if point["family"] == family]
                where = [p["us"] for p in chosen], [max(p[error], LEAST[error]) for p in chosen]
                axis.loglog(*where, "o", ms=5, label=family, color=COLOURS[family])
            front = sorted((p["us"], max(p[error], LEAST[error])) for p in of_it if p["front"][error])
            axis.step(*zip(*front), color="black", lw=0.8, where="post")
            axis.set(xlabel="us a frame", ylabel=label, title=garment)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(title="Pareto front: line", fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)
