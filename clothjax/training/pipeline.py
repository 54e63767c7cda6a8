"""A run from start to end: shapes, stage 1, stage 2, fine-tuning; resumes what was stopped."""

import time
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh

from clothjax import progress
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.files import checkpoint, configuration
from clothjax.networks import animators
from clothjax.networks.normalisation import Normalizers
from clothjax.networks.psi import input_joints
from clothjax.progress import progress_bar
from clothjax.simulation import assembly
from clothjax.training import (
    devices,
    fine_tuning,
    laplacian_shapes,
    loop,
    preconditioner,
    principal_shapes,
    run_folder,
    stage1,
    stage2,
)

STEPS_PER_CALL = 20
PHYSICS = ("stage1", "tuning")  # stages in which the physics is the loss


def run_directory(config: Config, argv: list[str]) -> Path:
    """The folder of a run: as configured, or named after its configuration file, or without one after its garment."""
    name = config.garment if argv[0].startswith("-") else argv[0]
    return Path(config.directory or Path("runs") / Path(name).stem)


def train(config: Config, directory: Path, device_mesh: Mesh | None = None) -> dict[str, float]:
    """Both stages and the tuning; returns the seconds each took, those of compilation, teacher and start apart."""
    if device_mesh is not None:
        progress.say(f"{device_mesh.size} devices, {jax.process_count()} processes; {jax.devices()[0].device_kind}")
    whole = assembly.assemble(config)
    reel, bad = assembly.training_clips(whole)
    for name in config.evaluation.motions:
        assembly.evaluation_motion(whole, name)  # a wrong one shows now, not after hours
    for name, count in bad.items():
        if count:
            progress.say(f"{name}: {count} frames left out, a joint moves impossibly fast around them")
    kept = configuration.to_dict(config)

    if config.peer.network:
        return _train_baseline(whole, reel, directory, device_mesh)

    began = time.monotonic()
    new = not checkpoint.steps(directory / "stage1" / "checkpoints")
    shapes = _principal_shapes(whole, reel, device_mesh) if new and config.shapes.sequences > 0 else None
    state = stage1.init(whole.scene, reel, config, shapes)
    if new and config.model.latent_update == "descent" and config.model.descent_samples > 0:
        model = {"params": state.params, "statistics": state.statistics}
        with progress_bar("preconditioning", config.model.descent_samples) as report:
            inverse = preconditioner.measure(model, whole.scene, reel, config, report, device_mesh)
        state = stage1.preconditioned(state, inverse)
    if new:
        _spent(directory, start_seconds=time.monotonic() - began)

    progress.say(f"stage 1: Phi on the physics, {config.stage1.steps} steps")
    first = loop.fit(
        stage1.make_curriculum(whole.scene, reel, config, STEPS_PER_CALL, device_mesh),
        devices.replicate(state, device_mesh),
        steps=config.stage1.steps,
        steps_per_call=STEPS_PER_CALL,
        directory=directory / "stage1",
        config=kept,
        description=f"stage 1, {config.garment}",
        may_differ=DIFFERENT_IN_STAGE1,
    )
    model = {"params": first.state.average, "statistics": first.state.statistics}
    joints = input_joints(whole.names, config.stage2)

    progress.say(
        f"stage 2: the latent predictor, {config.stage2.steps} steps on {config.stage2.sequences} rollouts of Phi"
    )
    if checkpoint.steps(directory / "stage2" / "checkpoints")[-1:] == [config.stage2.steps]:
        # were it not readable, training would go on from the one before, and stop at the first NaN
        teacher, seconds = stage2.blank(model, whole.scene, reel, joints, config), 0.0
    else:
        if checkpoint.steps(directory / "tuning" / "checkpoints"):  # it must not be taken for this one's
            raise ValueError(f"{directory / 'tuning'} belongs to a stage 2 that is no longer there: remove it")
        with progress_bar("rolling out the teacher", config.stage2.sequences) as report:
            teacher, seconds = stage2.teach(model, whole.scene, reel, joints, config, report, device_mesh)
    garment = jax.device_get(first.state.average["garment"])
    begun = stage2.init(teacher, garment, config, stage2.ordinary_poses(whole.scene, reel, joints, config))
    second = loop.fit(
        stage2.make_update(teacher, config, STEPS_PER_CALL, device_mesh),
        devices.replicate(begun, device_mesh),
        steps=config.stage2.steps,
        steps_per_call=STEPS_PER_CALL,
        directory=directory / "stage2",
        config=kept,
        description=f"stage 2, {config.garment}",
        may_differ=("directory", "evaluation", "tuning"),
    )
    clock = {
        **_spent(directory, teacher_seconds=seconds),
        "stage1_seconds": first.seconds,
        "stage2_seconds": second.seconds,
        "compile_seconds": first.compile_seconds + second.compile_seconds,
    }
    if config.tuning.steps > 0:
        psi = second.state
        third = fine_tune(
            whole, reel, model["params"], psi.garment, psi.average, psi.normalizers, directory, device_mesh
        )
        clock["compile_seconds"] += third.compile_seconds
        clock["tuning_seconds"] = third.seconds
    return clock


