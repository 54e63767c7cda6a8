"""Cost of a training step in scenes that lack something: absent parts are not in the compiled program."""

import dataclasses
from collections.abc import Callable

import numpy as np

from clothjax.body import motion_clips
from clothjax.config import Config, Ramp
from clothjax.progress import progress_bar
from clothjax.simulation import assembly, scene
from clothjax.simulation.assembly import Experiment
from clothjax.training import stage1
from clothjax.types import Motion
from experiments.benchmark import timing
from experiments.benchmark.timing import cost, interleaved, program

Change = Callable[[Experiment], Experiment]
POLE = 0.05  # of the width, held by the pole


def _configured(**parts: dict) -> Change:
    """Return the same experiment with some settings of its configuration changed."""

    def change(experiment: Experiment) -> Experiment:
        changed = {part: dataclasses.replace(getattr(experiment.config, part), **new) for part, new in parts.items()}
        return experiment._replace(config=dataclasses.replace(experiment.config, **changed))

    return change


def _pinned(held: Callable[[np.ndarray], np.ndarray]) -> Change:
    """Return the same experiment with those vertices [V, 3] m pinned."""

    def change(experiment: Experiment) -> Experiment:
        return experiment._replace(garment=experiment.garment._replace(pinned=held(experiment.garment.vertices)))

    return change


def _both(*changes: Change) -> Change:
    def change(experiment: Experiment) -> Experiment:
        for one in changes:
            experiment = one(experiment)
        return experiment

    return change


def _beside_a_pole(vertices: np.ndarray) -> np.ndarray:
    return vertices[:, 0] < np.quantile(vertices[:, 0], POLE)


def _waist(vertices: np.ndarray) -> np.ndarray:
    return vertices[:, 1] > np.quantile(vertices[:, 1], 1 - POLE)


SCENES: dict[str, Change] = {
    "full": lambda experiment: experiment,
    "flag_on_a_pole": _both(_configured(physics={"body": "none"}), _pinned(_beside_a_pole)),
    "cloth_on_a_table": _configured(physics={"body": "still"}),
    "pinned_skirt": _pinned(_waist),
    "no_friction": _configured(physics={"without": ("friction",)}),
    "no_bending": _configured(physics={"without": ("bending",)}),
    "no_edge_contact": _configured(physics={"edge_contact": False}),
    "bending_weight_zero": _configured(loss={"bending": Ramp(0.0)}),
    "fixed_shape_and_material": _configured(stage1={"betas": 0.0}, material={"sample": False}),
}


def build(experiment: Experiment, name: str) -> Experiment:
    """Build one of `SCENES`, with the same garment."""
    changed = SCENES[name](experiment)
    return changed._replace(scene=scene.build_scene(changed.garment, changed.body, changed.config))


def update(experiment: Experiment):
    """Return a training step and the state it starts from."""
    clips = _standing(experiment) if experiment.scene.still else assembly.training_clips(experiment)[0]
    return stage1.make_update(experiment.scene, clips, experiment.config, 1, 1), stage1.init(
        experiment.scene, clips, experiment.config
    )


def _standing(experiment: Experiment):
    """Return clips of one pose."""
    names = assembly.training_motions(experiment.config)
    clip = assembly.motion(experiment._replace(scene=experiment.scene._replace(still=False)), names[0])
    pose = Motion(np.repeat(clip.rotations[:1], 30, 0), np.repeat(clip.translation[:1], 30, 0), clip.fps)
    return motion_clips.concatenate([pose], [""], [np.zeros(0, int)], 2)


def measure(config: Config, rounds: int) -> dict:
    """Measure flops, bytes and seconds of a training step in each scene, without loops, and ratios to the full one."""
    config = dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, pool=1))
    experiment = assembly.assemble(config)
    programs = {}
    with timing.unrolled(), progress_bar("compiling each scene", len(SCENES)) as report:
        for name in SCENES:
            programs[name] = program(*update(build(experiment, name)))
            report(len(programs))
    seconds = interleaved(programs, rounds)
    figures = {name: {**cost(one), "seconds": seconds[name]} for name, one in programs.items()}
    return {
        name: {**each, **{f"{key}_ratio": each[key] / figures["full"][key] for key in each}}
        for name, each in figures.items()
    }
