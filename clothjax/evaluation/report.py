"""The measures of a run as one nested dictionary, and as Markdown."""

import json
import time
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import Config, EvaluationConfig
from clothjax.evaluation import metrics, rollouts
from clothjax.evaluation.parts import Kept, Part, measure_all
from clothjax.evaluation.rollouts import (
    SETTLING_FRAMES,
    Tracks,
    load_run,
    output_folder,
    psi_trajectory,
    skinned_trajectory,
    windows,
)
from clothjax.files import configuration, damage
from clothjax.material import configured_material
from clothjax.networks import animators
from clothjax.networks.psi import input_joints
from clothjax.physics import kernels
from clothjax.physics.energies import GRAVITY
from clothjax.progress import progress_bar
from clothjax.runtime import loading, trained
from clothjax.simulation import assembly, reference
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.characters import Character
from clothjax.training import run_folder
from clothjax.types import Motion

EVALUATION = "evaluation.json"  # the report in a run's folder
MEASURED = "measured.json"  # parts of an evaluation that was stopped
CHARACTERS_FRAMES, CHARACTERS_GAPS = 90, 4  # of the rollout of each character, and where the solver is asked
PUSHES = {  # accelerations beside gravity, m/s^2, and the frames in which they push
    "none": ((0.0, 0.0, 0.0), (0, None)),
    "no gravity": ((0.0, GRAVITY, 0.0), (0, None)),
    "sideways": ((GRAVITY, GRAVITY, 0.0), (0, None)),
    "gust": ((12.0, 0.0, 0.0), (30, 45)),
}


def evaluate_packed(
    folders: dict[str, Path], motions: list[str] | None = None, jobs: int = 1, methods: list[str] | None = None
) -> dict:
    """Evaluate several models: a report under each name, and under `mean` the means of the methods that all have.

    Args:
        folders: of the models, by name.
        motions: asset names or paths; default: those that each model was to be validated on, as far as they are here.
        jobs, methods: as of `evaluate`.

    Raises:
        ValueError: if there is no model, or no motion for one; and as `evaluate`.
    """
    if not folders:
        raise ValueError("no garments come with this clothjax; train one with `python -m clothjax train`")
    reports = {}
    for name, folder in folders.items():
        present = motions
        if present is None:
            wanted = trained.configured(folder).evaluation.motions
            present = assembly.present(wanted)
            absent = set(wanted) - set(present)
            print(f"{name}: on {', '.join(present) or 'no motion'}", *(f"({motion} is not here)" for motion in absent))
        reports[name] = _evaluated(folder, present, None, jobs, methods)
    first, *others = (report["evaluation"] for report in reports.values())
    shared = [method for method in first if all(method in other for other in others)]  # a baseline has others
    flat = {name: report.pop("evaluation") | report for name, report in reports.items()}
    mean = {method: _mean([each[method] for each in flat.values()]) for method in shared}
    for folder in folders.values():  # not before nothing can go wrong any more
        _forget(folder)
    return {"mean": mean} | flat


def evaluate(
    run: Path,
    motions: list[str] | None = None,
    settings: EvaluationConfig | None = None,
    jobs: int = 1,
    methods: list[str] | None = None,
) -> dict:
    """Measure every method of a run: `lbs`, `phi` and `psi`, or `lbs` and a baseline.

    Results are in `evaluation.<method>` (means over motions) and `motions.<name>.<method>`. Each part is kept as it is
    measured: an evaluation that was stopped goes on where it was.

    Args:
        motions: asset names or paths; default: those of `settings`.
        settings: default: those that the run was trained with.
        jobs: processes that measure at once, each a motion, the long rollout, a wearer or a push.
        methods: those to measure; of the others, trajectories and measures are those of the last evaluation of the same
            networks. Default: all.

    Raises:
        ValueError: if there is no motion to measure on, or what was kept is not readable; or if some methods are to be
            measured that there are not, or beside others that were not.
    """
    report = _evaluated(run, motions, settings, jobs, methods)
    _forget(run)
    return report


