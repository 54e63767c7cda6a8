"""Measures a run, or garments that come with the library, against the reference solver, in closed loop.

    python -m experiments.evaluate runs/quickstart
    python -m experiments.evaluate runs/quickstart --motion walk_3 dance.motion.h5 --json report.json
    python -m experiments.evaluate --pretrained all --json report.json

Three stages are measured: `lbs` (plain skinning), `phi` (stage 1) and `psi` (stage 2); of a run of a peer's network
`lbs` and that, by its name. No state is borrowed from the
solver: every number is about the stage's own trajectory, with the configured material and the betas of
`evaluation.betas_seed`. Averages are over frames; medians and maxima stand beside them.

    energy_gap      (E - E_min) / (E_skinned - E_min). E is the full incremental potential at unit physical weights
                    given the stage's own two previous frames, E_min the reference solver's minimum from the same two.
                    0 is the solver, 1 plain skinning. The mean is of sums over the frames sampled.
    hold_gap        the same with E_hold for E_skinned: the last canonical displacement kept. 1 is no dynamics at all.
    span_gap        the same with the minimum in the span of the learned blend shapes for E: what Phi lacks for lack of
                    shapes, the rest for lack of training.
    step_error_mm   mean (`_p95`, `_max`) distance of vertices to that minimum.
    penetration_percent, penetration_max_mm   vertices inside the whole body (winding number), and the deepest;
                    `penetration_by_joint`, of each motion: where.
    swing_ratio, swing_correlation            of the velocity of what skinning does not do, beside the solver's in its
                    own closed loop: 1 is as lively; `rollout_error_mm` is the distance to it, `wrinkle_ratio` the rms
                    dihedral angle over its.
    edge_strain_p95, edge_strain_max          of |l / l_0 - 1|; `edge_strain_ratio`, the first over the solver's.
    jitter          rms of the second time difference of vertex accelerations, over the solver's own in closed loop.
    psi_phi_mm      mean vertex distance of Psi to Phi, over the first motion played there and back for
                    `evaluation.long_frames` frames of closed loop, from frame 5 on; `_last100` its last hundred,
                    `_slope` the line fitted to it, in mm per 1 000 frames.
    finite          no value of that long run was not finite.
    ms_per_frame    of the jitted closed loop, on this machine.

Gaps are taken at `evaluation.gap_frames` frames, spread over each motion; penetration at every fourth frame. With
`evaluation.wearers` the gaps of nine other wearers on the first motion stand under `wearers`.

With `--pretrained` the report has the means over garments under `mean`, and the report of each under its name. Of the
validation motions those are used that are there: motion capture does not come with the library.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import character as characters
from clothjax import clips, experiment, inference, latent_predictor, metrics, rollout, simulation, storage, trained
from clothjax.character import Character
from clothjax.config import EvaluationConfig
from clothjax.experiment import Experiment
from clothjax.types import Motion, Pose
from experiments.session import fail_clearly, progress, setup
from experiments.train import load_phi

WEARERS_FRAMES, WEARERS_GAPS = 90, 4  # of the closed loop of each wearer, and where the solver is asked
SETTLING = 5  # frames left out of averages over time: Psi starts from a garment as skinned


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run")
    parser.add_argument("--pretrained", nargs="+", default=None, help="names of shipped garments, or all")
    parser.add_argument("--motion", nargs="+", default=None, help="asset names or paths; default: the configured ones")
    parser.add_argument("--json", type=Path, default=None, help="default: RUN/evaluation.json")
    arguments = parser.parse_args(argv)
    if (arguments.run is None) == (arguments.pretrained is None):
        raise ValueError("give the folder of a run, or --pretrained with names of garments or `all`")
    path = arguments.json or (arguments.run or Path(".")) / "evaluation.json"
    if arguments.json is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    if arguments.pretrained is None:
        report = evaluate(arguments.run, arguments.motion)
        print(table(report["evaluation"]))
    else:
        names = trained.shipped() if arguments.pretrained == ["all"] else tuple(arguments.pretrained)
        report = pretrained({name: trained.folder(name) for name in names}, arguments.motion)
        print(table(report["mean"]))
    path.write_text(json.dumps(report, indent=1) + "\n")
    print(f"written to {path}")


def pretrained(folders: dict[str, Path], motions: list[str] | None = None) -> dict:
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


def kept(run: Path) -> Path:
    """The folder for the trajectories that are measured: the run's own, or one for a garment of the library."""
    return Path("runs") / "pretrained" / run.name if trained.packed(run) else run


