"""Error against time of all that can move a garment: Psi and Phi in their variants, peers, the solver, skinning."""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from scipy.stats import kendalltau

from clothjax import character as characters
from clothjax import (
    experiment,
    folding,
    inference,
    latent_predictor,
    metrics,
    rollout,
    simulation,
    skinning,
    storage,
    trained,
)
from clothjax import peers as networks
from clothjax.character import Character
from clothjax.config import Config
from clothjax.experiment import Experiment
from clothjax.export import native, onnx
from clothjax.export.onnx_graph import Graph
from clothjax.types import Motion, Pose
from experiments.benchmarks import peers, position_based
from experiments.benchmarks.inference import bound, c_call, given_features, interleaved, onnx_call, session_call
from experiments.benchmarks.position_based import Xpbd
from experiments.benchmarks.timing import Call
from experiments.evaluate import SETTLING, skinned_trajectory, windows
from experiments.session import progress
from experiments.train import load_phi

matplotlib.use("Agg")
import matplotlib.pyplot as plt

DESCENT_STEPS = (1, 4, 16, 32)  # of Phi
ITERATIONS = (1, 2, 4, 8, 500)  # of the solver, of which the last is until it has converged
XPBD = ((16, 4), (32, 2), (64, 1))  # substeps, iterations of each; with fewer of both it is not stable
SHAPES = {"a half": 1 / 2, "a quarter": 1 / 4, "an eighth": 1 / 8}  # of the blend shapes
USABLE = 1.1  # errors of NCS in a smaller form, over those of the form that was trained
ALIKE = ("body", "fps", "physics", "material", "motions")  # of the configurations of what is compared
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


class Variant(NamedTuple):
    """Something that moves a garment."""

    family: str  # of COLOURS
    runtime: str  # of MARKERS
    tracks: list[np.ndarray]  # closed loops [T - 2, V, 3] m over each of the clips, relative to the root
    call: Call | None  # one frame of it, to be timed beside the others
    us: float = 0.0  # a frame of the loop, where there is no `call`
    converged: float = 1.0  # share of a solver's frames


class Case(NamedTuple):
    """What the variants of a garment have in common."""

    whole: Experiment
    character: Character
    clips: list[Motion]


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
    """Points of all runs, and what wins where a garment has runs of NCS beside runs of Psi.

    Args:
        runs: folders of runs and of packed models; those of one garment are compared with each other.
        frames: of each motion; gaps: of them, at how many the solver is asked.
        motions: default: those on which all runs of a garment are evaluated.
        descent_steps: of Phi; iterations: of the solver, of which the last is until it has converged.
        shapes: names of the forms of Psi and of peers with fewer blend shapes, and the part of them that they have.

    Raises:
        ValueError: if runs of a garment differ in body, physics, cloth or motions.
    """
    garments: dict[str, list[Path]] = {}
    for run in dict.fromkeys(runs):
        garments.setdefault(trained.network(run)[0].garment, []).append(run)
    cases = [_case(of_it, motions, frames) for of_it in garments.values()]
    points = []
    with progress("garments", len(garments)) as report, tempfile.TemporaryDirectory() as folder:
        for index, (case, (garment, of_it)) in enumerate(zip(cases, garments.items())):
            variants, solved = _every(case, of_it, Path(folder), descent_steps, iterations, shapes)
            us = interleaved({key: each.call for key, each in variants.items() if each.call}, rounds)
            for key, each in variants.items():
                found = {"name": key[1], "run": _short(key[0]), "family": each.family, "garment": garment}
                found |= {"runtime": each.runtime, "us": us.get(key, each.us), "converged": each.converged}
                points.append(found | _errors(case, each.tracks, solved, gaps))
            report(index + 1)
    for point in points:
        others = [p for p in points if p["garment"] == point["garment"]]
        point["front"] = {error: not any(_better(other, point, error) for other in others) for error in ERRORS}
    return {"points": points} | wins(points)


