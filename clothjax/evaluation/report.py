"""All measures of a run as one nested dictionary, and as Markdown."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import EvaluationConfig
from clothjax.evaluation import metrics, rollouts
from clothjax.evaluation.rollouts import SETTLING_FRAMES, load_run, psi_trajectory, skinned_trajectory, windows
from clothjax.files import storage
from clothjax.material import configured_material
from clothjax.networks import animators
from clothjax.networks.psi import input_joints
from clothjax.progress import progress_bar
from clothjax.runtime import inference, trained
from clothjax.simulation import assembly, characters, reference
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.characters import Character
from clothjax.types import Motion

CHARACTERS_FRAMES, CHARACTERS_GAPS = 90, 4  # of the closed loop of each wearer, and where the solver is asked


def evaluate_packed(folders: dict[str, Path], motions: list[str] | None = None) -> dict:
    """The report of each garment under its name, and under `mean` the means of its stages over garments."""
    if not folders:
        raise ValueError("no garments come with this clothjax; pack some with experiments.ship")
    reports = {}
    for name, folder in folders.items():
        there = motions
        if there is None:
            wanted = trained.network(folder)[0].evaluation.motions
            there = [motion for motion in wanted if storage.asset(motion).is_file()]
            print(f"{name}: on {', '.join(there)}", *(f"({motion} is not here)" for motion in set(wanted) - set(there)))
        reports[name] = evaluate(folder, there)
    stages = next(iter(reports.values()))["evaluation"]
    flat = {name: report.pop("evaluation") | report for name, report in reports.items()}
    return {"mean": {stage: _mean([each[stage] for each in flat.values()]) for stage in stages}} | flat


def output_folder(run: Path) -> Path:
    """The folder for the trajectories that are measured: the run's own, or one for a garment of the library."""
    return Path("runs") / "pretrained" / run.name if trained.packed(run) else run


def evaluate(run: Path, motions: list[str] | None = None, settings: EvaluationConfig | None = None) -> dict:
    """All measures, under `evaluation.<stage>` (means over motions) and `motions.<name>.<stage>`.

    Args:
        settings: default: those that the run was trained with.
    """
    whole, model = load_run(run, settings, trained.network)
    output_folder(run).mkdir(parents=True, exist_ok=True)
    config = whole.config
    betas = assembly.betas(config)
    stages = _stages(whole, model, run)
    character = jax.jit(lambda b, m: characters.dress(whole.scene, b, m, config.physics))(
        jnp.asarray(betas), configured_material(config)
    )
    names = list(motions or config.evaluation.motions)
    if not names:
        raise ValueError(f"{run}: none of its validation motions is here; name others with --motion")
    garment = None if config.peer.network else model["params"]["garment"]
    each, wearers = {}, {}
    with progress_bar("evaluating", 4 * len(names) + 1) as report:
        for index, name in enumerate(names):
            clip = assembly.evaluation_motion(whole, name)
            done = partial(lambda base, n: report(base + n), 4 * index)
            path = output_folder(run) / f"trajectories_{Path(name).stem}.npz"
            each[Path(name).stem] = _motion(whole, stages, garment, character, betas, clip, done, path)
        first = assembly.motion(whole, names[0])
        long = _long(whole, stages, character, first)
        if config.evaluation.wearers:
            wearers = _characters(whole, stages, first)
        report(4 * len(names) + 1)
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


def _stages(whole: Experiment, model: dict, run: Path) -> dict[str, Stage]:
    """What is measured, by name.

    Args:
        model: of `load_phi`.
    """
    config = whole.config
    peer = config.peer.network
    make = animators.baseline_animator(input_joints(whole.names, config.stage2)) if peer else animators.phi_animator
    play = jax.jit(lambda m, c, p: rollouts.states(make, m, whole, c, p))

    def skinned(character: Character, clip: Motion):
        return lambda: skinned_trajectory(whole, character, windows(clip))

    def network(character: Character, clip: Motion):
        poses = windows(clip)
        compiled = play.lower(model, character, poses).compile()
        return lambda: np.asarray(compiled(model, character, poses))

    def psi(character: Character, clip: Motion):
        loaded = inference.load(run, betas=np.asarray(character.betas), material=character.material)
        psi_trajectory(loaded, clip)  # compiles
        return lambda: psi_trajectory(loaded, clip)

    return {"lbs": skinned} | ({peer: network} if peer else {"phi": network, "psi": psi})


