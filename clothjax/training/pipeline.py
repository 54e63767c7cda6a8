"""A run from start to end: blend shapes, stage 1, stage 2, fine-tuning. It resumes a run that was stopped.

A stage with a checkpoint at its last step is read, not trained again. A stage with an earlier checkpoint goes on from
it. Any other stage starts anew. The first checkpoint of stage 1 contains the blend shapes and the preconditioner.
"""

import dataclasses
import shutil
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from clothjax import progress
from clothjax.body.motion_clips import Clips
from clothjax.config import Config, EvaluationConfig
from clothjax.files import checkpoint, configuration
from clothjax.material import configured_material
from clothjax.networks import animators, forces
from clothjax.networks.normalisation import ForceScales, Normalizers
from clothjax.networks.psi import constant_inputs, input_joints
from clothjax.progress import progress_bar
from clothjax.simulation import assembly
from clothjax.simulation.assembly import Experiment
from clothjax.training import (
    devices,
    fine_tuning,
    imitation,
    labels,
    laplacian_shapes,
    loop,
    pool,
    preconditioner,
    principal_shapes,
    run_folder,
    stage1,
    stage2,
)

STEPS_PER_CALL = 20
MAY_BE_NONE = ("tuning.steps", "labels.last_steps")  # steps that a run need not take
PHYSICS = ("stage1", "tuning")  # stages in which the physics is the loss
# settings that a stage does not read, so a run may change them and go on; but see `_refuse_other_motions`
MAY_DIFFER = {
    "stage1": ("directory", "evaluation", "stage2", "labels", "tuning"),
    "stage2": ("directory", "evaluation", "tuning"),
    "tuning": ("directory", "evaluation"),
    "baseline": ("directory", "evaluation"),
}


class Run(NamedTuple):
    """Experiment, folder, clips and devices, which every stage of a run's training needs."""

    experiment: Experiment
    directory: Path
    clips: Clips  # those of fine-tuning may begin at other frames
    device_mesh: Mesh | None

    @property
    def config(self) -> Config:
        """Settings of the experiment."""
        return self.experiment.config

    def steps(self, stage: str) -> list[int]:
        """Return the steps of a stage's checkpoints, in order."""
        return checkpoint.steps(self.directory / stage / "checkpoints")


class Psi(NamedTuple):
    """The trained parts of Psi from which fine-tuning starts."""

    garment: dict  # parameters of Phi's decoder with its blend shapes, frozen
    predictor: dict  # parameters of the latent predictor
    normalizers: Normalizers | ForceScales  # scales of its codes and inputs


def run_directory(config: Config, argv: list[str]) -> Path:
    """Return the folder of a run: as configured, else named after its configuration file, else after its garment."""
    name = config.garment if argv[0].startswith("-") else argv[0]
    return Path(config.directory or Path("runs") / Path(name).stem)


def train(config: Config, directory: Path, device_mesh: Mesh | None = None) -> dict[str, float]:
    """Train all stages of a run, or a baseline; return the seconds that its parts took, by name.

    These are `stage1_seconds`, `stage2_seconds`, `tuning_seconds`, `compile_seconds`, `start_seconds` (blend shapes and
    preconditioner) and `teacher_seconds` (rollouts of Phi, or labels).

    Raises:
        ValueError: as `prepare` and `loop.fit`.
        FloatingPointError: if training diverges.
    """
    run = prepare(config, directory, device_mesh)
    if config.peer.network:
        return train_baseline(run)
    first = train_phi(run)
    second, clock = (train_force_psi if config.stage2.forces else train_psi)(run, first)
    clock |= {
        "stage1_seconds": first.seconds,
        "stage2_seconds": second.seconds,
        "compile_seconds": first.compile_seconds + second.compile_seconds,
    }
    if config.tuning.steps > 0:
        psi = Psi(second.state.garment, second.state.average, second.state.normalizers)
        tuned = run._replace(clips=assembly.training_clips(run.experiment, config.tuning)[0])
        third = fine_tune(tuned, first.state.average, psi)
        clock["compile_seconds"] += third.compile_seconds
        clock["tuning_seconds"] = third.seconds
    return clock


