"""Measures of a garment's trajectory (METHOD.md, Measures): gaps, penetration, strain, swing, jitter.

A trajectory is [T + 1, V, 3] m: the garment at every frame, relative to the root's translation at that frame. For the
gaps, the reference solver solves each sampled time step from the trajectory's own two frames before it. So a trajectory
that has come apart from the solver's own rollout is not measured against that rollout.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import igl
import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import skinning
from clothjax.config import Config
from clothjax.geometry import topology
from clothjax.physics import descent, energies, incremental_potential, solver
from clothjax.physics.incremental_potential import TimeStep
from clothjax.simulation import characters, time_step
from clothjax.simulation.characters import Character
from clothjax.simulation.reference import problem
from clothjax.simulation.scene import Scene
from clothjax.types import Array, Body, Pose

NEAR = 1e-5  # m; of starts that are nearer, one is solved from: skinning holds what it had
SPAN_STEPS, SPAN_BOUND = 100, 1.0  # steps, and m a step, of the search in the span of the blend shapes


class StepMeasure(NamedTuple):
    """The potential of one time step of a trajectory, and of other steps from the same two frames."""

    energy: float  # J, of the step taken
    minimum: float  # J, the reference solver's
    skinned: float  # J, of skinning
    hold: float  # J, of persistence: the last canonical displacement again
    span: float  # J, the least in the span of the blend shapes; NaN without any
    error: np.ndarray  # [V] m, distance of each vertex to the minimum
    converged: bool


def step_measures(
    scene: Scene,
    character: Character,
    trajectory: Array,
    poses: Pose,
    frames: Sequence[int] | np.ndarray,
    config: Config,
    blendshapes: Array | None = None,
    external: Array | None = None,
) -> list[StepMeasure]:
    """Measure the time steps of a trajectory that begin at the given frames, each by a solve of its own.

    Args:
        trajectory: [T + 1, V, 3] m, relative to the root.
        poses: windows [T + 1, 3, ...] of `motion_clips.poses`, one a frame.
        frames: from 1 to T - 1.
        blendshapes: [K, V, 3] m; their span is searched too.
        external: [T + 1, 3] m/s^2, an acceleration beside gravity in the step to each frame.
    """
    state = problem(scene, config)
    search = None if blendshapes is None else _search_span(scene, character, blendshapes, config)

    def energy(new: Array, step: TimeStep) -> float:
        # float64 on the host, as in the solver: differences of energies are small
        with jax.enable_x64(True):
            step = jax.tree.map(solver.to_float64, step)
            return float(_potential(np.asarray(new, np.float64), step, scene.mesh, config.physics))

    measures = []
    for frame in frames:
        around = jax.tree.map(lambda x, t=frame: x[t], poses)
        pushed = None if external is None else external[frame + 1]
        step, skinned, persistent, advance = state(character, trajectory[frame - 1], trajectory[frame], around, pushed)
        new = trajectory[frame + 1] + advance[None]
        # two starts, the better end: folds have many minima
        same = float(jnp.max(jnp.abs(new - persistent))) < NEAR
        ends = [
            solver.solve_step(begin, step, scene.mesh, scene.garment.pinned, config.physics)
            for begin in ((new,) if same else (new, persistent))
        ]
        best, info = min(ends, key=lambda end: (not end[1].converged, end[1].energy))
        error = np.linalg.norm(best - np.asarray(new, np.float64), axis=-1)
        span = np.nan
        if search is not None:
            span = min(energy(x, step) for x in (search(begin, step, around) for begin in (new, best)))
        measures.append(
            StepMeasure(
                energy=energy(new, step),
                minimum=info.energy,
                skinned=energy(skinned, step),
                hold=energy(persistent, step),
                span=span,
                error=error,
                converged=info.converged,
            )
        )
    return measures


def _search_span(scene: Scene, character: Character, blendshapes: Array, config: Config) -> Callable:
    """Return a function that projects a garment [V, 3] m to the span of blend shapes and finds the minimum there."""
    free = np.where(np.asarray(scene.garment.pinned), 0.0, 1.0)[:, None]
    shapes = (np.asarray(blendshapes, np.float64) * free).reshape(len(blendshapes), -1)
    _, sizes, vectors = np.linalg.svd(shapes, full_matrices=False)
    vectors = vectors[sizes > 1e-6 * sizes[0]].astype(np.float32)
    size = len(vectors)
    rest = time_step.rest_energy(scene, config)
    inertia = float(jnp.mean(character.mass)) * config.fps**2
    inverse = jax.jit(
        lambda: descent.regularised_inverse(
            descent.hessian(lambda w: rest((w @ vectors).reshape(-1, 3)), jnp.zeros(size)), inertia
        )
    )()

    @jax.jit
    def search(begin: Array, step: TimeStep, poses: Pose) -> Array:
        transforms = characters.window(scene, character, poses).following.garment
        displaced = (skinning.unapply(transforms, begin) - character.template).reshape(-1)

        def garment(weights):
            displacement = jnp.matmul(weights, vectors, precision="highest").reshape(-1, 3)
            return skinning.apply(transforms, character.template + displacement)

        def potential(new):
            return incremental_potential.potential(new, step, scene.mesh, config.physics)

        weights = jnp.matmul(jnp.asarray(vectors), displaced, precision="highest")
        return garment(descent.descend(lambda g: inverse @ g, weights, garment, potential, SPAN_STEPS, SPAN_BOUND))

    return search


def gaps(measures: list[StepMeasure]) -> dict[str, float]:
    """Compute `energy_gap`, `hold_gap`, `span_gap` and `step_error_mm` of time steps: means, medians and maxima.

    energy_gap = (E - E_min) / (E_skinned - E_min): 0 for the solver, 1 for plain skinning. hold_gap, the persistence
    gap, has E_hold in the place of E_skinned: 1 for no dynamics at all. span_gap is the hold_gap of the minimum in the
    span of the blend shapes, without relaxation. Means are ratios of summed energies, so a frame whose garment hardly
    moves does not outweigh the others; medians are of single frames.
    """
    taken, minimum, skinned, hold = (
        np.array([getattr(m, name) for m in measures]) for name in ("energy", "minimum", "skinned", "hold")
    )
    excess, span = taken - minimum, np.array([m.span for m in measures]) - minimum
    result = {}
    for name, against in (("energy_gap", skinned - minimum), ("hold_gap", hold - minimum)):
        single = excess / np.maximum(against, 1e-9)
        result |= {name: excess.sum() / max(against.sum(), 1e-9)}
        result |= {f"{name}_median": np.median(single), f"{name}_max": single.max()}
    if np.isfinite(span).all():
        result["span_gap"] = span.sum() / max((hold - minimum).sum(), 1e-9)
    error = 1e3 * np.stack([m.error for m in measures])
    result |= {
        "step_error_mm": error.mean(),
        "step_error_mm_p95": np.percentile(error, 95),
        "step_error_mm_max": error.max(),
        "solver_converged": float(np.mean([m.converged for m in measures])),
    }
    return {name: float(value) for name, value in result.items()}


def penetration(garment: np.ndarray, body: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measure how deep each garment vertex is inside the body.

    The body is closed. Its winding number decides what is inside, independently of the planes of the collision energy.

    Args:
        garment: [V, 3] m.
        body: [B, 3] m.
        faces: [F, 3] of the body.

    Returns:
        Depth [V] m, 0 outside, and the nearest face [V].
    """
    signed, nearest, *_ = igl.signed_distance(
        np.asarray(garment, np.float64),
        np.asarray(body, np.float64),
        np.asarray(faces, np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER,
    )
    return np.maximum(-np.asarray(signed), 0.0), np.asarray(nearest)


def penetrations(
    body: Body,
    betas: Array,
    trajectory: Array,
    poses: Pose,
    frames: Sequence[int],
    names: tuple[str, ...],
) -> dict:
    """Measure how much of a garment is inside the body, over frames.

    Args:
        betas: [S] of the body.
        trajectory: [T, V, 3] m, relative to the root.
        poses: windows [T, 3, ...] of `motion_clips.poses`.
        frames: those to measure at.
        names: [J] of the joints.

    Returns:
        `penetration_percent`: mean, median and maximum over frames. `penetration_max_mm`: the deepest vertex.
        `penetration_by_joint`: the mean percentage of the garment inside the part of the body that each joint moves
        most.
    """
    vertices = skinning.shaped_vertices(body, betas)
    joints = skinning.shaped_joints(body, betas)

    @jax.jit
    def posed(rotations):
        return skinning.pose_body(body, vertices, joints, Pose(rotations, jnp.zeros(3)))

    moved_by = np.asarray(body.weights)[np.asarray(body.faces)[:, 0]].argmax(axis=1)
    percent, deepest, by_joint = [], 0.0, np.zeros(len(names))
    for t in frames:
        depth, nearest = penetration(np.asarray(trajectory[t]), posed(poses.rotations[t, 1]), np.asarray(body.faces))
        percent.append(100.0 * np.mean(depth > 0))
        deepest = max(deepest, depth.max())
        by_joint += np.bincount(moved_by[nearest[depth > 0]], minlength=len(names))
    by_joint = 100.0 * by_joint / (len(percent) * trajectory.shape[1])
    return {
        "penetration_percent": float(np.mean(percent)),
        "penetration_percent_median": float(np.median(percent)),
        "penetration_percent_max": float(np.max(percent)),
        "penetration_max_mm": 1e3 * float(deepest),
        "penetration_by_joint": {name: float(share) for name, share in zip(names, by_joint, strict=True) if share > 0},
    }


def edge_strain(scene: Scene, character: Character, trajectory: Array) -> dict[str, float]:
    """Compute `edge_strain_p95` and `edge_strain_max`: of |l / l_0 - 1| over all edges and frames of [T, V, 3] m."""
    edges = topology.edges(np.asarray(scene.garment.faces))
    trajectory, template = np.asarray(trajectory, np.float64), np.asarray(character.template, np.float64)

    def length(points):
        return np.linalg.norm(points[..., edges[:, 0], :] - points[..., edges[:, 1], :], axis=-1)

    strain = np.abs(length(trajectory) / length(template) - 1.0)
    return {"edge_strain_p95": float(np.percentile(strain, 95)), "edge_strain_max": float(strain.max())}


def beside_solver(scene: Scene, trajectory: Array, solved: Array, skinned: Array) -> dict[str, float]:
    """Compare a trajectory with the reference solver's own rollout, frame by frame.

    Args:
        trajectory, solved, skinned: [T, V, 3] m at the same frames, relative to the root.

    Returns:
        `swing_ratio`: the rms velocity relative to skinning, over the solver's. `swing_correlation`: of these two
        velocities. `rollout_error_mm`: the mean distance of vertices. `wrinkle_ratio`: the rms dihedral angle over the
        solver's.
    """
    one, other, plain = (np.asarray(x, np.float64) for x in (trajectory, solved, skinned))
    swing, reference = (np.diff(x - plain, axis=0) for x in (one, other))
    sizes = [np.sqrt(np.mean(x**2)) for x in (swing, reference)]
    angle = jax.jit(lambda x: jnp.sqrt(jnp.mean(jax.vmap(energies.dihedral_angle)(x[:, scene.mesh.hinges]) ** 2)))
    folds = [float(angle(jnp.asarray(x, jnp.float32))) for x in (one, other)]
    return {
        "swing_ratio": float(sizes[0] / sizes[1]),
        "swing_correlation": float(np.mean(swing * reference) / max(sizes[0] * sizes[1], 1e-12)),
        "rollout_error_mm": float(distance_mm(one, other).mean()),
        "wrinkle_ratio": folds[0] / folds[1],
    }


def roughness(trajectory: Array, advance: Array) -> float:
    """Compute the rms fourth time difference of world positions, in m/frame^4: the numerator of `jitter`.

    It is the second difference of the accelerations.

    Args:
        trajectory: [T, V, 3] m relative to the root.
        advance: [T - 1, 3] m, the root's steps between its frames.
    """
    world = np.asarray(trajectory, np.float64)
    moved = np.concatenate([np.zeros((1, 3)), np.cumsum(np.asarray(advance, np.float64), axis=0)])
    return float(np.sqrt(np.mean(np.diff(world + moved[:, None], n=4, axis=0) ** 2)))


def distance_mm(one: Array, other: Array) -> np.ndarray:
    """Compute the mean vertex distance [T] in mm of each frame of two trajectories [T, V, 3] m."""
    return 1e3 * np.linalg.norm(np.asarray(one, np.float64) - np.asarray(other, np.float64), axis=-1).mean(-1)


_potential = jax.jit(incremental_potential.potential, static_argnums=3)
