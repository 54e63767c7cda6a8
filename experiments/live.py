"""A character that is steered, and its garment by Psi and what it is compared with, frame by frame."""

import time
from collections import deque
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import character as characters
from clothjax import (
    experiment,
    folding,
    inference,
    rollout,
    simulation,
    skinning,
    solver,
    storage,
    trained,
)
from clothjax.motion_matching import Library, Player
from clothjax.types import Material, Pose

SPEEDS = (0.0, 1.3, 2.8)  # m/s: stand, walk, run
TURN = np.radians(45.0)
STAGES = ("psi", "skinning", "phi", "solver")
APART = 1.4  # m, from one stage to the next, and from one character of a crowd to the next
BEHIND = 11  # frames that a character of a crowd is behind the one before it
BODIES = 4  # that are shown, of a crowd


class Wardrobe:
    """A garment on a wearer, moved by each of the stages that are asked for."""

    def __init__(
        self, run: str | Path, betas: np.ndarray, material: Material | None, count: int = 1, fine: bool = False
    ):
        model = inference.load(run, betas=betas, material=material)
        if fine:
            body = storage.load_body(model.config.body)
            garment = storage.load_garment(model.config.garment.replace("_1000", "_4000"), body)
            model = folding.on_mesh(model, garment, betas)
        self.run, self.model, self.betas, self.material = run, model, betas, material
        self.crowd = inference.crowd([model] * count)
        self.count = count
        self.faces = np.asarray(model.faces)
        self.states = None
        self._slow: _Teacher | None = None

    def psi(self, poses: list[Pose]) -> np.ndarray:
        """Vertices [N, V, 3] m of the next frame, of as many characters as there are poses."""
        if self.states is None:
            states = [inference.initial_state(self.model, pose) for pose in poses]
            self.states = jax.tree.map(lambda *each: jnp.stack(each), *states)
        given = Pose(*(np.stack(each) for each in zip(*poses)))
        self.states, vertices = inference.step_crowd(self.crowd, self.states, given)
        return np.asarray(vertices)

    def beside(self, stage: str, window: Pose) -> np.ndarray:
        """Vertices [1, V, 3] m of the next frame of the first character, by another stage.

        Args:
            window: its last three poses.
        """
        if self._slow is None:
            self._slow = _Teacher(self.run, self.betas, self.material)
        return self._slow.step(stage, window)[None]

    @property
    def other_faces(self) -> np.ndarray:
        """Of what the other stages show."""
        return self._slow.faces


class _Teacher:
    """Skinning, Phi and the solver, frame by frame; on the mesh that Phi was trained on."""

    def __init__(self, run: str | Path, betas: np.ndarray, material: Material | None):
        folder = trained.folder(run) if run in trained.shipped() else Path(run)
        self.config, phi = trained.phi(folder)
        whole = experiment.assemble(self.config)
        cloth = experiment.material(self.config) if material is None else material
        self.scene, config = whole.scene, self.config
        self.character = characters.dress(self.scene, jnp.asarray(betas), cloth, config.physics)
        self.faces = np.asarray(self.scene.mesh.faces)
        self.states: dict = {}
        animate = rollout.phi(jax.tree.map(jnp.asarray, phi), self.scene, self.character, config)

        @jax.jit
        def settle(poses):
            return rollout.settle(animate, self.scene, self.character, poses, config)

        @jax.jit
        def take(state, poses):
            taken, (new, _, _) = rollout.take(
                animate, self.scene, self.character, state, poses, 1.0 / config.fps, config
            )
            return rollout.follow(taken, poses.translation[2]), new

        @jax.jit
        def skinned(poses):
            return characters.skinned(self.character, characters.window(self.scene, self.character, poses).following)

        self._settle, self._take, self._skinned = settle, take, skinned
        self._problem = simulation.problem(self.scene, config)

    def step(self, stage: str, window: Pose) -> np.ndarray:
        """Vertices [V, 3] m in the world after the newest of three poses."""
        here = window.translation[1]
        poses = Pose(jnp.asarray(window.rotations), jnp.asarray(window.translation - here[None]))
        if stage == "skinning":
            return np.asarray(self._skinned(poses)) + here
        if stage == "phi":
            state = self.states.get(stage)
            state, new = self._take(self._settle(poses) if state is None else state, poses)
            self.states[stage] = state
            return np.asarray(new) + here
        before, now = self.states.get(stage) or [np.asarray(self._settle(poses).position)] * 2
        step, _, held, advance = self._problem(self.character, before, now, poses)
        new, _ = solver.solve_step(held, step, self.scene.mesh, self.scene.garment.pinned, self.config.physics)
        new = np.asarray(new, np.float32)
        self.states[stage] = (now, new - np.asarray(advance)[None])
        return new + here


