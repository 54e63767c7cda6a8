"""Repeat the steps of a training that diverged, one at a time, and describe the first bad one.

    python -m experiments.replay runs/mine                   # its last stage
    python -m experiments.replay runs/mine --stage stage1
    python -m experiments.replay runs/mine --allowed 0       # the first step that was skipped, though training went on

It starts from the last good checkpoint and goes on until training would stop. It names the terms that are not finite,
and the clip, frame, betas and material of each simulation in the batch. The state before that step is saved in
`RUN/<stage>/diverged/`, where the next replay starts. Nothing else of the run is touched. Steps are compiled one by one
here, and twenty together in training: a run at the edge of diverging may not do so again.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import numpy as np

from clothjax import cli
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.files import checkpoint, configuration
from clothjax.networks import animators, psi
from clothjax.progress import progress_bar
from clothjax.runtime import trained
from clothjax.simulation import assembly
from clothjax.training import fine_tuning, laplacian_shapes, loop, pool, stage1
from clothjax.training.pipeline import PHYSICS


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.replay", __doc__)
    cli.model_argument(parser, about="; it must have checkpoints")
    parser.add_argument("--stage", choices=PHYSICS, default=None, help="default: the last one begun")
    parser.add_argument("--steps", type=int, default=2000, help="at the most; default 2000")
    parser.add_argument(
        "--allowed",
        type=int,
        default=loop.MAX_NONFINITE,
        help="skipped steps in a row to put up with; default: as training",
    )
    arguments = parser.parse_args(argv)
    run = trained.find(arguments.model)
    begun = [stage for stage in PHYSICS if checkpoint.steps(run / stage / "checkpoints")]
    if not begun or (arguments.stage and arguments.stage not in begun):
        raise ValueError(f"{run}: has no checkpoint of {arguments.stage or ' or '.join(PHYSICS)} to start from")
    print(replay(run, arguments.stage or begun[-1], arguments.steps, arguments.allowed))


def replay(run: Path, stage: str, steps: int, allowed: int) -> str:
    """Describe the first step of the run of non-finite steps, more than `allowed`, that stopped training.

    Raises:
        ValueError: if the stage has finished.
    """
    start, source = _start(run / stage)
    config = configuration.from_dict(Config, source.config, str(start), stored=True)
    total = getattr(config, stage).steps
    if source.step >= total:
        raise ValueError(f"{start}: {stage} has taken all of its {total} steps: it did not diverge")
    experiment = assembly.assemble(config)
    clips, _ = assembly.training_clips(experiment, getattr(config, stage))
    update, starting, state = _again(run, stage, experiment, clips)
    state, _ = checkpoint.restore(start, state)
    print(f"from step {source.step} of {start}", flush=True)
    end, skipped = min(source.step + steps, total), 0
    with progress_bar("replaying", end - source.step) as report:
        for step in range(source.step, end):
            before = jax.device_get(state)
            state, metrics = update(state)
            metrics = {name: np.asarray(values) for name, values in metrics.items()}
            if not skipped:
                first = step, before, metrics
            try:
                skipped = loop.check_finite(metrics, step, skipped, allowed)
            except FloatingPointError as error:
                step, before, metrics = first
                folder = run / stage / "diverged" / str(step)
                if not folder.is_dir():
                    checkpoint.save(folder.parent, step, before, source.config)
                return f"{error}\n{_description(step, metrics, starting(before), experiment)}\nkept: {folder}"
            report(step + 1 - source.step)
    return f"steps {source.step + 1} to {end} of {total} do not diverge; --steps takes more of them"


def _start(folder: Path) -> tuple[Path, checkpoint.Checkpoint]:
    """Return the checkpoint to start from: one that an earlier replay saved, if it is later and of this training."""
    regular, diverged = folder / "checkpoints", folder / "diverged"
    latest = checkpoint.latest(regular)
    if checkpoint.steps(diverged):
        saved = checkpoint.latest(diverged)
        if saved.step >= latest.step and saved.config == latest.config:
            return diverged, saved
    return regular, latest


def _again(
    run: Path, stage: str, experiment: assembly.Experiment, clips: Clips
) -> tuple[Callable, Callable, stage1.TrainingState]:
    """Return the training step of a stage, the function that finds the simulations of a step, and a state."""
    config = experiment.config
    if stage == "tuning":
        student = trained.psi(run)
        phi = trained.phi(run)[1]["params"]
        animator = fine_tuning.animator(experiment, clips, phi, student.garment, student.normalizers)
        config = fine_tuning.settings(config)
        state = fine_tuning.init(student.predictor, experiment.scene, clips, experiment.config)
    elif config.peer.network:
        input_joints = psi.input_joints(experiment.names, config.stage2)
        animator = animators.baseline_animator(input_joints)
        state = stage1.init_baseline(
            experiment.scene, clips, input_joints, laplacian_shapes.laplacian(experiment.scene, config), config
        )
    else:
        animator, state = animators.phi_animator, stage1.init(experiment.scene, clips, config)

    @partial(jax.jit, static_argnums=2)
    def starting(state: stage1.TrainingState, clips: Clips, frames: int):
        return pool.next_batch(state.pool, state.step, state.key, experiment.scene, clips, frames, config)

    update = stage1.make_curriculum(experiment.scene, clips, config, 1, None, animator)
    return update, lambda state: starting(state, clips, stage1.rollout_length(int(state.step), config)), state


def _description(
    step: int,
    metrics: loop.Metrics,
    simulations: tuple[np.ndarray, pool.Simulation],
    experiment: assembly.Experiment,
) -> str:
    """Describe a bad step for a reader."""
    wrong = [name for name, values in metrics.items() if not np.isfinite(values[0])]
    lines = [f"step {step + 1}: not finite: {', '.join(wrong)}"]
    clips = {
        name: len(assembly.motion(experiment, name).translation)
        for name in assembly.training_motions(experiment.config)
    }
    begin = np.concatenate([[0], np.cumsum(list(clips.values()))])
    numbers, of_them = jax.device_get(simulations)
    for index, number in enumerate(numbers):
        one = jax.tree.map(lambda x, i=index: x[i], of_them)
        clip = int(np.searchsorted(begin, one.frame, side="right")) - 1
        material = ", ".join(f"{name} {value:.4g}" for name, value in one.material._asdict().items())
        betas = np.round(one.betas.astype(float), 2).tolist()
        farthest = np.linalg.norm(one.cloth.position, axis=-1).max()
        lines.append(
            f"  simulation {number}: {'new, ' * bool(one.fresh)}frame {int(one.frame) - begin[clip]} of "
            f"{list(clips)[clip]}; betas {betas}; {material}; its farthest vertex {farthest:.2f} m from the root"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    cli.run(main)