def _principal_shapes(whole: assembly.Experiment, reel: Clips, device_mesh: Mesh | None) -> np.ndarray:
    sequences = whole.config.shapes.sequences
    progress.say(f"blend shapes: from {sequences} closed loops of cloth that the physics moves")
    with progress_bar("simulating", sequences) as report:
        return principal_shapes.principal(whole.scene, reel, whole.config, report, device_mesh)


def _train_baseline(
    whole: assembly.Experiment, reel: Clips, directory: Path, device_mesh: Mesh | None
) -> dict[str, float]:
    """A peer's network, on the physics from its first step; where Phi would be, in `stage1/`."""
    config, began = whole.config, time.monotonic()
    new = not checkpoint.steps(directory / "stage1" / "checkpoints")
    shapes = laplacian_shapes.laplacian(whole.scene, config)
    if new and config.peer.network == "direct" and config.shapes.sequences > 0:
        shapes = _principal_shapes(whole, reel, device_mesh)
    if new:
        _spent(directory, start_seconds=time.monotonic() - began)
    kept = input_joints(whole.names, config.stage2)
    progress.say(f"{config.peer.network} on the physics, {config.stage1.steps} steps")
    fitted = loop.fit(
        stage1.make_curriculum(
            whole.scene, reel, config, STEPS_PER_CALL, device_mesh, animators.baseline_animator(kept)
        ),
        devices.replicate(stage1.init_peer(whole.scene, reel, kept, shapes, config), device_mesh),
        steps=config.stage1.steps,
        steps_per_call=STEPS_PER_CALL,
        directory=directory / "stage1",
        config=configuration.to_dict(config),
        description=f"{config.peer.network}, {config.garment}",
        may_differ=("directory", "evaluation"),
    )
    return {"stage1_seconds": fitted.seconds, "compile_seconds": fitted.compile_seconds}


def fine_tune(
    whole: assembly.Experiment,
    reel: Clips,
    phi: dict,
    garment: dict,
    predictor: dict,
    normalizers: Normalizers,
    directory: Path,
    device_mesh: Mesh | None = None,
) -> loop.Fitted:
    """Psi after its regression, tuned on the gradients of the energies, with the preconditioner of its Phi.

    Args:
        phi: parameters; garment: its decoder and blend shapes.
        directory: of the run.
    """
    config = whole.config
    progress.say(f"tuning: the latent predictor on the physics, {config.tuning.steps} steps")
    kept = input_joints(whole.names, config.stage2)
    psi = animators.psi_animator(
        garment, normalizers, kept, fine_tuning.preconditioners(whole, reel, phi, normalizers, kept)
    )
    return loop.fit(
        stage1.make_curriculum(whole.scene, reel, fine_tuning.settings(config), STEPS_PER_CALL, device_mesh, psi),
        devices.replicate(fine_tuning.init(predictor, whole.scene, reel, config), device_mesh),
        steps=config.tuning.steps,
        steps_per_call=STEPS_PER_CALL,
        directory=directory / "tuning",
        config=configuration.to_dict(config),
        description=f"tuning, {config.garment}",
        may_differ=("directory", "evaluation"),
    )


def _spent(directory: Path, **seconds: float) -> dict[str, float]:
    """Keeps the time of what is not training, in the run's folder."""
    if jax.process_index() > 0:
        return seconds
    directory.mkdir(parents=True, exist_ok=True)
    return run_folder.add_seconds(directory, **seconds)


# stage 1 does not read these, so a run may change them and go on
DIFFERENT_IN_STAGE1 = ("directory", "evaluation", "stage2", "tuning")
