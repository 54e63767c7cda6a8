"""Rollouts by every method that moves a garment: variants of Psi and Phi, baselines, the solver, XPBD, skinning."""

import dataclasses
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from clothjax import material
from clothjax.body import skinning
from clothjax.config import Config
from clothjax.evaluation import rollouts
from clothjax.evaluation.rollouts import relative, skinned_trajectory, windows
from clothjax.export import native, onnx
from clothjax.export.onnx_graph import Graph
from clothjax.networks import psi
from clothjax.networks.animators import phi_animator
from clothjax.networks.baselines import inputs as baseline_inputs
from clothjax.physics import compilers
from clothjax.runtime import loading, specialise, trained
from clothjax.runtime.models import ForcePredictor
from clothjax.simulation import assembly, reference
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.characters import Character
from clothjax.types import Motion, Pose
from experiments.benchmark import baselines, position_based
from experiments.benchmark.inference import bound, c_call, given_features, onnx_call, session_call
from experiments.benchmark.position_based import Xpbd
from experiments.benchmark.timing import Call

DESCENT_STEPS = (1, 4, 16, 32)  # of Phi
ITERATIONS = (1, 2, 4, 8, 500)  # of the solver, of which the last is until it has converged
XPBD = ((16, 4), (32, 2), (64, 1))  # substeps, iterations of each; with fewer of both it is not stable
SHAPES = {"a half": 1 / 2, "a quarter": 1 / 4, "an eighth": 1 / 8}  # of the blend shapes
ALIKE = ("body", "fps", "physics", "material", "motions")  # of the configurations of what is compared


class Variant(NamedTuple):
    """A method that moves a garment, with its rollouts."""

    family: str  # such as psi, ncs or solver
    runtime: str  # onnx, c, jax or warp
    tracks: list[np.ndarray]  # rollouts [T - 2, V, 3] m over each of the clips, relative to the root
    call: Call | None  # one frame of it, to be timed beside the others
    us: float = 0.0  # a frame of the loop, where there is no `call`
    converged: float = 1.0  # share of a solver's frames


class Case(NamedTuple):
    """The experiment, character and motions that the variants of a garment share."""

    experiment: Experiment
    character: Character
    clips: list[Motion]


def prepare(runs: list[Path], motions: tuple[str, ...], frames: int) -> Case:
    """Prepare the case of a garment's runs: the character and the motions of the first run's evaluation."""
    configs = [trained.configured(run) for run in runs]
    first = configs[0]
    wearers = [(c.stage1.betas, c.evaluation.betas, c.evaluation.betas_seed) for c in configs]
    for run, config, wearer in zip(runs, configs, wearers, strict=True):
        differing = [name for name in ALIKE if getattr(config, name) != getattr(first, name)]
        differing += ["betas"] * (wearer != wearers[0])
        if differing:
            raise ValueError(
                f"{run}: trained with another {' and '.join(differing)} than {runs[0]}: what is compared on a garment "
                "has to be trained for the same"
            )
    shared = [name for name in first.evaluation.motions if all(name in c.evaluation.motions for c in configs)]
    names = motions or assembly.present(shared)
    if not names:
        raise ValueError(f"{', '.join(map(str, runs))}: no motion is held out by all of them")
    experiment = assembly.assemble(first)
    character = assembly.dress(experiment, assembly.betas(first), material.configured_material(first))
    clips = [assembly.motion(experiment, name) for name in names]
    clips = [Motion(clip.rotations[: frames + 2], clip.translation[: frames + 2], clip.fps) for clip in clips]
    return Case(experiment, character, clips)


def every(
    case: Case,
    runs: list[Path],
    folder: Path,
    descent_steps: tuple[int, ...],
    iterations: tuple[int, ...],
    shapes: dict[str, float],
) -> tuple[dict[tuple[str, str], Variant], list[np.ndarray]]:
    """Return the variants of one garment by run and name, and the solver's own loops."""
    variants = {("", "skinning"): _skinning(case, folder)}
    for run in runs:
        network = trained.configured(run).peer.network
        if network in ("ncs", "snug"):
            of_run = _baseline(case, run, folder, shapes)
        else:
            of_run = _psi(case, run, network or "psi", folder, shapes)
            of_run |= {} if network else _phi(case, run, descent_steps)
        variants |= {(str(run), name): each for name, each in of_run.items()}
    solver, solved = _solver(case, iterations)
    others = solver | _position_based(case, [track[0] for track in solved])
    return variants | {("", name): each for name, each in others.items()}, solved