def _evaluated(
    run: Path, motions: list[str] | None, settings: EvaluationConfig | None, jobs: int, methods: list[str] | None
) -> dict:
    """Do what `evaluate` does, and keep the parts."""
    measured = Measured.load(run, settings, methods)
    output_folder(run).mkdir(parents=True, exist_ok=True)
    config = measured.experiment.config
    names = list(config.evaluation.motions if motions is None else motions)
    if not names:
        raise ValueError(f"{run}: none of its validation motions is here; name others with --motions")
    if len({Path(name).stem for name in names}) < len(names):
        raise ValueError(f"{run}: two motions would have one name in the report: {', '.join(names)}; rename one")
    for name in names:
        assembly.evaluation_motion(measured.experiment, name)  # a wrong one shows now, not after an hour
    before = {} if measured.wanted is None else _before(run, names, config)
    wearers = assembly.wearers(measured.experiment) if config.evaluation.wearers else ()
    frames = len(_start(measured.experiment, names[0]).translation) - 2
    pushable = config.stage2.forces and (methods is None or "psi" in methods)
    pushes = [push for push in PUSHES if pushable and _pushed_steps(push, frames)]
    in_motion = {name: Part(measure_motion, (name,)) for name in names}
    over_long = Part(measure_long, (names[0],))
    worn = {wearer: Part(measure_wearer, (names[0], wearer)) for wearer in wearers}
    pushed = {push: Part(measure_push, (names[0], push)) for push in pushes}
    parts = [*in_motion.values(), *worn.values(), over_long, *pushed.values()]  # what takes longest first
    with progress_bar("evaluating", len(parts)) as report:
        kept = Kept(_parts_file(run), _fingerprint(measured))
        found = measure_all(parts, measured, partial(Measured.load, run, settings, methods), kept, jobs, report)
    earlier = [before.get(group, {}) for group in ("motions", "wearers")]
    by_motion = {Path(name).stem: earlier[0].get(Path(name).stem, {}) | found[part] for name, part in in_motion.items()}
    long = found[over_long]
    return {
        "evaluation": {
            method: _mean([one[method] for one in by_motion.values()]) | long.get(method, {})
            for method in measured.methods
        },
        "motions": by_motion,
        "wearers": {wearer: earlier[1].get(wearer, {}) | found[part] for wearer, part in worn.items()},
        "pushed": {push: found[part] for push, part in pushed.items()} or before.get("pushed", {}),
        "betas": assembly.betas(config).tolist(),
        "gap_frames": config.evaluation.gap_frames,
        "garment": config.garment,
    }


# a method to measure: for a character and a clip it compiles a function that returns the garment's trajectory
# [T - 2, V, 3] m, relative to the root
Method = Callable[[Character, Motion], Callable[[], np.ndarray]]


class Measured(NamedTuple):
    """What is measured: a run, its experiment and character, and its methods by name."""

    run: Path
    experiment: Experiment
    character: Character
    methods: dict[str, Method]
    blendshapes: np.ndarray | None  # of Phi, [K, V, 3] m; None where there is no Phi
    fingerprint: int  # of its networks, of `rollouts.fingerprint`
    wanted: tuple[str, ...] | None = None  # methods to measure; the others were measured before. None: all

    @classmethod
    def load(cls, run: Path, settings: EvaluationConfig | None = None, methods: list[str] | None = None) -> "Measured":
        """Load what `evaluate` measures; arguments as there."""
        experiment, model = load_run(run, settings, trained.network)
        config = experiment.config
        character = assembly.dress(experiment, assembly.betas(config), configured_material(config))
        shapes = None if config.peer.network else model["params"]["garment"]["blendshapes"]
        known, wanted = _methods(experiment, model, run), None if methods is None else tuple(methods)
        if wrong := set(wanted or ()).difference(known):
            raise ValueError(f"{run}: no method {', '.join(sorted(wrong))}; there are {', '.join(known)}")
        return cls(run, experiment, character, known, shapes, rollouts.fingerprint(run), wanted)


def _before(run: Path, motions: list[str], config: Config) -> dict:
    """Return the report of a run or a packed model that was measured before, on all of some motions.

    Args:
        config: with the settings of now, which must be those of then.

    Raises:
        ValueError: if there is none.
    """
    path, advice = run / (trained.REPORT if trained.packed(run) else EVALUATION), "measure all methods first"
    try:
        report = json.loads(path.read_text())
        lacking = [name for name in motions if Path(name).stem not in report["motions"]]
        same = report["gap_frames"] == config.evaluation.gap_frames
        same = same and np.allclose(report["betas"], assembly.betas(config), atol=1e-6)
    except damage.UNREADABLE as error:
        raise ValueError(f"{path}: not a report of an evaluation ({error}); {advice}") from error
    if lacking:
        raise ValueError(f"{path}: does not have {', '.join(lacking)}; {advice}")
    if not same:
        raise ValueError(f"{path}: of other gap_frames or betas; {advice}")
    return report


def _parts_file(run: Path) -> Path:
    return output_folder(run) / MEASURED


def _forget(run: Path) -> None:
    """Remove the parts that an evaluation kept, which is over: the next one measures anew."""
    _parts_file(run).unlink(missing_ok=True)


def _fingerprint(measured: Measured) -> int:
    """Return a number that tells evaluations of other models, or with other settings, apart."""
    settings = configuration.to_dict(measured.experiment.config)
    return run_folder.fingerprint(settings | {"networks": measured.fingerprint, "methods": measured.wanted})