def _short(run: str) -> str:
    """A run as it is called on every machine: a garment of the library by its name."""
    return Path(run).name if run and trained.packed(run) else run


def wins(points: list[dict]) -> dict:
    """Garments that have both, on which Psi beats NCS: in every error at no more time than NCS takes, and in time at
    no more of any error.

    Both are in ONNX Runtime, and in forms of the same kinds: as trained, with fewer blend shapes, in eight bits. NCS is
    taken in the fastest whose errors are at most USABLE times those of the form that was trained. Of several runs
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
        whole = theirs["ncs"]
        if not all(np.isfinite(whole[error]) for error in ERRORS):
            raise ValueError(f"the errors of NCS on {garment} are not finite: its training diverged; train it again")
        usable = [p for p in theirs.values() if all(p[error] <= USABLE * whole[error] for error in ERRORS)]
        fastest = min(usable, key=lambda p: p["us"])
        in_time = [p for p in ours.values() if p["us"] <= fastest["us"]]
        if any(all(p[error] < fastest[error] for error in ERRORS) for p in in_time):
            won["wins_at_equal_time"].append(garment)
        as_good = [p for p in ours.values() if all(p[error] <= fastest[error] for error in ERRORS)]
        if any(p["us"] < fastest["us"] for p in as_good):
            won["wins_at_equal_error"].append(garment)
    return won


def _medians(points: list[dict]) -> dict[str, dict[str, float]]:
    """Time and errors of each form, by name, over the runs that have it."""
    names = dict.fromkeys(p["name"] for p in points)
    return {
        name: {key: float(np.median([p[key] for p in points if p["name"] == name])) for key in ("us", *ERRORS)}
        for name in names
    }


def rank_tau(points: list[dict], others: list[dict]) -> dict[str, float | None]:
    """Of so many `points` that two reports have in common, Kendall's tau of their order by time and by each error."""
    named = {(p["garment"], p["run"], p["name"]): p for p in others}
    pairs = [(p, named[key]) for p in points if (key := (p["garment"], p["run"], p["name"])) in named]
    found = {"points": len(pairs)}
    for key in ("us", *ERRORS):
        tau = float(kendalltau([one[key] for one, _ in pairs], [other[key] for _, other in pairs]).statistic)
        found[key] = tau if np.isfinite(tau) else None  # all alike have no order
    return found


def _better(one: dict, other: dict, error: str) -> bool:
    """Whether a point is no worse in time and error, and better in one."""
    no_worse = one["us"] <= other["us"] and one[error] <= other[error]
    return no_worse and (one["us"], one[error]) != (other["us"], other[error])


def _case(runs: list[Path], motions: tuple[str, ...], frames: int) -> Case:
    """What runs of a garment have in common: the wearer and the motions of the first one's evaluation."""
    configs = [trained.network(run)[0] for run in runs]
    first = configs[0]
    wearers = [(c.stage1.betas, c.evaluation.betas, c.evaluation.betas_seed) for c in configs]
    for run, config, wearer in zip(runs, configs, wearers):
        differing = [name for name in ALIKE if getattr(config, name) != getattr(first, name)]
        differing += ["betas"] * (wearer != wearers[0])
        if differing:
            raise ValueError(
                f"{run}: trained with another {' and '.join(differing)} than {runs[0]}: what is compared on a garment "
                "has to be trained for the same"
            )
    shared = [name for name in first.evaluation.motions if all(name in c.evaluation.motions for c in configs)]
    names = motions or [name for name in shared if storage.asset(name).is_file()]
    if not names:
        raise ValueError(f"{', '.join(map(str, runs))}: no motion is held out by all of them")
    whole, _ = load_phi(runs[0], None, trained.network)
    character = jax.jit(lambda b, m: characters.dress(whole.scene, b, m, first.physics))(
        jnp.asarray(experiment.betas(first)), experiment.material(first)
    )
    clips = [experiment.motion(whole, name) for name in names]
    clips = [Motion(clip.rotations[: frames + 2], clip.translation[: frames + 2], clip.fps) for clip in clips]
    return Case(whole, character, clips)


