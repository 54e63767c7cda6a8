"""Cloth as engines simulate it: extended position-based dynamics (XPBD, Macklin et al. 2016), Newton's on the CPU.

The garment's edges are springs as stiff as the membrane that they replace (Van Gelder 1998). Hinges bend as in the
reference solver. The body is a mesh that pushes cloth out, with the same friction and distance. Newton adds up the
corrections of all springs at a vertex (Jacobi), so only short steps are stable.
"""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.geometry import topology
from clothjax.physics import energies
from clothjax.simulation import characters, reference
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.characters import Character
from clothjax.types import Pose
from experiments.compare_solvers.engines import newton_and_warp

NEAR = 0.03  # m, of the body, where contact is looked for


class Xpbd:
    """A garment on a character, moved from frame to frame.

    Args:
        substeps: of a frame, each with `iterations` iterations.

    Raises:
        ImportError: if Newton is not installed.
    """

    def __init__(self, experiment: Experiment, character: Character, substeps: int, iterations: int):
        newton, _ = newton_and_warp()
        scene, config = experiment.scene, experiment.config.physics
        self.pinned = np.asarray(scene.garment.pinned)
        self.substeps, self.timestep = substeps, 1.0 / (experiment.config.fps * substeps)
        rest, material = character.rest, character.material
        template, faces = np.asarray(character.template), np.asarray(scene.mesh.faces)
        mass = np.where(self.pinned, 0.0, np.asarray(character.mass))
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -energies.GRAVITY, 0.0))
        builder.add_particles(
            template.tolist(), np.zeros_like(template).tolist(), mass=mass.tolist(),
            radius=[config.collision_offset] * len(mass),
        )  # fmt: skip
        edges = topology.edges(faces)
        for (i, j), stiffness in zip(
            edges, springs(template, faces, edges, float(material.mu), float(material.lam)), strict=True
        ):
            builder.add_spring(int(i), int(j), float(stiffness), 0.0, 0)
        a, b, left, right = np.asarray(scene.mesh.hinges).T
        squared = np.sum((template[a] - template[b]) ** 2, axis=1)
        bending = float(material.bending) * squared / (4.0 * np.asarray(rest.hinge_area))
        angles, zero = np.asarray(rest.hinge_angle), [0.0] * len(a)
        builder.add_edges(left, right, a, b, rest=angles.tolist(), edge_ke=bending.tolist(), edge_kd=zero)
        self.body = newton.Mesh(np.asarray(character.body), np.asarray(scene.body.faces).ravel(), compute_inertia=False)
        builder.add_shape_mesh(-1, mesh=self.body, cfg=newton.ModelBuilder.ShapeConfig(mu=config.friction_coefficient))
        model = builder.finalize(device="cpu")
        model.soft_contact_mu = config.friction_coefficient
        self.solver = newton.solvers.SolverXPBD(model, iterations=iterations)
        self.control, self.now, self.next = model.control(), model.state(), model.state()
        self.collide = newton.CollisionPipeline(model, soft_contact_gap=NEAR)
        self.contacts = self.collide.contacts()

    def step(self, now: np.ndarray, velocity: np.ndarray, held: np.ndarray, bodies: np.ndarray) -> np.ndarray:
        """Return the garment [V, 3] m at the next frame.

        Args:
            velocity: [V, 3] m/s; held: [V, 3] m, where pinned vertices go.
            bodies: [2, B, 3] m, at this frame and the next.
        """
        position = now
        # friction is with a body that moves
        self.body.mesh.velocities.assign(((bodies[1] - bodies[0]) / (self.substeps * self.timestep)).astype(np.float32))
        for substep in range(self.substeps):
            share = (substep + 1) / self.substeps
            pinned = (1.0 - share) * now + share * held
            self.now.particle_q.assign(np.where(self.pinned[:, None], pinned, position).astype(np.float32))
            self.now.particle_qd.assign(np.where(self.pinned[:, None], 0.0, velocity).astype(np.float32))
            self.body.mesh.points.assign(((1.0 - share) * bodies[0] + share * bodies[1]).astype(np.float32))
            self.body.mesh.refit()
            self.now.clear_forces()
            self.collide.collide(self.now, self.contacts)
            self.solver.step(self.now, self.next, self.control, self.contacts, self.timestep)
            position, velocity = self.next.particle_q.numpy(), self.next.particle_qd.numpy()
        return position.copy()  # not the engine's own memory


def springs(vertices: np.ndarray, faces: np.ndarray, edges: np.ndarray, mu: float, lam: float) -> np.ndarray:
    """Return the stiffness [E] N/m of edges that replace a membrane (Van Gelder 1998).

    It is Young's modulus times the area of the triangles at an edge, over its length squared.

    Args:
        mu, lam: Lame's constants of the membrane, Pa.
    """
    young = energies.THICKNESS * 4.0 * mu * (mu + lam) / (2.0 * mu + lam)
    corners = vertices[faces]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    number = {tuple(edge): i for i, edge in enumerate(np.sort(edges, axis=1).tolist())}
    around = np.zeros(len(edges))
    np.add.at(around, [number[tuple(side)] for side in sides.tolist()], np.repeat(areas, 3))
    return young * around / np.sum((vertices[edges[:, 0]] - vertices[edges[:, 1]]) ** 2, axis=1)


def simulate(
    engine: Xpbd, experiment: Experiment, character: Character, poses: Pose, start: np.ndarray
) -> tuple[np.ndarray, float]:
    """Simulate an autoregressive rollout [T, V, 3] m relative to the root; return it and median microseconds a frame.

    Args:
        poses: windows [T, 3, ...]; start: [V, 3] m, relative to the root at the first frame, where it stands still.
    """
    state, around = reference.problem(experiment.scene, experiment.config), _bodies(experiment, character)
    before = start - np.asarray(poses.translation[0, 0])
    track, clock = [start], []
    for frame in range(len(poses.translation) - 1):
        window = Pose(poses.rotations[frame], poses.translation[frame])
        now = track[-1]
        step, skinned, _, advance = state(character, before, now, window)
        velocity, skinned, bodies = (np.asarray(x) for x in (step.velocity, skinned, around(window)))
        began = time.perf_counter()
        new = engine.step(now, experiment.config.fps * velocity, skinned, bodies)
        clock.append(1e6 * (time.perf_counter() - began))
        before = now
        track.append(new - np.asarray(advance))
    return np.stack(track), float(np.median(clock[1:]))


def _bodies(experiment: Experiment, character: Character) -> Callable[[Pose], jax.Array]:
    def both(poses: Pose) -> jax.Array:
        window = characters.window(experiment.scene, character, poses)
        return jnp.stack([window.current.body, window.following.body])

    return jax.jit(both)
