"""Takes the steps of a training that diverged once more, one at a time, and says what the first bad one was made of.

    python -m experiments.replay runs/mine                   # its last stage
    python -m experiments.replay runs/mine --stage stage1

It starts from the last good checkpoint: resuming is exact, so what went wrong goes wrong again. Named are the terms
that are not finite, and of each simulation of the batch its clip, frame, betas and material. The state before that step
is kept in `RUN/<stage>/diverged/`, from where the next replay starts. Nothing else of the run is touched.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from clothjax import (
    blendshapes,
    checkpoint,
    configuration,
    experiment,
    latent_predictor,
    rollout,
    stage1,
    trained,
    tuning,
)
from clothjax.clips import Clips
from clothjax.config import Config
from experiments.session import fail_clearly, progress, setup

STAGES = ("stage1", "tuning")  # in which the physics is the loss


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a run")
    parser.add_argument("--stage", choices=STAGES, default=None, help="default: the last one begun")
    parser.add_argument("--steps", type=int, default=2000, help="at the most; default 2000")
    arguments = parser.parse_args(argv)
    begun = [stage for stage in STAGES if checkpoint.steps(arguments.run / stage / "checkpoints")]
    if not begun or (arguments.stage and arguments.stage not in begun):
        raise ValueError(
            f"{arguments.run}: has no checkpoint of {arguments.stage or ' or '.join(STAGES)} to start from"
        )
    print(replay(arguments.run, arguments.stage or begun[-1], arguments.steps))


def replay(run: Path, stage: str, steps: int) -> str:
    """What the first step was made of whose loss or gradient is not finite."""
    folder = run / stage
    start = folder / "diverged" if checkpoint.steps(folder / "diverged") else folder / "checkpoints"
    config = configuration.from_dict(Config, checkpoint.latest(start).config, str(start))
    whole = experiment.assemble(config)
    reel, _ = experiment.training_clips(whole)
    update, state, settings = _again(run, stage, whole, reel)
    state, found = checkpoint.restore(start, state)
    print(f"from step {found.step} of {start}", flush=True)
    with progress("replaying", steps) as report:
        for step in range(found.step, found.step + steps):
            before = jax.device_get(state)
            state, metrics = update(state)
            metrics = {name: float(values[0]) for name, values in metrics.items()}
            if metrics["nonfinite"] or not np.isfinite(metrics["loss"]):
                kept = folder / "diverged" / str(step)
                if not kept.is_dir():
                    checkpoint.save(folder / "diverged", step, before, found.config)
                return _said(step, metrics, before, state, settings, whole) + f"\nkept: {kept}"
            report(step + 1 - found.step)
    return f"all of {steps} steps have finite losses and gradients; --steps takes more"


def _again(
    run: Path, stage: str, whole: experiment.Experiment, reel: Clips
) -> tuple[Callable, stage1.TrainingState, Config]:
    """The training step of a stage, a state of its structure, and the configuration that it reads."""
    config = whole.config
    kept = latent_predictor.kept_joints(whole.names, config.stage2)
    if stage == "tuning":
        _, garment, predictor, normalizers = trained.psi(run)
        inverse = trained.phi(run)[1]["params"].get("inverse_hessian")
        animator = tuning.psi(garment, normalizers, kept, inverse, config.tuning.preconditioning)
        config = tuning.settings(config)
        state = tuning.init(predictor, whole.scene, reel, whole.config)
    elif config.peer.network:
        animator = rollout.peer(kept)
        state = stage1.init_peer(whole.scene, reel, kept, blendshapes.laplacian(whole.scene, config), config)
    else:
        animator, state = rollout.phi, stage1.init(whole.scene, reel, config)
    return stage1.make_curriculum(whole.scene, reel, config, 1, None, animator), state, config


def _said(
    step: int,
    metrics: dict[str, float],
    before: stage1.TrainingState,
    after: stage1.TrainingState,
    config: Config,
    whole: experiment.Experiment,
) -> str:
    """A bad step for a reader."""
    wrong = [name for name, value in metrics.items() if not np.isfinite(value)]
    lines = [f"step {step + 1}: not finite: {', '.join(wrong) or 'the gradient alone'}"]
    clips = {name: len(experiment.motion(whole, name).translation) for name in experiment.training_motions(config)}
    begin = np.concatenate([[0], np.cumsum(list(clips.values()))])
    for index in (step * config.stage1.batch + np.arange(config.stage1.batch)) % config.stage1.pool:
        one, was = (jax.tree.map(lambda x, i=index: np.asarray(x[i]), state.pool) for state in (after, before))
        material = ", ".join(f"{name} {value:.4g}" for name, value in one.material._asdict().items())
        if not np.array_equal(one.betas, was.betas) or one.material != was.material:
            where = "begun anew in this step"
        else:
            clip = int(np.searchsorted(begin, was.frame, side="right")) - 1
            where = f"frame {int(was.frame) - begin[clip]} of {list(clips)[clip]}"
        farthest = float(np.abs(was.cloth.position).max())
        betas = np.round(one.betas.astype(float), 2).tolist()
        lines.append(
            f"  simulation {index}: {where}; betas {betas}; {material}; its farthest vertex "
            f"{farthest:.2f} m from the root"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