def _every(
    case: Case,
    runs: list[Path],
    folder: Path,
    descent_steps: tuple[int, ...],
    iterations: tuple[int, ...],
    shapes: dict[str, float],
) -> tuple[dict[tuple[str, str], Variant], list[np.ndarray]]:
    """All variants of one garment by run and name, and the solver's own loops."""
    variants = {("", "skinning"): _skinning(case, folder)}
    for run in runs:
        network = trained.network(run)[0].peer.network
        if network in ("ncs", "snug"):
            found = _peer(case, run, folder, shapes)
        else:
            found = _psi(case, run, network or "psi", folder, shapes)
            found |= {} if network else _phi(case, run, descent_steps)
        variants |= {(str(run), name): each for name, each in found.items()}
    solver, solved = _solver(case, iterations)
    others = solver | _position_based(case, [track[0] for track in solved])
    return variants | {("", name): each for name, each in others.items()}, solved


def _skinning(case: Case, folder: Path) -> Variant:
    whole = case.whole
    weights, _ = _moving(whole)
    g, path = Graph(), folder / "skinning.onnx"
    rest = np.asarray(case.character.template, np.float32).T.reshape(1, -1)
    garment = g("Identity", g.constant(rest))
    g("Transpose", g.skinned(garment, "transforms", weights), perm=[0, 2, 1], name="vertices")
    g.save(path, {"transforms": (1, len(weights), 12)}, {"vertices": (1, weights.shape[1], 3)})
    tracks = [skinned_trajectory(whole, case.character, windows(clip)) for clip in case.clips]
    return Variant("skinning", "onnx", tracks, bound(path, peers.feed(path)))


def _psi(case: Case, run: Path, family: str, folder: Path, shapes: dict[str, float]) -> dict[str, Variant]:
    """Psi in ONNX Runtime and in plain C, with all blend shapes and with fewer.

    In ONNX Runtime it is timed as peers are, with pose inputs and skinning transforms given; and, as in C, from the
    pose, which no peer does.
    """
    folder = Path(tempfile.mkdtemp(dir=folder))
    model = inference.load(run, betas=np.asarray(case.character.betas))
    count = len(model.network.shapes)
    forms = {family: folding.specialise(model)}
    forms |= {
        f"{family}, {name} of the shapes": folding.specialise(model, blendshapes=max(1, int(part * count)))
        for name, part in shapes.items()
    }
    library, variants = native.build(folder) if native.compiler() else None, {}
    for name, form in forms.items():
        for int8 in (False, True):
            path = onnx.to_onnx(form, folder / f"{len(variants)}.onnx", int8=int8)
            tracks = [_local(lambda m, p=path, f=form: onnx.run_onnx(p, f, m), clip) for clip in case.clips]
            label = f"{name}, int8" if int8 else name
            spared = given_features(form, folder / "spared.onnx", int8=int8)
            variants[label] = Variant(family, "onnx", tracks, session_call(spared))
            variants[f"{label}, from the pose"] = Variant(family, "onnx", tracks, onnx_call(path, form))
        if library:
            path = native.to_c(form, folder / f"{len(variants)}.psi")
            tracks = [_local(lambda m, p=path: native.run_c(library, p, m), clip) for clip in case.clips]
            variants[f"{name}, C"] = Variant(family, "c", tracks, c_call(library, path, form))
    return variants


def _local(run: Callable[[Motion], np.ndarray], clip: Motion) -> np.ndarray:
    """As `evaluate.psi_trajectory`, of what gives vertices [T, V, 3] m of a motion."""
    part = Motion(clip.rotations[1:-1], np.asarray(clip.translation[1:-1]), clip.fps)
    local = part._replace(translation=(part.translation - part.translation[:1]).astype(np.float32))
    return run(local) - local.translation[:, None]


