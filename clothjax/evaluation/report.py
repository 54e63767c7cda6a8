"""The measures of a run as one nested dictionary, and as Markdown."""

import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import EvaluationConfig
from clothjax.evaluation import metrics, rollouts
from clothjax.evaluation.rollouts import (
    SETTLING_FRAMES,
    Tracks,
    load_run,
    output_folder,
    psi_trajectory,
    skinned_trajectory,
    windows,
)
from clothjax.files import storage
from clothjax.material import configured_material
from clothjax.networks import animators
from clothjax.networks.psi import input_joints
from clothjax.progress import progress_bar
from clothjax.runtime import inference, trained
from clothjax.simulation import assembly, reference
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.characters import Character
from clothjax.types import Motion

CHARACTERS_FRAMES, CHARACTERS_GAPS = 90, 4  # of the rollout of each character, and where the solver is asked


def evaluate_packed(folders: dict[str, Path], motions: list[str] | None = None) -> dict:
    """The report of each garment under its name, and under `mean` the means of the stages that all have."""
    if not folders:
        raise ValueError("no garments come with this clothjax; train one with `python -m clothjax train`")
    reports = {}
    for name, folder in folders.items():
        there = motions
        if there is None:
            wanted = trained.network(folder)[0].evaluation.motions
            there = [motion for motion in wanted if storage.asset(motion).is_file()]
            print(f"{name}: on {', '.join(there)}", *(f"({motion} is not here)" for motion in set(wanted) - set(there)))
        reports[name] = evaluate(folder, there)
    first, *others = (report["evaluation"] for report in reports.values())
    stages = [stage for stage in first if all(stage in other for other in others)]  # a baseline has others
    flat = {name: report.pop("evaluation") | report for name, report in reports.items()}
    return {"mean": {stage: _mean([each[stage] for each in flat.values()]) for stage in stages}} | flat


def evaluate(run: Path, motions: list[str] | None = None, settings: EvaluationConfig | None = None) -> dict:
    """The measures of a run, under `evaluation.<stage>` (means over motions) and `motions.<name>.<stage>`.

    Args:
        settings: default: those that the run was trained with.
    """
    experiment, model = load_run(run, settings, trained.network)
    output_folder(run).mkdir(parents=True, exist_ok=True)
    config = experiment.config
    betas = assembly.betas(config)
    stages = _stages(experiment, model, run)
    character = assembly.dress(experiment, betas, configured_material(config))
    names = list(motions or config.evaluation.motions)
    if not names:
        raise ValueError(f"{run}: none of its validation motions is here; name others with --motions")
    shapes = None if config.peer.network else model["params"]["garment"]["blendshapes"]
    each, wearers, done = {}, {}, count(1)
    with progress_bar("evaluating", 2 * len(names) + 1) as report:
        for name in names:
            clip = assembly.evaluation_motion(experiment, name)
            tracks, converged = simulate(experiment, stages, character, clip)
            report(next(done))
            each[Path(name).stem] = measure(experiment, character, clip, tracks, converged, shapes)
            tracks.save(run, name)
            report(next(done))
        first = assembly.motion(experiment, names[0])
        long = _long(experiment, stages, character, first)
        if config.evaluation.wearers:
            wearers = _characters(experiment, stages, first)
        report(next(done))
    return {
        "evaluation": {stage: _mean([one[stage] for one in each.values()]) | long.get(stage, {}) for stage in stages},
        "motions": each,
        "wearers": wearers,
        "betas": betas.tolist(),
        "gap_frames": config.evaluation.gap_frames,
        "garment": config.garment,
    }


# a garment's trajectory [T - 2, V, 3] m, relative to the root, by what moves it: compiled for a character and a clip
Stage = Callable[[Character, Motion], Callable[[], np.ndarray]]


def _stages(experiment: Experiment, model: dict, run: Path) -> dict[str, Stage]:
    """The stages that are measured, by name.

    Args:
        model: of `load_run`.
    """
    config = experiment.config
    baseline = config.peer.network
    kept = input_joints(experiment.names, config.stage2)
    make = animators.baseline_animator(kept) if baseline else animators.phi_animator
    play = jax.jit(lambda m, c, p: rollouts.states(make, m, experiment, c, p))

    def skinned(character: Character, clip: Motion):
        return lambda: skinned_trajectory(experiment, character, windows(clip))

    def network(character: Character, clip: Motion):
        poses = windows(clip)
        compiled = play.lower(model, character, poses).compile()
        return lambda: np.asarray(compiled(model, character, poses))

    def psi(character: Character, clip: Motion):
        loaded = inference.load(run, betas=np.asarray(character.betas), material=character.material)
        psi_trajectory(loaded, clip)  # compiles
        return lambda: psi_trajectory(loaded, clip)

    return {"lbs": skinned} | ({baseline: network} if baseline else {"phi": network, "psi": psi})


def simulate(
    experiment: Experiment, stages: dict[str, Stage], character: Character, clip: Motion
) -> tuple[Tracks, float]:
    """The trajectories of the stages and of the reference solver, and the share of the solver's frames that converged.

    The solver has the first `evaluation.solver_frames` frames.
    """
    poses = windows(clip)
    frames = poses.translation.shape[0]
    tracks = {name: stage(character, clip)() for name, stage in stages.items()}
    start = jax.tree.map(lambda x: x[: experiment.config.evaluation.solver_frames], poses)
    solved, infos = reference.simulate(experiment.scene, character, start, experiment.config)
    solved = solved[:frames]  # of a clip shorter than that, the solver's goes one frame further
    return Tracks(tracks, solved), float(np.mean([info.converged for info in infos]))


