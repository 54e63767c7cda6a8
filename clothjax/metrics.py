"""How good a trajectory is, judged by the reference solver from the trajectory's own states.

A trajectory is [T + 1, V, 3] m: the garment at every frame, relative to the root's translation at that frame.
Nothing is borrowed from the solver between frames, so trajectories on different branches of a history-dependent
motion are judged alike.
"""

from typing import NamedTuple

import igl
import jax
import jax.numpy as jnp
import numpy as np

from clothjax import losses, simulation, skinning, solver, topology
from clothjax.character import Character
from clothjax.config import Config
from clothjax.losses import TimeStep
from clothjax.scene import Scene
from clothjax.types import Array, Body, Pose


class StepMeasure(NamedTuple):
    """One step of a trajectory against the best it could have been, from the same two previous frames."""

    energy: float  # J, of the step taken
    minimum: float  # J, the reference solver's
    skinned: float  # J, of skinning
    hold: float  # J, of keeping the last canonical displacement
    error: np.ndarray  # [V] m, distance of each vertex to the minimum
    converged: bool


def step_measures(
    scene: Scene, character: Character, trajectory: Array, poses: Pose, frames: Array, config: Config
) -> list[StepMeasure]:
    """The steps of a trajectory that leave the given frames, each solved anew.

    Args:
        trajectory: [T + 1, V, 3] m, relative to the root.
        poses: windows [T + 1, 3, ...] of `clips.poses`, one a frame.
        frames: from 1 to T - 1.
    """

    state = simulation.problem(scene, config)

    def energy(new: Array, step: TimeStep) -> float:
        # float64 on the host, as the solver has it: differences of energies are small
        with jax.enable_x64(True):
            step = jax.tree.map(solver.to_float64, step)
            return float(_potential(np.asarray(new, np.float64), step, scene.mesh, config.physics))

    measures = []
    for frame in frames:
        around = jax.tree.map(lambda x, t=frame: x[t], poses)
        step, skinned, held, advance = state(character, trajectory[frame - 1], trajectory[frame], around)
        new = trajectory[frame + 1] + advance[None]
        taken, kept = energy(new, step), energy(held, step)
        # two starts, the better end: folds have many minima
        ends = [
            solver.solve_step(begin, step, scene.mesh, scene.garment.pinned, config.physics) for begin in (new, held)
        ]
        best, info = min(ends, key=lambda end: (not end[1].converged, end[1].energy))
        error = np.linalg.norm(best - np.asarray(new, np.float64), axis=-1)
        measures.append(StepMeasure(taken, info.energy, energy(skinned, step), kept, error, info.converged))
    return measures


def gaps(measures: list[StepMeasure]) -> dict[str, float]:
    """`energy_gap`, `hold_gap` and `step_error_mm` of steps: means, with medians and maxima beside them.

    energy_gap = (E - E_min) / (E_skinned - E_min): 0 the solver, 1 plain skinning. hold_gap puts E_hold in the place
    of E_skinned: 1 no dynamics at all. Both means are ratios of summed energies, so that a frame whose garment
    hardly moves does not outweigh the others; the medians are of single frames.
    """
    taken, minimum, skinned, hold = (
        np.array([getattr(m, name) for m in measures]) for name in ("energy", "minimum", "skinned", "hold")
    )
    excess = taken - minimum
    result = {}
    for name, against in (("energy_gap", skinned - minimum), ("hold_gap", hold - minimum)):
        single = excess / np.maximum(against, 1e-9)
        result |= {name: excess.sum() / max(against.sum(), 1e-9)}
        result |= {f"{name}_median": np.median(single), f"{name}_max": single.max()}
    error = 1e3 * np.stack([m.error for m in measures])
    result |= {
        "step_error_mm": error.mean(),
        "step_error_mm_p95": np.percentile(error, 95),
        "step_error_mm_max": error.max(),
        "solver_converged": float(np.mean([m.converged for m in measures])),
    }
    return {name: float(value) for name, value in result.items()}


def penetration(garment: np.ndarray, body: np.ndarray, faces: np.ndarray) -> tuple[float, float]:
    """Percent of garment vertices [V, 3] m inside a closed body [B, 3] m, and the deepest in mm.

    Inside is by winding number on the whole body, independent of the planes that the collision energy uses.
    """
    signed = igl.signed_distance(
        np.asarray(garment, np.float64),
        np.asarray(body, np.float64),
        np.asarray(faces, np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )[0]
    return 100.0 * float(np.mean(signed < 0)), 1e3 * float(max(0.0, -signed.min()))


def penetrations(
    scene: Scene, body: Body, betas: Array, trajectory: Array, poses: Pose, frames: Array
) -> dict[str, float]:
    """`penetration_percent`: mean, median and maximum over frames; `penetration_max_mm`: the deepest vertex."""
    vertices = skinning.shaped_vertices(body, betas)
    joints = skinning.shaped_joints(body, betas)

    @jax.jit
    def posed(rotations):
        return skinning.pose_body(body, vertices, joints, Pose(rotations, jnp.zeros(3)))

    values = np.array([penetration(trajectory[t], posed(poses.rotations[t, 1]), body.faces) for t in frames])
    return {
        "penetration_percent": float(values[:, 0].mean()),
        "penetration_percent_median": float(np.median(values[:, 0])),
        "penetration_percent_max": float(values[:, 0].max()),
        "penetration_max_mm": float(values[:, 1].max()),
    }


def edge_strain(scene: Scene, character: Character, trajectory: Array) -> dict[str, float]:
    """`edge_strain_p95` and `edge_strain_max` of |l / l_0 - 1| over all edges and frames."""
    edges = topology.edges(np.asarray(scene.garment.faces))
    trajectory, template = np.asarray(trajectory, np.float64), np.asarray(character.template, np.float64)

    def length(points):
        return np.linalg.norm(points[..., edges[:, 0], :] - points[..., edges[:, 1], :], axis=-1)

    strain = np.abs(length(trajectory) / length(template) - 1.0)
    return {"edge_strain_p95": float(np.percentile(strain, 95)), "edge_strain_max": float(strain.max())}


def roughness(trajectory: Array, advance: Array) -> float:
    """Rms of the second time difference of vertex accelerations, in m/frame^4; the numerator of `jitter`.

    Args:
        trajectory: [T, V, 3] m relative to the root; advance: [T - 1, 3] m, the root's steps between its frames.
    """
    world = np.asarray(trajectory, np.float64)
    moved = np.concatenate([np.zeros((1, 3)), np.cumsum(np.asarray(advance, np.float64), axis=0)])
    return float(np.sqrt(np.mean(np.diff(world + moved[:, None], n=4, axis=0) ** 2)))


def distance_mm(one: Array, other: Array) -> np.ndarray:
    """Mean vertex distance in mm of each frame of two trajectories [T, V, 3] m: [T]."""
    return 1e3 * np.linalg.norm(np.asarray(one, np.float64) - np.asarray(other, np.float64), axis=-1).mean(-1)


_potential = jax.jit(losses.potential, static_argnums=3)