def _skinning(case: Case, folder: Path) -> Variant:
    experiment = case.experiment
    weights, _ = _moving(experiment)
    g, path = Graph(), folder / "skinning.onnx"
    rest = np.asarray(case.character.template, np.float32).T.reshape(1, -1)
    garment = g("Identity", g.constant(rest))
    g("Transpose", g.skinned(garment, "transforms", weights), perm=[0, 2, 1], name="vertices")
    g.save(path, {"transforms": (1, len(weights), 12)}, {"vertices": (1, weights.shape[1], 3)})
    tracks = [skinned_trajectory(experiment, case.character, windows(clip)) for clip in case.clips]
    return Variant("skinning", "onnx", tracks, bound(path, baselines.feed(path)))


def _psi(case: Case, run: Path, family: str, folder: Path, shapes: dict[str, float]) -> dict[str, Variant]:
    """Return Psi in ONNX Runtime and in plain C, with all blend shapes and with fewer.

    In ONNX Runtime one without forces is timed twice: with pose inputs and skinning transforms given, like a baseline,
    and from the pose, like in C.
    """
    folder = Path(tempfile.mkdtemp(dir=folder))
    model = loading.load(run, betas=np.asarray(case.character.betas))
    count = len(model.network.shapes)
    forms = {family: specialise.specialise(model)}
    forms |= {
        f"{family}, {name} of the shapes": specialise.specialise(model, blendshapes=max(1, int(part * count)))
        for name, part in shapes.items()
    }
    library, variants = native.build(folder) if compilers.compiler("C") else None, {}
    for name, form in forms.items():
        for int8 in (False, True):
            path = onnx.to_onnx(form, folder / f"{len(variants)}.onnx", int8=int8)
            tracks = [relative(lambda m, p=path, f=form: onnx.run_onnx(p, f, m), clip) for clip in case.clips]
            label = f"{name}, int8" if int8 else name
            from_pose = Variant(family, "onnx", tracks, onnx_call(path, form))
            if isinstance(form.network.predictor, ForcePredictor):
                variants[label] = from_pose
            else:
                spared = session_call(given_features(form, folder / "spared.onnx", int8=int8))
                variants |= {label: from_pose._replace(call=spared), f"{label}, from the pose": from_pose}
        if library:
            path = native.to_c(form, folder / f"{len(variants)}.psi")
            tracks = [relative(lambda m, p=path: native.run_c(library, p, m), clip) for clip in case.clips]
            variants[f"{name}, C"] = Variant(family, "c", tracks, c_call(library, path, form))
    return variants


def _phi(case: Case, run: Path, descent_steps: tuple[int, ...]) -> dict[str, Variant]:
    """Return Phi with more and fewer steps of its descent, in jax."""
    config, model = trained.phi(run)
    case = case._replace(experiment=assembly.assemble(config))  # with the graph that it was trained on
    if config.model.latent_update != "descent":
        return {"phi": _loop(case, config, model)}
    varied = {
        n: dataclasses.replace(config, model=dataclasses.replace(config.model, descent_steps=n)) for n in descent_steps
    }
    return {f"phi, {n} steps": _loop(case, each, model) for n, each in varied.items()}


def _loop(case: Case, config: Config, model: dict) -> Variant:
    """Return Phi's rollout in jax, timed in one piece."""
    experiment, tracks, us = case.experiment._replace(config=config), [], []
    run = jax.jit(lambda m, c, p: rollouts.states(phi_animator, m, experiment, c, p))
    for clip in case.clips:
        poses = windows(clip)
        jax.block_until_ready(run(model, case.character, poses))  # compiles where the clip is of another length
        began = time.perf_counter()
        tracks.append(np.asarray(run(model, case.character, poses)))
        us.append(1e6 * (time.perf_counter() - began) / len(tracks[-1]))
    return Variant("phi", "jax", tracks, None, float(np.median(us)))


