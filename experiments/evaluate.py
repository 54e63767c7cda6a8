"""Measures a run against the reference solver, in closed loop on motions it was not trained on.

    python -m experiments.evaluate runs/quickstart
    python -m experiments.evaluate runs/quickstart --motion walk_3 dance.motion.h5 --json report.json

Three stages are measured: `lbs` (plain skinning), `phi` (stage 1) and `psi` (stage 2). No state is borrowed from the
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
    edge_strain_p95, edge_strain_max          of |l / l_0 - 1|.
    jitter          rms of the second time difference of vertex accelerations, over the solver's own in closed loop.
    psi_phi_mm      mean vertex distance of Psi to Phi, over the first motion played there and back for
                    `evaluation.long_frames` frames of closed loop, from frame 5 on; `_last100` its last hundred.
    finite          no value of that long run was not finite.
    ms_per_frame    of the jitted closed loop, on this machine.

Gaps are taken at `evaluation.gap_frames` frames, spread over each motion; penetration at every fourth frame.
"""

import argparse
import json
import sys
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import character as characters
from clothjax import clips, experiment, inference, metrics, rollout, simulation
from clothjax.character import Character
from clothjax.experiment import Experiment
from clothjax.types import Motion, Pose
from experiments.session import fail_clearly, progress, setup
from experiments.train import load_phi

SETTLING = 5  # frames left out of averages over time: the start is a skinned garment


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--motion", nargs="+", default=None, help="asset names or paths; default: the configured ones")
    parser.add_argument("--json", type=Path, default=None, help="default: RUN/evaluation.json")
    arguments = parser.parse_args(argv)
    report = evaluate(arguments.run, arguments.motion)
    path = arguments.json or arguments.run / "evaluation.json"
    path.write_text(json.dumps(report, indent=1) + "\n")
    print(table(report))
    print(f"written to {path}")


def evaluate(run: Path, motions: list[str] | None = None) -> dict:
    """All measures, under `evaluation.<stage>` (means over motions) and `motions.<name>.<stage>`."""
    whole, phi = load_phi(run)
    config = whole.config
    betas = experiment.betas(config)
    psi = inference.load(run, betas=betas)
    character = jax.jit(lambda b, m: characters.dress(whole.scene, b, m, config.physics))(
        jnp.asarray(betas), experiment.material(config)
    )
    names = list(motions or config.evaluation.motions)
    each = {}
    with progress("evaluating", 4 * len(names) + 1) as report:
        for index, name in enumerate(names):
            clip = experiment.motion(whole, name)
            done = partial(lambda base, n: report(base + n), 4 * index)
            each[Path(name).stem] = _motion(whole, phi, psi, character, betas, clip, done, run, Path(name).stem)
        long_phi, long_psi = _long(whole, phi, psi, character, experiment.motion(whole, names[0]))
        report(4 * len(names) + 1)
    summary = {stage: _mean([one[stage] for one in each.values()]) for stage in ("lbs", "phi", "psi")}
    summary["phi"] |= long_phi
    summary["psi"] |= long_psi
    return {
        "evaluation": summary,
        "motions": each,
        "betas": betas.tolist(),
        "gap_frames": config.evaluation.gap_frames,
        "garment": config.garment,
    }


def _motion(whole: Experiment, phi, psi, character: Character, betas, clip: Motion, done, run: Path, name: str):
    """Measures of the three stages on one clip; keeps its trajectories for pictures."""
    config = whole.config
    poses = windows(clip)
    frames = poses.translation.shape[0]
    tracks = {"lbs": skinned_trajectory(whole, character, poses)}
    tracks["phi"] = phi_trajectory(whole, phi, character, poses)
    tracks["psi"] = psi_trajectory(psi, clip)
    done(1)
    solved, infos = simulation.simulate(
        whole.scene,
        character,
        jax.tree.map(lambda x: x[: min(config.evaluation.solver_frames, frames)], poses),
        config,
    )
    done(2)
    advance = np.asarray(poses.translation[:, 2])
    count = len(solved)
    rough = metrics.roughness(solved[SETTLING:], advance[SETTLING : count - 1])
    sampled = np.unique(np.linspace(SETTLING, frames - 2, config.evaluation.gap_frames).astype(int))
    result = {"solver": {"frames": count, "converged": float(np.mean([info.converged for info in infos]))}}
    for stage, track in tracks.items():
        measured = metrics.gaps(
            metrics.step_measures(
                whole.scene,
                character,
                jnp.asarray(track),
                poses,
                sampled,
                config,
                phi["params"]["garment"]["blendshapes"] if stage == "phi" else None,
            )
        )
        if whole.scene.touchable:
            measured |= metrics.penetrations(
                whole.scene, whole.body, jnp.asarray(betas), track, poses, range(SETTLING, frames, 4), whole.names
            )
        measured |= metrics.edge_strain(whole.scene, character, track[SETTLING:])
        measured |= metrics.beside_solver(whole.scene, *(x[SETTLING:count] for x in (track, solved, tracks["lbs"])))
        measured["jitter"] = metrics.roughness(track[SETTLING:count], advance[SETTLING : count - 1]) / rough
        result[stage] = measured
    done(4)
    np.savez_compressed(
        run / f"trajectories_{name}.npz",
        **{k: np.asarray(v, np.float32) for k, v in tracks.items()},
        solver=solved,
    )
    return result


def _long(whole: Experiment, phi, psi, character: Character, clip: Motion) -> tuple[dict, dict]:
    """Phi, and Psi against Phi, over the long closed loop, with the time of both."""
    clip = experiment.there_and_back(clip, whole.config.evaluation.long_frames + 2)
    poses = windows(clip)
    play = jax.jit(lambda m, p: rollout.play(m, whole.scene, character, p, whole.config)[1].position)
    play = play.lower(phi, poses).compile()
    started = time.perf_counter()
    one = np.asarray(play(phi, poses))
    phi_seconds = time.perf_counter() - started
    other = psi_trajectory(psi, clip)  # compiles
    started = time.perf_counter()
    psi_trajectory(psi, clip)
    seconds = time.perf_counter() - started
    apart = metrics.distance_mm(one, other)
    return {"finite": bool(np.isfinite(one).all()), "ms_per_frame": 1e3 * phi_seconds / len(one)}, {
        "psi_phi_mm": float(apart[SETTLING:].mean()),
        "psi_phi_mm_max": float(apart[SETTLING:].max()),
        "psi_phi_mm_last100": float(apart[-100:].mean()),
        "finite": bool(np.isfinite(other).all()),
        "ms_per_frame": 1e3 * seconds / len(other),
    }


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


def table(report: dict) -> str:
    """The report for a reader, as Markdown."""
    rows = ["| | lbs | phi | psi |", "|---|---|---|---|"]
    stages = report["evaluation"]
    for name in dict.fromkeys(key for stage in ("lbs", "phi", "psi") for key in stages[stage]):
        cells = (_cell(stages[stage].get(name)) for stage in ("lbs", "phi", "psi"))
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _cell(value) -> str:
    return "" if value is None else str(value).lower() if isinstance(value, bool) else f"{value:.4g}"


def _mean(results: list[dict[str, float]]) -> dict[str, float]:
    # a maximum over motions stays a maximum
    return {
        key: float((np.max if "max" in key else np.mean)([result[key] for result in results]))
        for key, value in results[0].items()
        if isinstance(value, float)
    }


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