def measure_motion(measured: Measured, name: str) -> dict[str, dict]:
    """Measure the methods on one motion, by name, and save their trajectories."""
    run, experiment, character, methods, shapes, _, wanted = measured
    clip = assembly.evaluation_motion(experiment, name)
    if wanted is None:
        tracks, converged = simulate(experiment, methods, character, clip)
    else:
        tracks, converged = Tracks.load(run, name), None
        anew = {method: methods[method](character, clip)() for method in wanted}
        tracks = tracks._replace(methods=tracks.methods | anew)
    tracks.save(run, name, measured.fingerprint)
    return measure(experiment, character, clip, tracks, converged, shapes, wanted)


def _methods(experiment: Experiment, model: dict, run: Path) -> dict[str, Method]:
    """Return the methods to measure, by name, of what `load_run` gave."""
    config = experiment.config
    baseline = config.peer.network
    joints = input_joints(experiment.names, config.stage2)
    make = animators.baseline_animator(joints) if baseline else animators.phi_animator
    play = jax.jit(kernels.in_kernels(lambda m, c, p: rollouts.states(make, m, experiment, c, p)))
    programs: dict[tuple, Callable] = {}

    def skinned(character: Character, clip: Motion):
        return lambda: skinned_trajectory(experiment, character, windows(clip))

    def network(character: Character, clip: Motion):
        given = model, character, windows(clip)
        kinds = tuple(map(jax.typeof, jax.tree.leaves(given)))
        if kinds not in programs:
            programs[kinds] = play.lower(*given).compile()
        return lambda: np.asarray(programs[kinds](*given))

    def psi(character: Character, clip: Motion):
        loaded = loading.load(run, betas=np.asarray(character.betas), material=character.material)
        psi_trajectory(loaded, clip)  # compiles
        return lambda: psi_trajectory(loaded, clip)

    return {"lbs": skinned} | ({baseline: network} if baseline else {"phi": network, "psi": psi})


def simulate(
    experiment: Experiment, methods: dict[str, Method], character: Character, clip: Motion
) -> tuple[Tracks, float]:
    """Roll out every method, and the reference solver over the first `evaluation.solver_frames` frames.

    Args:
        methods: the methods, by name.

    Returns:
        The trajectories, and the share of the solver's frames that converged.
    """
    poses = windows(clip)
    frames = poses.translation.shape[0]
    tracks = {name: method(character, clip)() for name, method in methods.items()}
    start = jax.tree.map(lambda x: x[: experiment.config.evaluation.solver_frames], poses)
    solved, infos = reference.simulate(experiment.scene, character, start, experiment.config)
    solved = solved[:frames]  # of a shorter clip, the solver simulates one frame more
    return Tracks(tracks, solved), float(np.mean([info.converged for info in infos]))


def measure(
    experiment: Experiment,
    character: Character,
    clip: Motion,
    tracks: Tracks,
    converged: float | None,
    blendshapes: np.ndarray | None,
    wanted: Collection[str] | None = None,
) -> dict[str, dict]:
    """Measure the methods on one clip, by name, and under `solver` the reference solver.

    Args:
        tracks, converged: of `simulate`. Without the latter, the solver is not measured.
        blendshapes: of Phi, [K, V, 3] m; None where there is no Phi.
        wanted: the methods to measure; default: all.
    """
    scene, settings = experiment.scene, experiment.config.evaluation
    poses, solved = windows(clip), tracks.solver
    frames, solver_frames = poses.translation.shape[0], len(tracks.solver)
    late, common = slice(SETTLING_FRAMES, None), slice(SETTLING_FRAMES, solver_frames)
    advance = np.asarray(poses.translation[:, 2])[SETTLING_FRAMES : solver_frames - 1]
    roughness = metrics.roughness(solved[late], advance)
    sampled = np.unique(np.linspace(SETTLING_FRAMES, frames - 2, settings.gap_frames).astype(int))
    strain = metrics.edge_strain(scene, character, solved[late])
    solver = {"frames": solver_frames, "converged": converged, **strain}
    result = {} if converged is None else {"solver": solver}
    for method in tracks.methods if wanted is None else wanted:
        track = tracks.methods[method]
        span = blendshapes if method == "phi" else None
        steps = metrics.step_measures(scene, character, jnp.asarray(track), poses, sampled, experiment.config, span)
        measured = metrics.gaps(steps)
        if scene.touchable:
            body, every_fourth = experiment.body, range(SETTLING_FRAMES, frames, 4)
            measured |= metrics.penetrations(body, character.betas, track, poses, every_fourth, experiment.names)
        measured |= metrics.edge_strain(scene, character, track[late])
        then = metrics.edge_strain(scene, character, track[common])
        measured["edge_strain_ratio"] = then["edge_strain_p95"] / strain["edge_strain_p95"]
        measured |= metrics.beside_solver(scene, track[common], solved[common], tracks.methods["lbs"][common])
        measured["jitter"] = metrics.roughness(track[common], advance) / roughness
        result[method] = measured
    return result