def _baseline(case: Case, run: Path, folder: Path, shapes: dict[str, float]) -> dict[str, Variant]:
    """Return NCS or SNUG's network in ONNX Runtime, with all shapes and with fewer."""
    folder = Path(tempfile.mkdtemp(dir=folder))
    experiment, character = case.experiment, case.character
    config, model = trained.network(run)
    network = config.peer.network
    input_joints = psi.input_joints(experiment.names, config.stage2)
    weights, moving = _moving(experiment)
    free = ~np.asarray(experiment.scene.garment.pinned)
    baseline = baselines.assemble(network, model["params"], np.asarray(character.template), weights, free)
    constants = psi.constant_inputs(character.betas, character.material, config.material)

    @jax.jit
    def inputs(poses: Pose):
        def one(window):
            seen = baseline_inputs(
                window, character.joints, constants, experiment.scene.body.parents, input_joints, config
            )
            moved = skinning.joint_transforms(window.rotations[2], character.joints, experiment.scene.body.parents)
            rows = {name: x if name == "dynamic" else x[None] for name, x in seen.items()}
            return rows | {"transforms": moved[moving].reshape(1, -1, 12)}

        return jax.lax.map(one, poses)

    def frames(clip: Motion) -> list[dict[str, np.ndarray]]:
        seen = {name: np.asarray(x) for name, x in inputs(windows(clip)).items()}
        return [{name: x[t] for name, x in seen.items()} for t in range(len(clip.translation) - 2)]

    coding = baselines.write(folder / "codes.onnx", baseline, skinned=False)
    try:
        usual = [assembly.motion(experiment, name) for name in specialise.CALIBRATION_CLIPS]
    except ValueError:  # for another body
        usual = case.clips
    codes = np.concatenate([baselines.run(coding, frames(clip)) for clip in usual])
    forms = {network: baseline}
    forms |= {
        f"{network}, {name} of the shapes": baselines.fewer(baseline, codes, max(1, int(part * codes.shape[1])))
        for name, part in shapes.items()
    }
    variants, seen = {}, [frames(clip) for clip in case.clips]
    first = [skinned_trajectory(experiment, character, jax.tree.map(lambda x: x[:1], windows(c))) for c in case.clips]
    for name, form in forms.items():
        for int8 in (False, True):
            path = baselines.write(folder / f"{len(variants)}.onnx", form, int8=int8)
            tracks = [
                np.concatenate([start, baselines.run(path, of)[:-1]]) for start, of in zip(first, seen, strict=True)
            ]
            label = f"{name}, int8" if int8 else name
            variants[label] = Variant(network, "onnx", tracks, bound(path, baselines.feed(path)))
    return variants


def _solver(case: Case, limits: tuple[int, ...]) -> tuple[dict[str, Variant], list[np.ndarray]]:
    """Return the reference solver stopped after some iterations, and its complete loops."""
    experiment, variants, solved = case.experiment, {}, []
    for iterations in limits:
        tracks, us, converged = [], [], []
        for clip in case.clips:
            clock = [time.perf_counter()]
            track, infos = reference.simulate(
                experiment.scene,
                case.character,
                windows(clip),
                experiment.config,
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
    """Return XPBD from the solver's start; nothing if Newton is not installed."""
    variants, experiment = {}, case.experiment
    for substeps, iterations in XPBD:
        try:
            engine = Xpbd(experiment, case.character, substeps, iterations)
        except ImportError as error:
            print(f"no points of XPBD: {error}")
            return {}
        loops = [
            position_based.simulate(engine, experiment, case.character, windows(clip), start)
            for clip, start in zip(case.clips, starts, strict=True)
        ]
        tracks, us = zip(*loops, strict=True)
        name = f"xpbd, {substeps} substeps of {iterations} iteration{'s' * (iterations > 1)}"
        variants[name] = Variant("xpbd", "warp", list(tracks), None, float(np.median(us)))
    return variants


def _moving(experiment: Experiment) -> tuple[np.ndarray, np.ndarray]:
    """Return skinning weights [J', V] of the joints that move the garment, and their indices."""
    weights = np.asarray(experiment.scene.garment.weights, np.float32)
    moving = np.flatnonzero(weights.max(axis=0) > 0)
    return weights[:, moving].T, moving