def prepare(config: Config, directory: Path, device_mesh: Mesh | None = None) -> Run:
    """Load what a run needs, and check the motions that it will be measured on.

    Raises:
        ValueError: for a file that is missing or wrong, of training or of evaluation, or steps that calls of `update`
            do not make up.
    """
    for name, steps in _all_steps(config).items():
        if steps < 0 or steps % STEPS_PER_CALL:
            raise ValueError(f"{name} must be a multiple of {STEPS_PER_CALL}, got {steps}")
        if steps == 0 and name not in MAY_BE_NONE:
            raise ValueError(f"{name} must be more than 0: what follows needs what it trains")
    if device_mesh is not None:
        progress.say(f"{device_mesh.size} devices, {jax.process_count()} processes; {jax.devices()[0].device_kind}")
    experiment = assembly.assemble(config)
    clips, left_out = assembly.training_clips(experiment)
    if config.tuning.steps > 0:
        assembly.training_clips(experiment, config.tuning)  # what is too short shows now, not after hours
    for name in config.evaluation.motions:
        assembly.evaluation_motion(experiment, name)  # and so does what is wrong
    for name, count in left_out.items():
        if count:
            progress.say(f"{name}: {count} frames left out, a joint moves impossibly fast around them")
    return Run(experiment, directory, clips, device_mesh)


def _all_steps(config: Config) -> dict[str, int]:
    """Return the numbers of training steps that a run will take, by the names of their settings."""
    steps = {"stage1.steps": config.stage1.steps}
    if config.peer.network:
        return steps
    if config.stage2.forces:
        steps |= {"labels.steps": config.labels.steps, "labels.last_steps": config.labels.last_steps}
    else:
        steps |= {"stage2.steps": config.stage2.steps}
    return steps | {"tuning.steps": config.tuning.steps}


def train_phi(run: Run) -> loop.Fitted:
    """Run stage 1: prepare blend shapes and preconditioner, then train Phi on the physics; return it, finished."""
    scene, config = run.experiment.scene, run.config
    began, new = time.monotonic(), not run.steps("stage1")
    simulated = _simulated(run)
    shapes, hessians = (None, None) if jax.process_count() > 1 else (simulated / "shapes", simulated / "hessians")
    for folder in (shapes, hessians) if new else ():
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
    state = stage1.init(scene, run.clips, config, _principal_shapes(run, shapes) if new else None)
    if new and config.model.latent_update == "descent" and config.model.descent_samples > 0:
        model = {"params": state.params, "statistics": state.statistics}
        with progress_bar("preconditioning", config.model.descent_samples) as report:
            inverse = preconditioner.measure(model, scene, run.clips, config, report, run.device_mesh, hessians)
        state = stage1.preconditioned(state, inverse)
    if new:
        _add_seconds(run, start_seconds=time.monotonic() - began)
    progress.say(f"stage 1: Phi on the physics, {config.stage1.steps} steps")
    update = stage1.make_curriculum(scene, run.clips, config, STEPS_PER_CALL, run.device_mesh)
    fitted = _fit(run, "stage1", update, state, config.stage1.steps, f"stage 1, {config.garment}")
    if jax.process_index() == 0:
        for folder in run.directory.glob("simulated_*"):
            shutil.rmtree(folder)
    return fitted


def train_psi(run: Run, phi: loop.Fitted) -> tuple[loop.Fitted, dict[str, float]]:
    """Run stage 2: roll Phi out, then train Psi by regression.

    Args:
        phi: stage 1, finished.

    Returns:
        Stage 2, finished, and the seconds that were not training, by name.

    Raises:
        ValueError: if fine-tuning has begun on another stage 2, or no rollout of Phi stays finite.
    """
    scene, config = run.experiment.scene, run.config
    stage, joints = config.stage2, input_joints(run.experiment.names, config.stage2)
    model = {"params": phi.state.average, "statistics": phi.state.statistics}
    progress.say(f"stage 2: the latent predictor, {stage.steps} steps on {stage.sequences} rollouts of Phi")
    if run.steps("stage2")[-1:] == [stage.steps]:
        # if it cannot be read, training goes on from the one before, and stops as its steps are not finite
        teacher, seconds = stage2.blank(model, scene, run.clips, joints, config), 0.0
    else:
        if run.steps("tuning"):  # it must not be taken for that of the new stage 2
            raise ValueError(f"{run.directory / 'tuning'} belongs to a stage 2 that is no longer there: remove it")
        with progress_bar("rolling out the teacher", stage.sequences) as report:
            teacher, seconds = stage2.teach(model, scene, run.clips, joints, config, report, run.device_mesh)
    garment = jax.device_get(phi.state.average["garment"])
    state = stage2.init(teacher, garment, config, stage2.ordinary_poses(scene, run.clips, joints, config))
    update = stage2.make_update(teacher, config, STEPS_PER_CALL, run.device_mesh)
    fitted = _fit(run, "stage2", update, state, stage.steps, f"stage 2, {config.garment}")
    return fitted, _add_seconds(run, teacher_seconds=seconds)