def measure_wearer(measured: Measured, name: str, wearer: str) -> dict[str, dict]:
    """Measure the gaps of all methods but skinning on one of nine characters, over the start of a motion."""
    experiment, methods, wanted = measured.experiment, measured.methods, measured.wanted
    config, clip = experiment.config, _start(experiment, name)
    poses = windows(clip)
    sampled = np.linspace(SETTLING_FRAMES, len(clip.translation) - 4, CHARACTERS_GAPS).astype(int)
    character = assembly.dress(experiment, *assembly.wearers(experiment)[wearer])
    return {
        method: metrics.gaps(
            metrics.step_measures(experiment.scene, character, make(character, clip)(), poses, sampled, config)
        )
        for method, make in methods.items()
        if method != "lbs" and (wanted is None or method in wanted)
    }


def measure_push(measured: Measured, name: str, push: str) -> dict[str, float]:
    """Measure the gaps of a Psi with forces under an acceleration beside gravity, over the start of a motion."""
    run, experiment, character, *_ = measured
    config, clip = experiment.config, _start(experiment, name)
    poses, (acceleration, lasting) = windows(clip), PUSHES[push]
    count = poses.translation.shape[0]
    psi = loading.load(run, betas=np.asarray(character.betas), material=character.material)
    external = np.zeros((count, 3), np.float32)
    external[slice(*lasting)] = acceleration
    pushed = _pushed_steps(push, count)
    sampled = np.unique(np.linspace(pushed[0], pushed[-1], 2 * CHARACTERS_GAPS).astype(int))
    track = psi_trajectory(psi, clip, jnp.asarray(external))
    steps = metrics.step_measures(
        experiment.scene, character, jnp.asarray(track), poses, sampled, config, external=external
    )
    return metrics.gaps(steps)


def _start(experiment: Experiment, name: str) -> Motion:
    """Return the start of a motion, on which characters and pushes are measured."""
    clip = assembly.evaluation_motion(experiment, name)
    return Motion(clip.rotations[:CHARACTERS_FRAMES], clip.translation[:CHARACTERS_FRAMES], clip.fps)


def _pushed_steps(push: str, frames: int) -> range:
    """Return the steps of a rollout of `frames` frames in which it is pushed; none if it ends before."""
    begin, end = PUSHES[push][1]
    return range(max(begin - 1, SETTLING_FRAMES), min(end or frames, frames) - 1)


def measure_long(measured: Measured, name: str) -> dict[str, dict]:
    """Measure all methods but skinning over the long rollout on a motion, with their times, and Psi against Phi."""
    experiment, character, methods = measured.experiment, measured.character, measured.methods
    clip = assembly.motion(experiment, name)
    clip = assembly.there_and_back(clip, experiment.config.evaluation.long_frames + 2)
    tracks, result = {}, {}
    for name in methods:
        if name == "lbs":
            continue
        run = methods[name](character, clip)
        started = time.perf_counter()
        track = tracks[name] = run()
        seconds = time.perf_counter() - started
        result[name] = {"finite": bool(np.isfinite(track).all()), "ms_per_frame": 1e3 * seconds / len(track)}
    if "psi" in tracks:
        apart = metrics.distance_mm(tracks["phi"], tracks["psi"])
        result["psi"] |= {
            "psi_phi_mm": float(apart[SETTLING_FRAMES:].mean()),
            "psi_phi_mm_max": float(apart[SETTLING_FRAMES:].max()),
            "psi_phi_mm_last100": float(apart[-100:].mean()),
            "psi_phi_mm_slope": 1e3
            * float(np.polyfit(np.arange(len(apart) - SETTLING_FRAMES), apart[SETTLING_FRAMES:], 1)[0]),
        }
    return result


def table(methods: dict) -> str:
    """Format measures as a Markdown table: a row for each measure, a column for each method."""
    rows = [f"| | {' | '.join(methods)} |", "|---" * (len(methods) + 1) + "|"]
    for name in dict.fromkeys(key for measured in methods.values() for key in measured):
        cells = (_cell(measured.get(name)) for measured in methods.values())
        rows.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _cell(value) -> str:
    return "" if value is None else str(value).lower() if isinstance(value, bool) else f"{value:.4g}"


def _mean(results: list[dict[str, float]]) -> dict[str, float]:
    """Return means of the measures that all results have: without a body, there is nothing to be inside."""
    # a maximum over motions stays a maximum
    return {
        key: all(r[key] for r in results)
        if isinstance(value, bool)
        else float((np.max if "max" in key else np.mean)([r[key] for r in results]))
        for key, value in results[0].items()
        if isinstance(value, bool | float) and all(key in r for r in results)
    }