def measure(
    experiment: Experiment,
    character: Character,
    clip: Motion,
    tracks: Tracks,
    converged: float,
    blendshapes: np.ndarray | None,
) -> dict[str, dict]:
    """The measures of the stages on one clip, by their names, and of the reference solver.

    Args:
        tracks, converged: of `simulate`.
        blendshapes: of Phi, [K, V, 3] m; None where there is no Phi.
    """
    scene, settings = experiment.scene, experiment.config.evaluation
    poses, solved = windows(clip), tracks.solver
    frames, solver_frames = poses.translation.shape[0], len(tracks.solver)
    late, common = slice(SETTLING_FRAMES, None), slice(SETTLING_FRAMES, solver_frames)
    advance = np.asarray(poses.translation[:, 2])[SETTLING_FRAMES : solver_frames - 1]
    roughness = metrics.roughness(solved[late], advance)
    sampled = np.unique(np.linspace(SETTLING_FRAMES, frames - 2, settings.gap_frames).astype(int))
    strain = metrics.edge_strain(scene, character, solved[late])
    result = {"solver": {"frames": solver_frames, "converged": converged, **strain}}
    for stage, track in tracks.stages.items():
        span = blendshapes if stage == "phi" else None
        steps = metrics.step_measures(scene, character, jnp.asarray(track), poses, sampled, experiment.config, span)
        measured = metrics.gaps(steps)
        if scene.touchable:
            body, every_fourth = experiment.body, range(SETTLING_FRAMES, frames, 4)
            measured |= metrics.penetrations(scene, body, character.betas, track, poses, every_fourth, experiment.names)
        measured |= metrics.edge_strain(scene, character, track[late])
        measured["edge_strain_ratio"] = measured["edge_strain_p95"] / strain["edge_strain_p95"]
        measured |= metrics.beside_solver(scene, track[common], solved[common], tracks.stages["lbs"][common])
        measured["jitter"] = metrics.roughness(track[common], advance) / roughness
        result[stage] = measured
    return result


def _characters(experiment: Experiment, stages: dict[str, Stage], clip: Motion) -> dict[str, dict]:
    """Gaps of the stages but skinning on nine characters, over the start of a clip."""
    config = experiment.config
    clip = Motion(clip.rotations[:CHARACTERS_FRAMES], clip.translation[:CHARACTERS_FRAMES], clip.fps)
    poses = windows(clip)
    sampled = np.linspace(SETTLING_FRAMES, len(clip.translation) - 4, CHARACTERS_GAPS).astype(int)
    result = {}
    for name, (betas, material) in assembly.wearers(experiment).items():
        character = assembly.dress(experiment, betas, material)
        result[name] = {
            stage: metrics.gaps(
                metrics.step_measures(experiment.scene, character, make(character, clip)(), poses, sampled, config)
            )
            for stage, make in stages.items()
            if stage != "lbs"
        }
    return result


def _long(experiment: Experiment, stages: dict[str, Stage], character: Character, clip: Motion) -> dict[str, dict]:
    """Measures of the stages but skinning over the long rollout, with their times, and of Psi against Phi."""
    clip = assembly.there_and_back(clip, experiment.config.evaluation.long_frames + 2)
    tracks, found = {}, {}
    for name in stages:
        if name == "lbs":
            continue
        run = stages[name](character, clip)
        started = time.perf_counter()
        track = tracks[name] = run()
        seconds = time.perf_counter() - started
        found[name] = {"finite": bool(np.isfinite(track).all()), "ms_per_frame": 1e3 * seconds / len(track)}
    if "psi" in tracks:
        apart = metrics.distance_mm(tracks["phi"], tracks["psi"])
        found["psi"] |= {
            "psi_phi_mm": float(apart[SETTLING_FRAMES:].mean()),
            "psi_phi_mm_max": float(apart[SETTLING_FRAMES:].max()),
            "psi_phi_mm_last100": float(apart[-100:].mean()),
            "psi_phi_mm_slope": 1e3
            * float(np.polyfit(np.arange(len(apart) - SETTLING_FRAMES), apart[SETTLING_FRAMES:], 1)[0]),
        }
    return found


def table(stages: dict) -> str:
    """The measures of the stages for a reader, as Markdown."""
    rows = [f"| | {' | '.join(stages)} |", "|---" * (len(stages) + 1) + "|"]
    for name in dict.fromkeys(key for measured in stages.values() for key in measured):
        cells = (_cell(measured.get(name)) for measured in stages.values())
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _cell(value) -> str:
    return "" if value is None else str(value).lower() if isinstance(value, bool) else f"{value:.4g}"


def _mean(results: list[dict[str, float]]) -> dict[str, float]:
    # a maximum over motions stays a maximum
    return {
        key: all(r[key] for r in results)
        if isinstance(value, bool)
        else float((np.max if "max" in key else np.mean)([r[key] for r in results]))
        for key, value in results[0].items()
        if isinstance(value, bool | float)
    }
