"""The reference solver in hard cases: time steps, materials, broken starts, a body that jumps."""

import itertools
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import Config
from clothjax.evaluation import metrics
from clothjax.evaluation.rollouts import windows
from clothjax.material import configured_material
from clothjax.physics import solver
from clothjax.simulation import assembly, reference
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.characters import Character
from clothjax.types import Material, Pose

TIMESTEPS = (1 / 240, 1 / 120, 1 / 60, 1 / 10, 1 / 3)  # s
SQUEEZED = 0.01  # of the garment's height
TELEPORT = 0.2  # m
STRAINED = 1.0  # of an edge: twice its length, or none
INSIDE = 5.0  # percent of the vertices


class Outcome(NamedTuple):
    """The outcome of a case."""

    seconds: float  # a frame, median
    iterations: int  # the most in a frame
    converged: float  # share of the frames
    strain: float  # the largest of an edge in the last frame
    inside: float  # percent of the vertices, in the last frame
    result: str  # recovered, reported or silent


def corners(config: Config) -> list[Material]:
    """Return the sixteen materials at the ends of the training ranges."""
    cloth = config.material
    ranges = (cloth.density_range, cloth.mu_range, cloth.lam_range, cloth.bending_range)
    return [
        Material(*(jnp.float32(value) for value in values))
        for values in itertools.product(*((limits.low, limits.high) for limits in ranges))
    ]


def stress(config: Config, frames: int, quick: bool, progress: Callable[[int], None]) -> dict[str, Outcome]:
    """Run every case for `frames` frames; with `quick`, one of a kind."""
    experiment = assembly.assemble(config)
    betas, cloth = assembly.betas(config), configured_material(config)
    poses = windows(assembly.motion(experiment, config.evaluation.motions[0]))
    usual = assembly.dress(experiment, betas, cloth)
    first = jax.tree.map(lambda x: x[:2], poses)
    trajectory, _ = reference.simulate(experiment.scene, usual, first, config)
    settled = (trajectory[1], trajectory[2])
    later = jax.tree.map(lambda x: x[2 : 2 + frames], poses)
    low = settled[1].min(axis=0) * [0, 1, 0]
    squeezed = tuple(((x - low) * [1, SQUEEZED, 1] + low).astype(np.float32) for x in settled)
    elsewhere = tuple(x + np.float32([TELEPORT, 0, 0]) for x in settled)
    cases: dict[str, tuple] = {"usual": (usual, config.fps, settled)}
    cases |= {f"timestep 1/{round(1 / dt)} s": (usual, 1 / dt, settled) for dt in TIMESTEPS[:: 4 if quick else 1]}
    for index, material in enumerate(corners(config)[:: 15 if quick else 1]):
        name = ", ".join(f"{float(x):.3g}" for x in material)
        cases[f"material {index}: {name}"] = (assembly.dress(experiment, betas, material), config.fps, settled)
    cases["squeezed to 1 %"] = (usual, config.fps, squeezed)
    cases["body 20 cm aside"] = (usual, config.fps, elsewhere)
    outcomes = {}
    for done, (name, (character, fps, start)) in enumerate(cases.items()):
        outcomes[name] = _run(experiment, replace(config, fps=fps), character, later, start)
        progress(done + 1)
    return outcomes


def _run(experiment: Experiment, config: Config, character: Character, poses: Pose, start: tuple) -> Outcome:
    began = time.perf_counter()
    seconds = [began]
    trajectory, infos = reference.simulate(
        experiment.scene, character, poses, config, start=start, progress=lambda _: seconds.append(time.perf_counter())
    )
    last = trajectory[-1:]
    finite = bool(np.isfinite(trajectory).all())
    strain = metrics.edge_strain(experiment.scene, character, last)["edge_strain_max"] if finite else np.inf
    inside = (
        metrics.penetrations(experiment.body, character.betas, last, _next(poses), [0], experiment.names)[
            "penetration_percent"
        ]
        if finite
        else np.inf
    )
    good = finite and strain < STRAINED and inside < INSIDE
    return Outcome(
        seconds=float(np.median(np.diff(seconds)[1:])) if len(seconds) > 2 else seconds[1] - began,
        iterations=max(info.iterations for info in infos),
        converged=float(np.mean([info.converged for info in infos])),
        strain=float(strain),
        inside=float(inside),
        result="reported" if not infos[-1].ok else "recovered" if good else "silent",
    )


def _next(poses: Pose) -> Pose:
    """Return the window whose middle is the frame after the last."""
    return Pose(poses.rotations[-1:][:, [1, 2, 2]], poses.translation[-1:][:, [1, 2, 2]])


def seconds_per_frame(config: Config, frames: int) -> dict[str, float]:
    """Measure median seconds a frame of a walk with body contact, and the share of frames that converged."""
    experiment = assembly.assemble(config)
    character = assembly.dress(experiment, assembly.betas(config), configured_material(config))
    poses = windows(assembly.motion(experiment, config.evaluation.motions[0]))
    stamps: list[float] = []
    _, infos = reference.simulate(
        experiment.scene, character, jax.tree.map(lambda x: x[: frames + 1], poses), config,
        progress=lambda _: stamps.append(time.perf_counter()),
    )  # fmt: skip
    seconds = np.diff(stamps)  # the first frame compiles
    return {
        "seconds": float(np.median(seconds)),
        "seconds_max": float(seconds.max()),
        "converged": float(np.mean([info.converged for info in infos])),
        "relative_gradient": float(max(info.relative_gradient for info in infos)),
        "frames": len(seconds),
        "vertices": len(experiment.garment.vertices),
        "tolerance": solver.TOLERANCE,
    }