def _phi(case: Case, run: Path, descent_steps: tuple[int, ...]) -> dict[str, Variant]:
    """Phi with more and fewer steps of its descent, in jax."""
    config, model = trained.phi(run)
    case = case._replace(whole=experiment.assemble(config))  # with the graph that it was trained on
    if config.model.latent_update != "descent":
        return {"phi": _loop(case, config, model)}
    varied = {
        n: dataclasses.replace(config, model=dataclasses.replace(config.model, descent_steps=n)) for n in descent_steps
    }
    return {f"phi, {n} steps": _loop(case, each, model) for n, each in varied.items()}


def _loop(case: Case, config: Config, model: dict) -> Variant:
    """Phi's closed loop in jax, timed as a whole."""
    scene, tracks, us = case.whole.scene, [], []
    run = jax.jit(lambda m, c, p: rollout.play(m, scene, c, p, config)[1].position)
    for clip in case.clips:
        poses = windows(clip)
        jax.block_until_ready(run(model, case.character, poses))  # compiles where the clip is of another length
        began = time.perf_counter()
        tracks.append(np.asarray(run(model, case.character, poses)))
        us.append(1e6 * (time.perf_counter() - began) / len(tracks[-1]))
    return Variant("phi", "jax", tracks, None, float(np.median(us)))


def _peer(case: Case, run: Path, folder: Path, shapes: dict[str, float]) -> dict[str, Variant]:
    """NCS or SNUG's network in ONNX Runtime, with all shapes and with fewer."""
    folder = Path(tempfile.mkdtemp(dir=folder))
    whole, character = case.whole, case.character
    config, model = trained.network(run)
    network = config.peer.network
    kept = latent_predictor.kept_joints(whole.names, config.stage2)
    weights, moving = _moving(whole)
    free = ~np.asarray(whole.scene.garment.pinned)
    peer = peers.made(network, model["params"], np.asarray(character.template), weights, free)
    constants = latent_predictor.constant_inputs(character.betas, character.material, config.material)

    @jax.jit
    def inputs(poses: Pose):
        def one(window):
            seen = networks.inputs(window, character.joints, constants, whole.scene.body.parents, kept, config)
            moved = skinning.joint_transforms(window.rotations[2], character.joints, whole.scene.body.parents)
            rows = {name: x if name == "dynamic" else x[None] for name, x in seen.items()}
            return rows | {"transforms": moved[moving].reshape(1, -1, 12)}

        return jax.lax.map(one, poses)

    def frames(clip: Motion) -> list[dict[str, np.ndarray]]:
        seen = {name: np.asarray(x) for name, x in inputs(windows(clip)).items()}
        return [{name: x[t] for name, x in seen.items()} for t in range(len(clip.translation) - 2)]

    coding = peers.write(folder / "codes.onnx", peer, whole=False)
    try:
        usual = [experiment.motion(whole, name) for name in folding.CLIPS]
    except ValueError:  # for another body
        usual = case.clips
    codes = np.concatenate([peers.run(coding, frames(clip)) for clip in usual])
    forms = {network: peer}
    forms |= {
        f"{network}, {name} of the shapes": peers.fewer(peer, codes, max(1, int(part * codes.shape[1])))
        for name, part in shapes.items()
    }
    variants, seen = {}, [frames(clip) for clip in case.clips]
    first = [skinned_trajectory(whole, character, jax.tree.map(lambda x: x[:1], windows(c))) for c in case.clips]
    for name, form in forms.items():
        for int8 in (False, True):
            path = peers.write(folder / f"{len(variants)}.onnx", form, int8=int8)
            tracks = [np.concatenate([start, peers.run(path, of)[:-1]]) for start, of in zip(first, seen)]
            label = f"{name}, int8" if int8 else name
            variants[label] = Variant(network, "onnx", tracks, bound(path, peers.feed(path)))
    return variants