def _motion(
    whole: Experiment,
    stages: dict[str, Stage],
    garment: dict | None,
    character: Character,
    betas: np.ndarray,
    clip: Motion,
    done: Callable[[int], None],
    path: Path,
) -> dict:
    """Measures of the stages on one clip; keeps its trajectories for pictures.

    Args:
        garment: Phi's decoder and blend shapes.
    """
    config = whole.config
    poses = windows(clip)
    frames = poses.translation.shape[0]
    tracks = {name: stage(character, clip)() for name, stage in stages.items()}
    done(1)
    solved, infos = reference.simulate(
        whole.scene,
        character,
        jax.tree.map(lambda x: x[: min(config.evaluation.solver_frames, frames)], poses),
        config,
    )
    done(2)
    solved = solved[:frames]  # of a clip shorter than that, the solver's goes one frame further
    advance = np.asarray(poses.translation[:, 2])
    count = len(solved)
    rough = metrics.roughness(solved[SETTLING_FRAMES:], advance[SETTLING_FRAMES : count - 1])
    sampled = np.unique(np.linspace(SETTLING_FRAMES, frames - 2, config.evaluation.gap_frames).astype(int))
    strain = metrics.edge_strain(whole.scene, character, solved[SETTLING_FRAMES:])
    result = {"solver": {"frames": count, "converged": float(np.mean([info.converged for info in infos])), **strain}}
    for stage, track in tracks.items():
        measured = metrics.gaps(
            metrics.step_measures(
                whole.scene,
                character,
                jnp.asarray(track),
                poses,
                sampled,
                config,
                garment["blendshapes"] if stage == "phi" else None,
            )
        )
        if whole.scene.touchable:
            measured |= metrics.penetrations(
                whole.scene,
                whole.body,
                jnp.asarray(betas),
                track,
                poses,
                range(SETTLING_FRAMES, frames, 4),
                whole.names,
            )
        measured |= metrics.edge_strain(whole.scene, character, track[SETTLING_FRAMES:])
        measured["edge_strain_ratio"] = measured["edge_strain_p95"] / strain["edge_strain_p95"]
        measured |= metrics.beside_solver(
            whole.scene, *(x[SETTLING_FRAMES:count] for x in (track, solved, tracks["lbs"]))
        )
        measured["jitter"] = (
            metrics.roughness(track[SETTLING_FRAMES:count], advance[SETTLING_FRAMES : count - 1]) / rough
        )
        result[stage] = measured
    done(4)
    np.savez_compressed(
        path,
        **{k: np.asarray(v, np.float32) for k, v in tracks.items()},
        solver=solved,
    )
    return result


def _characters(whole: Experiment, stages: dict[str, Stage], clip: Motion) -> dict[str, dict]:
    """Gaps of all stages but skinning on nine wearers, over the start of a clip."""
    config = whole.config
    clip = Motion(clip.rotations[:CHARACTERS_FRAMES], clip.translation[:CHARACTERS_FRAMES], clip.fps)
    poses = windows(clip)
    sampled = np.linspace(SETTLING_FRAMES, len(clip.translation) - 4, CHARACTERS_GAPS).astype(int)
    result = {}
    for name, (betas, material) in assembly.wearers(whole).items():
        character = jax.jit(lambda b, m: characters.dress(whole.scene, b, m, config.physics))(betas, material)
        result[name] = {
            stage: metrics.gaps(
                metrics.step_measures(whole.scene, character, make(character, clip)(), poses, sampled, config)
            )
            for stage, make in stages.items()
            if stage != "lbs"
        }
    return result


def _long(whole: Experiment, stages: dict[str, Stage], character: Character, clip: Motion) -> dict[str, dict]:
    """All stages but skinning over the long closed loop, with their times, and Psi against Phi."""
    clip = assembly.there_and_back(clip, whole.config.evaluation.long_frames + 2)
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
