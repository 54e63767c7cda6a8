"""A steered character, frame by frame: its garment by Psi, and by the methods that Psi is compared with."""

import time
from collections import deque
from functools import cache, cached_property
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import skinning
from clothjax.body.motion_matching import Library, Player
from clothjax.config import Config
from clothjax.files import storage
from clothjax.geometry import topology
from clothjax.material import configured_material
from clothjax.networks import animators
from clothjax.physics import solver
from clothjax.runtime import inference, loading, specialise, trained
from clothjax.simulation import assembly, characters, reference, rollout
from clothjax.types import Material, Pose

SPEEDS = (0.0, 1.3, 2.8)  # m/s: stand, walk, run
TURN = np.radians(45.0)
METHODS = ("psi", "skinning", "phi", "solver")
APART = 1.4  # m, from one method to the next, and from one character of a crowd to the next
BEHIND = 11  # frames that a character of a crowd is behind the one before it
BODIES = 4  # that are shown, of a crowd


class Outfit:
    """A garment on a character, moved by each of the methods.

    Args:
        run: the folder of a run or of a packed model.
        count: number of characters.
        fine: whether to use the mesh of 4 000 vertices, if there is one.
    """

    def __init__(self, run: Path, betas: np.ndarray, material: Material | None, count: int = 1, fine: bool = False):
        model = loading.load(run, betas=betas, material=material)
        if fine and (garment := finer(model.config)):
            body = storage.load_body(model.config.body)
            model = specialise.on_mesh(model, storage.load_garment(garment, body, model.names), betas)
        self.model, self.count = model, count
        self._crowd = loading.crowd([model] * count)
        self._states = None
        self._run, self._betas, self._material = run, betas, material
        self._beside: dict[str, tuple] = {}

    @cached_property
    def _comparison(self) -> "Comparison":
        return _comparison(self._run)

    @cached_property
    def _character(self) -> characters.Character:
        return self._comparison.dress(self._betas, self._material)

    def mesh(self, method: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the faces [F, 3] and the vertices [V, 3] m at rest of the mesh that a method shows."""
        if method == "psi":
            return np.asarray(self.model.faces), np.asarray(self.model.wearer.template).T
        return self._comparison.faces, np.asarray(self._character.template)

    @property
    def feels_wind(self) -> bool:
        """Whether the garment's Psi feels an acceleration beside gravity."""
        return self.model.wearer.cloth is not None

    def psi(self, poses: list[Pose], wind: np.ndarray) -> np.ndarray:
        """Return vertices [N, V, 3] m of the next frame, for the characters' poses.

        Args:
            wind: [3] m/s^2, an acceleration of the cloth; not felt by every garment.
        """
        together = Pose(*(jnp.asarray(np.stack(each)) for each in zip(*poses, strict=True)))
        if self._states is None:
            self._states = jax.vmap(lambda pose: inference.initial_state(self.model, pose))(together)
        external = jnp.tile(jnp.asarray(wind, jnp.float32), (self.count, 1)) if self.feels_wind else None
        self._states, vertices = inference.step_crowd(self._crowd, self._states, together, external)
        return np.asarray(vertices)

    def beside(self, methods: list[str], window: Pose) -> dict[str, np.ndarray]:
        """Return vertices [V, 3] m of the next frame of the first character, by other methods.

        Args:
            methods: a method that was left out for a frame restarts from the skinned garment.
            window: its last three poses.
        """
        self._beside = {
            method: self._comparison.step(method, self._character, self._beside.get(method), window)
            for method in methods
        }
        return {method: vertices for method, (_, vertices) in self._beside.items()}


def finer(config: Config) -> str | None:
    """Return the garment of a configuration on 4 000 vertices, None if there is none."""
    name = config.garment.replace("_1000", "_4000")
    return name if name != config.garment and storage.asset(name).is_file() else None


@cache
def _comparison(run: Path) -> "Comparison":
    return Comparison(run)


class Comparison:
    """The methods beside Psi, frame by frame: skinning, Phi and the solver, on the mesh of the training."""

    def __init__(self, run: Path):
        self.config, model = trained.phi(run)
        self.scene, config = assembly.assemble(self.config).scene, self.config
        self.faces = np.asarray(self.scene.garment.faces)
        model = jax.tree.map(jnp.asarray, model)

        def phi(character):
            return animators.phi_animator(model, self.scene, character, config)

        def take(character, state, poses):
            return rollout.advance(phi(character), self.scene, character, state, poses, config)

        def skinned(character, poses):
            return characters.skinned(character, characters.window(self.scene, character, poses).following)

        self._settle = jax.jit(lambda character, p: rollout.settle(phi(character), self.scene, character, p, config))
        self._take, self._skinned = jax.jit(take), jax.jit(skinned)
        self._problem = reference.problem(self.scene, config)

    def dress(self, betas: np.ndarray, material: Material | None) -> characters.Character:
        """Dress a character; the material defaults to the configured one."""
        material = configured_material(self.config) if material is None else material
        material = Material(*(jnp.asarray(value, jnp.float32) for value in material))
        return characters.dress(self.scene, jnp.asarray(betas, jnp.float32), material, self.config.physics)

    def step(self, method: str, character, before: tuple | None, window: Pose) -> tuple:
        """Return a method's next state, and its next vertices [V, 3] m in the world.

        Args:
            before: the method's state; None to begin.
            window: the last three poses.
        """
        here = window.translation[1]
        poses = Pose(jnp.asarray(window.rotations), jnp.asarray(window.translation - here[None]))
        state = None if before is None else before[0]
        if method == "skinning":
            return None, np.asarray(self._skinned(character, poses)) + here
        if method == "phi":
            state, new = self._take(character, self._settle(character, poses) if state is None else state, poses)
            return state, np.asarray(new) + here
        last, now = [np.asarray(self._settle(character, poses).position)] * 2 if state is None else state
        step, _, held, advance = self._problem(character, last, now, poses)
        new, _ = solver.solve_step(held, step, self.scene.mesh, self.scene.garment.pinned, self.config.physics)
        new = np.asarray(new, np.float32)
        return (now, new - np.asarray(advance)[None]), new + here


class Steering:
    """The wishes of the player."""

    def __init__(self):
        self.gait, self.heading = 0, 0.0
        self.doing: str | None = None  # a family of clips ...
        self.until = 0  # ... up to this frame
        self.wind = 0.0  # m/s^2, along x

    def faster(self) -> None:
        self.gait = min(self.gait + 1, len(SPEEDS) - 1)

    def slower(self) -> None:
        self.gait = max(self.gait - 1, 0)

    def turn(self, by: float) -> None:
        self.heading += by

    def do(self, family: str, until: int) -> None:
        self.doing, self.until = family, until

    def velocity(self) -> np.ndarray:
        """Return the velocity [2] m/s that the player asks for."""
        return SPEEDS[self.gait] * np.array([np.sin(self.heading), np.cos(self.heading)])


class Show:
    """A player's character and its garment, frame by frame, independent of the display.

    Raises:
        ValueError: if the frame rates of the clips and the garment differ.
    """

    def __init__(self, clips: Library, wander: tuple[str, ...], run: Path):
        self.steering, self.player = Steering(), Player(clips, wander)
        self.methods: tuple[str, ...] = ("psi",)
        self.past: deque[Pose] = deque()
        self.seconds = {"psi": 0.0, "pose": 0.0}
        self.frames = 0
        self.dress(run)

    def dress(
        self,
        run: Path,
        betas: np.ndarray | None = None,
        material: Material | None = None,
        count: int = 1,
        fine: bool = False,
    ) -> None:
        """Change the garment, body or number of characters; `betas` may be the first few of the body's."""
        config = trained.configured(run)
        if config.fps != self.player.clips.fps:
            raise ValueError(f"the clips are at {self.player.clips.fps} frames a second, {run} at {config.fps}")
        self._pose_body, body = _body(config.body)
        all_betas = np.zeros(body.shapedirs.shape[-1])
        if betas is not None:
            all_betas[: len(betas)] = betas[: len(all_betas)]
        self.outfit = Outfit(run, all_betas, material, count, fine)
        self._shape = [
            shaped(body, jnp.asarray(all_betas)) for shaped in (skinning.shaped_vertices, skinning.shaped_joints)
        ]
        self.body_faces = np.asarray(body.faces)
        self.past = deque(self.past, maxlen=max(3, BEHIND * (count - 1) + 1))

    def frame(self) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
        """Return the next frame: vertices [N, V, 3] m by method, in their places, and vertices [B, 3] m of bodies."""
        began = time.perf_counter()
        steering = self.steering
        family = steering.doing if self.frames < steering.until else None
        pose = self.player.step(steering.velocity(), steering.heading, family)
        self.past.append(pose)
        self.frames += 1
        poses = [self.past[max(len(self.past) - 1 - BEHIND * i, 0)] for i in range(self.outfit.count)]
        shift = np.stack([_place(i, each, pose) for i, each in enumerate(poses)])
        bodies = [
            np.asarray(self._pose_body(*self._shape, each)) + by
            for each, by in zip(poses[:BODIES], shift, strict=False)
        ]
        paused = time.perf_counter()
        wind = np.array([steering.wind, 0.0, 0.0])
        shown = {"psi": self.outfit.psi(poses, wind) + shift[:, None]}
        self.seconds = {"psi": time.perf_counter() - paused, "pose": paused - began}
        newest = [self.past[max(len(self.past) - 3 + i, 0)] for i in range(3)]
        window = Pose(*(np.stack(each) for each in zip(*newest, strict=True)))
        others = [method for method in self.methods if method != "psi"]
        for i, (method, vertices) in enumerate(self.outfit.beside(others, window).items()):
            aside = np.array([APART * (i + 1), 0.0, 0.0], np.float32)
            shown[method] = (vertices + aside)[None]
            bodies.append(np.asarray(self._pose_body(*self._shape, pose)) + aside)
        return {method: shown[method] for method in self.methods}, bodies


@cache
def _body(name: str):
    """Load a body, and a function that poses it with given vertices and joints."""
    body = storage.load_body(name)
    return jax.jit(lambda vertices, joints, pose: skinning.pose_body(body, vertices, joints, pose)), body


def _place(number: int, pose: Pose, first: Pose) -> np.ndarray:
    """Return the offset [3] m of a character of a crowd: its place in a row behind the first."""
    row = int(np.sqrt(number))
    there = np.array([APART * (number - row * row - row), 0.0, -APART * row])
    return (there + (first.translation - pose.translation) * [1, 0, 1]).astype(np.float32)


def strain(vertices: np.ndarray, rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the largest |l / l_0 - 1| of the edges at each vertex [V].

    Args:
        rest: [V, 3] m, the mesh whose edges have the lengths l_0.
    """
    edges = topology.edges(faces)
    length, original = (np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (vertices, rest))
    most = np.zeros(len(vertices))
    for end in edges.T:
        np.maximum.at(most, end, np.abs(length / original - 1.0))
    return most