def train_force_psi(run: Run, phi: loop.Fitted) -> tuple[loop.Fitted, dict[str, float]]:
    """Run stage 2 of a Psi with forces: rounds of labels and of training on all labels so far.

    Also return the seconds of labelling. A round's labels stay in the run's folder; a run that is resumed reads them.

    Raises:
        ValueError: if fine-tuning has begun on another stage 2, or no frame could be labelled.
    """
    experiment, config = run.experiment, run.config
    scene, settings, folder = experiment.scene, config.labels, run.directory / "stage2"
    params = jax.device_get(phi.state.average)
    garment, inverse = params["garment"], params["inverse_hessian"]
    whitening = forces.whitening(inverse)
    betas = np.zeros(scene.body.shapedirs.shape[-1], np.float32)
    constants = constant_inputs(betas, configured_material(config), config.material)
    done = max(run.steps("stage2"), default=0)
    progress.say(f"stage 2: the latent predictor with forces, {settings.rounds} rounds of {settings.steps} steps")
    if run.steps("tuning") and done < settings.all_steps:
        raise ValueError(f"{run.directory / 'tuning'} belongs to a stage 2 that is no longer there: remove it")
    of = run_folder.fingerprint(_read_by("stage2", config), jax.tree.leaves((garment, inverse)))
    collect = labels.make_collect(scene, run.clips, config, run.device_mesh)
    update = imitation.make_update(len(inverse), len(constants), config, STEPS_PER_CALL, run.device_mesh)
    state = imitation.blank(garment, whitening, len(constants), config)
    if done == settings.all_steps and not list(folder.glob("labels_*.npz")):
        fitted = _fit(run, "stage2", partial(_without_labels, folder), state, done, f"stage 2, {config.garment}")
        return fitted, _add_seconds(run, teacher_seconds=0.0)
    fitted, data, scales = loop.Fitted(state, 0.0, 0.0), None, state.normalizers
    simulations = labels.begin(scene, run.clips, config)
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(settings.rounds):
        path, end = folder / f"labels_{number:03}.npz", (number + 1) * settings.steps
        if path.is_file() or done >= end:
            finished = labels.load(path, of, simulations)
        else:
            psi = labels.Policy(fitted.state.average, fitted.state.normalizers, garment, inverse)
            finished = _label(run, collect, psi, simulations, number)
            labels.save(finished, path, of)
        simulations = finished.simulations
        if data is None:
            state = imitation.first(state, finished.labels)
            scales = jax.tree.map(jnp.array, state.normalizers)  # training consumes the state
            data = imitation.room(finished.labels, scales, config)
        data = imitation.extended(data, finished.labels, scales)
        if done <= end:
            progress.say(f"{int(data.count)} frames; hold gap of the newest, median: {finished.labels.gap():.3f}")
            now = partial(update, devices.replicate(data, run.device_mesh))
            fitted = _fit(run, "stage2", now, state, end, f"stage 2, {config.garment}")
            state = fitted.state
    if settings.last_steps > 0:
        assert data is not None  # there is a round
        progress.say(f"stage 2: {settings.last_steps} steps on all frames, by a network drawn anew")
        update = imitation.make_update(len(inverse), len(constants), config, STEPS_PER_CALL, run.device_mesh, last=True)
        now = partial(update, devices.replicate(data, run.device_mesh))
        fitted = _fit(run, "stage2", now, state, settings.all_steps, f"stage 2, {config.garment}")
    return fitted, _add_seconds(run, teacher_seconds=0.0)


def _without_labels(folder: Path, state: imitation.TrainingState):
    """Refuse to go on with stage 2, of which the last checkpoint could not be read and the labels are gone."""
    raise ValueError(f"{folder}: step {int(state.step)} cannot go on without its labels; remove it to begin anew")


def _label(run: Run, collect: Callable, psi: labels.Policy, simulations: pool.Simulation, number: int) -> labels.Round:
    """Label a round of frames, and add the seconds that it takes to those of the run."""
    settings, began = run.config.labels, time.monotonic()
    with progress_bar(f"labelling, round {number + 1} of {settings.rounds}", settings.simulations) as report:
        finished = collect(psi, simulations, settings.seed + number, report)
    _add_seconds(run, teacher_seconds=time.monotonic() - began)
    return finished