def _solver(case: Case, limits: tuple[int, ...]) -> tuple[dict[str, Variant], list[np.ndarray]]:
    """The reference solver, stopped after some iterations; and its loops when it is not."""
    whole, variants, solved = case.whole, {}, []
    for iterations in limits:
        tracks, us, converged = [], [], []
        for clip in case.clips:
            clock = [time.perf_counter()]
            track, infos = simulation.simulate(
                whole.scene,
                case.character,
                windows(clip),
                whole.config,
                max_iterations=iterations,
                progress=lambda _, ticks=clock: ticks.append(time.perf_counter()),
            )
            us.append(1e6 * np.median(np.diff(clock)))  # the first frame compiles
            tracks.append(track[:-1])
            converged += [bool(info.converged) for info in infos]
        last = iterations == limits[-1]
        name = "solver" if last else f"solver, {iterations} iteration{'s' * (iterations > 1)}"
        variants[name] = Variant("solver", "jax", tracks, None, float(np.median(us)), float(np.mean(converged)))
        solved = tracks
    return variants, solved


def _position_based(case: Case, starts: list[np.ndarray]) -> dict[str, Variant]:
    """XPBD, from where the solver starts; nothing where Newton is not installed."""
    variants, whole = {}, case.whole
    for substeps, iterations in XPBD:
        try:
            engine = Xpbd(whole, case.character, substeps, iterations)
        except ImportError as error:
            print(f"no points of XPBD: {error}")
            return {}
        loops = [
            position_based.simulate(engine, whole, case.character, windows(clip), start)
            for clip, start in zip(case.clips, starts, strict=True)
        ]
        tracks, us = zip(*loops)
        name = f"xpbd, {substeps} substeps of {iterations} iteration{'s' * (iterations > 1)}"
        variants[name] = Variant("xpbd", "warp", list(tracks), None, float(np.median(us)))
    return variants


def _errors(case: Case, tracks: list[np.ndarray], solved: list[np.ndarray], gaps: int) -> dict[str, float]:
    whole, measures, swings = case.whole, [], []
    for clip, track, reference in zip(case.clips, tracks, solved, strict=True):
        poses = windows(clip)
        frames = np.unique(np.linspace(SETTLING, len(track) - 2, gaps).astype(int))
        measures += metrics.step_measures(whole.scene, case.character, jnp.asarray(track), poses, frames, whole.config)
        skinned = skinned_trajectory(whole, case.character, poses)
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


def plot(report: dict, path: Path | BinaryIO) -> None:
    """Each error against time, a row for each garment, with the fronts.

    What is beyond the plot's ends is drawn at them.
    """
    points = report["points"]
    garments = list(dict.fromkeys(point["garment"] for point in points))
    size = (5 * len(ERRORS), 4.2 * len(garments))
    figure, axes = plt.subplots(len(garments), len(ERRORS), figsize=size, squeeze=False, constrained_layout=True)
    for row, garment in zip(axes, garments):
        of_it = [point for point in points if point["garment"] == garment]
        for axis, (error, label) in zip(row, ERRORS.items()):
            for family, runtime in dict.fromkeys((point["family"], point["runtime"]) for point in of_it):
                chosen = [point for point in of_it if (point["family"], point["runtime"]) == (family, runtime)]
                where = [p["us"] for p in chosen], np.clip([p[error] for p in chosen], LEAST[error], MOST[error])
                style = {"ms": 5, "alpha": 0.8, "color": COLOURS[family], "label": f"{family} ({runtime})"}
                axis.loglog(*where, MARKERS[runtime], **style)
            front = sorted((p["us"], max(p[error], LEAST[error])) for p in of_it if p["front"][error])
            axis.step(*zip(*front), color="black", lw=0.8, where="post")
            axis.set(xlabel="us a frame", ylabel=label, title=garment)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].legend(title="Pareto front: line", fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)