class Steering:
    """What the player wishes."""

    def __init__(self):
        self.gait, self.heading = 0, 0.0
        self.doing, self.until = None, 0.0  # a family of clips, and the time it ends

    def faster(self) -> None:
        self.gait = min(self.gait + 1, len(SPEEDS) - 1)

    def slower(self) -> None:
        self.gait = max(self.gait - 1, 0)

    def turn(self, by: float) -> None:
        self.heading += by

    def do(self, family: str, until: float) -> None:
        self.doing, self.until = family, until

    def velocity(self) -> np.ndarray:
        """[2] m/s."""
        return SPEEDS[self.gait] * np.array([np.sin(self.heading), np.cos(self.heading)])


class Show:
    """A player's character and its garments, frame by frame, whatever shows them."""

    def __init__(self, clips: Library, wander: tuple[str, ...], run: str | Path):
        self.clips, self.steering = clips, Steering()
        self.player = Player(clips, wander)
        self.stages: tuple[str, ...] = ("psi",)
        self.past: deque[Pose] = deque(maxlen=1)
        self.seconds = {"garment": 0.0, "rest": 0.0}
        self.frames = 0
        self.dress(run, np.zeros(10))

    def dress(self, run, betas, material: Material | None = None, count: int = 1, fine: bool = False) -> None:
        """Another garment, wearer or number of characters."""
        self.wardrobe = Wardrobe(run, betas, material, count, fine)
        body = storage.load_body(self.wardrobe.model.config.body)
        vertices = skinning.shaped_vertices(body, jnp.asarray(betas))
        joints = skinning.shaped_joints(body, jnp.asarray(betas))
        self.body_faces = np.asarray(body.faces)
        self._body = jax.jit(lambda pose: skinning.pose_body(body, vertices, joints, pose))
        self.past = deque(self.past, maxlen=max(3, BEHIND * (count - 1) + 1))

    def frame(self) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
        """The next: vertices [N, V, 3] m by stage, in their places, and those [B, 3] of bodies."""
        began = time.perf_counter()
        family = self.steering.doing if self.frames < self.steering.until * self.clips.fps else None
        pose = self.player.step(self.steering.velocity(), family)
        self.past.append(pose)
        self.frames += 1
        poses = [self.past[max(len(self.past) - 1 - BEHIND * i, 0)] for i in range(self.wardrobe.count)]
        shift = [_place(i, pose) for i, pose in enumerate(poses)]
        bodies = [np.asarray(self._body(pose)) + place for pose, place in zip(poses[:BODIES], shift)]
        rest = time.perf_counter() - began
        began = time.perf_counter()
        shown = {"psi": self.wardrobe.psi(poses) + np.stack(shift)[:, None]}
        self.seconds = {"garment": time.perf_counter() - began, "rest": rest}
        newest = [self.past[max(len(self.past) - 3 + i, 0)] for i in range(3)]
        window = Pose(*(np.stack(each) for each in zip(*newest)))
        if "psi" not in self.stages:
            del shown["psi"]
        for i, stage in enumerate(name for name in self.stages if name != "psi"):
            beside = np.array([APART * (i + 1), 0.0, 0.0], np.float32)
            shown[stage] = self.wardrobe.beside(stage, window) + beside
            bodies.append(np.asarray(self._body(pose)) + beside)
        return shown, bodies


def _place(number: int, pose: Pose) -> np.ndarray:
    """What a character of a crowd is moved by [3] m: they stand in rows behind the first, wherever they have been."""
    row = int(np.sqrt(number))
    return np.array([APART * (number - row * row - row), 0.0, -APART * row], np.float32)


def strain(vertices: np.ndarray, edges: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The largest |l / l_0 - 1| of the edges at each vertex [V].

    Args:
        edges: [E, 2]; rest: [E] m.
    """
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    most = np.zeros(len(vertices))
    for end in edges.T:
        np.maximum.at(most, end, np.abs(length / rest - 1.0))
    return most