def evaluate(run: Path, motions: list[str] | None = None, settings: EvaluationConfig | None = None) -> dict:
    """All measures, under `evaluation.<stage>` (means over motions) and `motions.<name>.<stage>`.

    Args:
        settings: default: those that the run was trained with.
    """
    whole, model = load_phi(run, settings, trained.network)
    kept(run).mkdir(parents=True, exist_ok=True)
    config = whole.config
    betas = experiment.betas(config)
    stages = _stages(whole, model, run)
    character = jax.jit(lambda b, m: characters.dress(whole.scene, b, m, config.physics))(
        jnp.asarray(betas), experiment.material(config)
    )
    names = list(motions or config.evaluation.motions)
    if not names:
        raise ValueError(f"{run}: none of its validation motions is here; name others with --motion")
    garment = None if config.peer.network else model["params"]["garment"]
    each, wearers = {}, {}
    with progress("evaluating", 4 * len(names) + 1) as report:
        for index, name in enumerate(names):
            clip = experiment.evaluation_motion(whole, name)
            done = partial(lambda base, n: report(base + n), 4 * index)
            path = kept(run) / f"trajectories_{Path(name).stem}.npz"
            each[Path(name).stem] = _motion(whole, stages, garment, character, betas, clip, done, path)
        first = experiment.motion(whole, names[0])
        long = _long(whole, stages, character, first)
        if config.evaluation.wearers:
            wearers = _wearers(whole, stages, first)
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
    animator = rollout.peer(latent_predictor.kept_joints(whole.names, config.stage2)) if peer else rollout.phi
    play = jax.jit(lambda m, c, p: rollout.play(m, whole.scene, c, p, config, animator)[1].position)

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
    solved, infos = simulation.simulate(
        whole.scene,
        character,
        jax.tree.map(lambda x: x[: min(config.evaluation.solver_frames, frames)], poses),
        config,
    )
    done(2)
    solved = solved[:frames]  # of a clip shorter than that, the solver's goes one frame further
    advance = np.asarray(poses.translation[:, 2])
    count = len(solved)
    rough = metrics.roughness(solved[SETTLING:], advance[SETTLING : count - 1])
    sampled = np.unique(np.linspace(SETTLING, frames - 2, config.evaluation.gap_frames).astype(int))
    strain = metrics.edge_strain(whole.scene, character, solved[SETTLING:])
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
                whole.scene, whole.body, jnp.asarray(betas), track, poses, range(SETTLING, frames, 4), whole.names
            )
        measured |= metrics.edge_strain(whole.scene, character, track[SETTLING:])
        measured["edge_strain_ratio"] = measured["edge_strain_p95"] / strain["edge_strain_p95"]
        measured |= metrics.beside_solver(whole.scene, *(x[SETTLING:count] for x in (track, solved, tracks["lbs"])))
        measured["jitter"] = metrics.roughness(track[SETTLING:count], advance[SETTLING : count - 1]) / rough
        result[stage] = measured
    done(4)
    np.savez_compressed(
        path,
        **{k: np.asarray(v, np.float32) for k, v in tracks.items()},
        solver=solved,
    )
    return result


def _wearers(whole: Experiment, stages: dict[str, Stage], clip: Motion) -> dict[str, dict]:
    """Gaps of all stages but skinning on nine wearers, over the start of a clip."""
    config = whole.config
    clip = Motion(clip.rotations[:WEARERS_FRAMES], clip.translation[:WEARERS_FRAMES], clip.fps)
    poses = windows(clip)
    sampled = np.linspace(SETTLING, len(clip.translation) - 4, WEARERS_GAPS).astype(int)
    result = {}
    for name, (betas, material) in experiment.wearers(whole).items():
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
    clip = experiment.there_and_back(clip, whole.config.evaluation.long_frames + 2)
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
            "psi_phi_mm": float(apart[SETTLING:].mean()),
            "psi_phi_mm_max": float(apart[SETTLING:].max()),
            "psi_phi_mm_last100": float(apart[-100:].mean()),
            "psi_phi_mm_slope": 1e3 * float(np.polyfit(np.arange(len(apart) - SETTLING), apart[SETTLING:], 1)[0]),
        }
    return found


def windows(clip: Motion) -> Pose:
    """Every window of three poses in a clip, [T - 2, 3, ...]."""
    reel = jax.tree.map(jnp.asarray, experiment.windows(clip))
    return jax.vmap(lambda t: clips.poses(reel, t))(jnp.arange(1, len(clip.translation) - 1))


def skinned_trajectory(whole: Experiment, character: Character, poses: Pose) -> np.ndarray:
    """Plain skinning [T - 2, V, 3] m at the middle frame of each window, relative to its root."""

    def one(pose):
        window = characters.window(whole.scene, character, pose)
        return characters.skinned(character, window.current)

    return np.asarray(jax.jit(lambda p: jax.lax.map(one, p))(poses))


def phi_trajectory(whole: Experiment, phi: dict, character: Character, poses: Pose) -> np.ndarray:
    """Phi in closed loop: [T - 2, V, 3] m likewise."""
    play = jax.jit(lambda m, p: rollout.play(m, whole.scene, character, p, whole.config)[1].position)
    return np.asarray(play(phi, poses))


def psi_trajectory(psi: inference.Model, clip: Motion) -> np.ndarray:
    """Psi in closed loop: [T - 2, V, 3] m at the same frames, relative to the root."""
    part = Motion(clip.rotations[1:-1], np.asarray(clip.translation[1:-1]), clip.fps)
    origin = part.translation[:1]
    local = part._replace(translation=(part.translation - origin).astype(np.float32), rotations=part.rotations)
    vertices, _ = inference.animate(psi, local)
    return np.asarray(vertices) - np.asarray(local.translation)[:, None]


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


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