def fine_tune(run: Run, phi: dict, psi: Psi) -> loop.Fitted:
    """Run fine-tuning: train Psi on the loss of stage 1, in rollouts of its own.

    Args:
        phi: parameters of Phi, whose inverse Hessian preconditions Psi's gradients.
        psi: after stage 2.
    """
    experiment, config = run.experiment, run.config
    progress.say(f"tuning: the latent predictor on the physics, {config.tuning.steps} steps")
    animator = fine_tuning.animator(experiment, run.clips, phi, psi.garment, psi.normalizers)
    settings = fine_tuning.settings(config)
    update = stage1.make_curriculum(experiment.scene, run.clips, settings, STEPS_PER_CALL, run.device_mesh, animator)
    state = fine_tuning.init(psi.predictor, experiment.scene, run.clips, config)
    return _fit(run, "tuning", update, state, config.tuning.steps, f"tuning, {config.garment}")


def train_baseline(run: Run) -> dict[str, float]:
    """Train a baseline's network on the physics, in the folder of Phi, `stage1/`; return seconds as `train` does."""
    scene, config = run.experiment.scene, run.config
    name, began, new = config.peer.network, time.monotonic(), not run.steps("stage1")
    shapes = _principal_shapes(run) if new and name == "direct" else None
    if shapes is None:
        shapes = laplacian_shapes.laplacian(scene, config)
    if new:
        _add_seconds(run, start_seconds=time.monotonic() - began)
    joints = input_joints(run.experiment.names, config.stage2)
    progress.say(f"{name} on the physics, {config.stage1.steps} steps")
    animator = animators.baseline_animator(joints)
    update = stage1.make_curriculum(scene, run.clips, config, STEPS_PER_CALL, run.device_mesh, animator)
    state = stage1.init_baseline(scene, run.clips, joints, shapes, config)
    fitted = _fit(run, "stage1", update, state, config.stage1.steps, f"{name}, {config.garment}", "baseline")
    return {"stage1_seconds": fitted.seconds, "compile_seconds": fitted.compile_seconds}


def _fit(
    run: Run, stage: str, update: Callable, state: NamedTuple, steps: int, description: str, kind: str | None = None
) -> loop.Fitted:
    """Train a stage in its folder of the run; `kind` is its key in `MAY_DIFFER`, by default its name."""
    _refuse_other_motions(run, stage)
    return loop.fit(
        update,
        devices.replicate(state, run.device_mesh),
        steps=steps,
        steps_per_call=STEPS_PER_CALL,
        directory=run.directory / stage,
        config=configuration.to_dict(run.config),
        description=description,
        may_differ=MAY_DIFFER[kind or stage],
    )


def _refuse_other_motions(run: Run, stage: str) -> None:
    """Raise a ValueError if a stage has begun on other motions: which they are may depend on those held out."""
    if not run.steps(stage):
        return
    folder = run.directory / stage
    stored = checkpoint.latest(folder / "checkpoints").config.get("evaluation", {})
    evaluation = configuration.from_dict(EvaluationConfig, stored, str(folder), stored=True)
    there = assembly.training_motions(dataclasses.replace(run.config, evaluation=evaluation))
    here = assembly.training_motions(run.config)
    if there != here:
        raise ValueError(
            f"{folder} was trained on other motions, as {', '.join(evaluation.motions) or 'none'} were held out there, "
            f"{', '.join(run.config.evaluation.motions) or 'none'} here: use another directory, or set `motions`"
        )


def _simulated(run: Run) -> Path:
    """Return where the simulations before stage 1 are kept: hours of work survive a process that is ended."""
    settings = _read_by("stage1", run.config)
    before = run.directory / f"simulated_{run_folder.fingerprint(settings)}"  # of a run that an older version began
    settings |= {"motions": assembly.training_motions(run.config)}
    return before if before.is_dir() else run.directory / f"simulated_{run_folder.fingerprint(settings)}"


def _read_by(stage: str, config: Config) -> dict:
    """Return the settings that a stage reads."""
    return {name: value for name, value in configuration.to_dict(config).items() if name not in MAY_DIFFER[stage]}


def _principal_shapes(run: Run, folder: Path | None = None) -> np.ndarray | None:
    """Return principal shapes [K, V, 3] m, or None if the configuration asks for smooth ones.

    Args:
        folder: where the simulations are kept.
    """
    sequences = run.config.shapes.sequences
    if sequences == 0:
        return None
    progress.say(f"blend shapes: from {sequences} rollouts of cloth that the physics moves")
    with progress_bar("simulating", sequences) as report:
        frames = principal_shapes.simulate(run.experiment.scene, run.clips, run.config, report, run.device_mesh, folder)
    return principal_shapes.principal(frames, run.experiment.scene, run.config)


def _add_seconds(run: Run, **seconds: float) -> dict[str, float]:
    """Add seconds that were not training to those in the run's folder; return the sums."""
    if jax.process_index() > 0:
        return seconds
    run.directory.mkdir(parents=True, exist_ok=True)
    return run_folder.add_seconds(run.directory, **seconds)
