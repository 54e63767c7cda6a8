"""Motion matching (Clavet, GDC 2016; Holden et al. 2020): a character that goes where a player says, made of clips.

Every few frames that frame of all clips is sought which fits best what the character does and is to do. Where another
than the present one fits better, the character goes on from there, and what then jumps is inertialised away (Bollo, GDC
2018). Clips need not turn: the character is steered besides.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from clothjax.body import skinning
from clothjax.types import Motion, Pose

AHEAD = (1 / 3, 2 / 3, 1.0)  # s, of the trajectory that is matched
SMOOTH = 1.7  # s, over which the way of the hips is the character's
# what is to be done counts more than what is: few clips have a start, a stop and every turn between their frames
WEIGHTS = {"path": 3.0, "facing": 1.5, "feet": 0.75, "feet_velocity": 1.0, "hips_velocity": 1.0}
LEAST = 0.1  # m, m/s: the deviation of features that hardly differ
EVERY = 6  # frames from search to search
WORTH = 1.0  # of the squared distance of features, that another frame must save
SETTLE = 0.25  # s, in which the player's wish is half come true
BLEND = 0.12  # s, half-life of the springs that take away what jumps
STEER = np.radians(110.0)  # rad/s at the most, besides what clips turn
FASTEST = 1.5  # times as fast as it does in the clips a joint may turn ...
STILL = 1.0  # rad/s, ... or as fast as this if it hardly does


class Library(NamedTuple):
    """The frames of all clips, one after the other, in the frame of the character: its place on the ground, its
    heading."""

    rotations: np.ndarray  # [N, J, 3, 3] local; the root's without the heading
    root: np.ndarray  # [N, 3] m, place of the root joint
    origin: np.ndarray  # [3] m, that in the canonical pose
    velocity: np.ndarray  # [N, 2] m/s, of the character: sideways, ahead
    turn: np.ndarray  # [N] rad/s
    features: np.ndarray  # [N, F] weighted, in standard deviations
    mean: np.ndarray  # [F]
    scale: np.ndarray  # [F] what features are multiplied with
    family: np.ndarray  # [N] of its clip: an index of `families`
    left: np.ndarray  # [N] frames of its clip that come after
    families: tuple[str, ...]
    fastest: np.ndarray  # [J] rad/s, of the joints in all clips
    fps: float


def library(
    clips: Mapping[str, Motion], joints: np.ndarray, parents: Sequence[int] | np.ndarray, names: Sequence[str]
) -> Library:
    """A library of clips; clips whose names begin alike, up to a number, are a family ("walk_0", "walk_1").

    Args:
        joints: [J, 3] m of the body; parents, names: of its joints.

    Raises:
        ValueError: if there is no clip, one is shorter than a second, they differ in frames per second, or the body's
            joints have no feet.
    """
    if not clips:
        raise ValueError("motion matching needs at least one clip")
    feet = [i for i, name in enumerate(names) if "foot" in name.lower() or "ankle" in name.lower()]
    if len(feet) < 2:
        raise ValueError(f"no feet among the joints {', '.join(names)}: their names have `foot` or `ankle` in them")
    fps = next(iter(clips.values())).fps
    joints, parents = np.asarray(joints), np.array(parents)
    positions = jax.jit(jax.vmap(lambda turn: skinning.forward_kinematics(turn, joints, parents)[1]))
    families = tuple(dict.fromkeys(_family(name) for name in clips))
    parts: list[dict[str, np.ndarray]] = []
    for name, clip in clips.items():
        if clip.fps != fps or len(clip.rotations) < fps:
            raise ValueError(
                f"{name} has {len(clip.rotations)} frames at {clip.fps} a second; a second at {fps} is least"
            )
        parts.append(_frames(clip, positions, feet))
        parts[-1]["family"] = np.full(len(clip.rotations), families.index(_family(name)))
    whole = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    blocks = [whole[name].reshape(len(whole["turn"]), -1) for name in WEIGHTS]
    features = np.concatenate(blocks, axis=1)
    # one deviation for all of a kind: its parts keep their proportions
    deviations = [max(block.std(axis=0).mean(), LEAST) for block in blocks]
    scale = np.concatenate(
        [np.full(block.shape[1], weight / by) for weight, block, by in zip(WEIGHTS.values(), blocks, deviations)]
    )
    mean = features.mean(axis=0)
    return Library(
        rotations=whole["rotations"],
        root=whole["root"],
        origin=joints[0],
        velocity=whole["velocity"],
        turn=whole["turn"],
        features=(features - mean) * scale,
        mean=mean,
        scale=scale,
        family=whole["family"],
        left=whole["left"],
        families=families,
        fastest=np.maximum(np.max([part["speed"].max(axis=0) for part in parts], axis=0), STILL / FASTEST),
        fps=float(fps),
    )


def _family(name: str) -> str:
    return name.rstrip("0123456789").rstrip("_")


def _frames(clip: Motion, positions: Callable, feet: list[int]) -> dict[str, np.ndarray]:
    """What `Library` has of the frames of one clip, and its features by kind.

    Args:
        positions: of the joints [T, J, 3] m, of their rotations.
    """
    fps, count = clip.fps, len(clip.rotations)
    rotations, translation = (np.asarray(x, np.float64) for x in (clip.rotations, clip.translation))
    places = np.asarray(positions(rotations.astype(np.float32))) + translation[:, None]
    window = min(int(SMOOTH * fps) | 1, count - 1 | 1)
    way = savgol_filter(places[:, 0, [0, 2]], window, 2, axis=0)
    root = rotations[:, 0]
    facing = np.unwrap(np.arctan2(root[:, 0, 2] - root[:, 2, 0], root[:, 0, 0] + root[:, 2, 2]))
    facing = savgol_filter(facing, window, 2)
    velocity = np.gradient(way, axis=0) * fps
    turn = np.gradient(facing) * fps

    def own(vectors: np.ndarray) -> np.ndarray:
        """Horizontal vectors [T, ..., 2] in the frame of the character."""
        return _turned(vectors, -facing.reshape(count, *[1] * (vectors.ndim - 2)))

    path, ahead = [], []
    for seconds in AHEAD:
        then = np.arange(count) + round(seconds * fps)
        beyond = np.maximum(then - count + 1, 0)[:, None] / fps
        there = way[np.minimum(then, count - 1)] + beyond * velocity[-1]
        path.append(own(there - way))
        angle = facing[np.minimum(then, count - 1)] - facing
        ahead.append(np.stack([np.sin(angle), np.cos(angle)], axis=-1))
    relative = places - np.concatenate([way[:, :1], np.zeros((count, 1)), way[:, 1:]], axis=1)[:, None]
    relative[..., [0, 2]] = own(relative[..., [0, 2]])
    speed = np.gradient(relative, axis=0) * fps
    faced = rotations.copy()
    faced[:, 0] = Rotation.from_rotvec(np.stack([0 * facing, -facing, 0 * facing], axis=1)).as_matrix() @ root
    return {
        "rotations": faced,
        "root": relative[:, 0],
        "velocity": own(velocity),
        "turn": turn,
        "left": np.arange(count)[::-1].copy(),
        "speed": fps * np.linalg.norm(_between(faced[1:], faced[:-1]), axis=-1),
        "path": np.stack(path, axis=1),
        "facing": np.stack(ahead, axis=1),
        "feet": relative[:, feet],
        "feet_velocity": speed[:, feet],
        "hips_velocity": speed[:, 0],
    }


def _turned(vectors: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Horizontal vectors [..., 2], x and z, turned about +Y."""
    sine, cosine = np.sin(angle), np.cos(angle)
    x, z = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x + sine * z, cosine * z - sine * x], axis=-1)


def _between(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The rotation vectors [..., 3] that take rotation matrices to others."""
    matrices = after @ np.swapaxes(before, -1, -2)
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(*matrices.shape[:-2], 3)


def _by(vectors: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Rotation matrices [J, 3, 3] turned by rotation vectors [J, 3]."""
    return Rotation.from_rotvec(vectors).as_matrix() @ matrices


class Player:
    """A character that is being steered.

    Args:
        clips: where it takes its motion from.
        wander: the families it moves in when no other is asked for; default all.
    """

    def __init__(self, clips: Library, wander: Sequence[str] | None = None):
        self.clips = clips
        self.wander = tuple(clips.families if wander is None else wander)
        self.place, self.heading = np.zeros(2), 0.0
        self.velocity = np.zeros(2)  # m/s, that of the player's wish, as far as it has come true
        self._joints, self._joint_speed = np.zeros((2, *clips.rotations.shape[1:-1]))
        self._root, self._root_speed = np.zeros((2, 3))
        self._since = self._now = 0
        self._now, _ = self._search(self._query(None, np.zeros(2), 0.0), self._allowed(None))
        self._shown = clips.rotations[self._now]

    def step(self, velocity: np.ndarray, facing: float | None = None, family: str | None = None) -> Pose:
        """The pose of the next frame.

        Args:
            velocity: [2] m/s in the world, x and z, that the player wishes.
            facing: rad from +z to +x, the heading that the player wishes; default that of the velocity, or none.
            family: of the clips, if it is to do that and nothing else, as "jump".

        Raises:
            ValueError: for a family that there is not.
        """
        clips, dt = self.clips, 1.0 / self.clips.fps
        velocity = np.asarray(velocity, np.float64)
        if facing is None:
            facing = np.arctan2(*velocity) if np.linalg.norm(velocity) > 0.1 else self.heading
        off = (facing - self.heading + np.pi) % (2 * np.pi) - np.pi
        allowed = self._allowed(family)
        self._since += 1
        ended = clips.left[self._now] == 0
        if ended or not allowed[self._now] or self._since >= EVERY:
            found, gain = self._search(self._query(self._now, velocity, off), allowed)
            if ended or not allowed[self._now] or gain > WORTH:
                self._transition(found)
            self._since = 0
        self._now += int(clips.left[self._now] > 0)
        self._advance(velocity, off, dt)
        pose = _by(self._joints, clips.rotations[self._now])
        step = _between(pose, self._shown)
        most = FASTEST * clips.fastest * dt
        length = np.linalg.norm(step, axis=-1)
        held = np.minimum(1.0, most / np.maximum(length, 1e-12))
        self._shown = _by(held[:, None] * step, self._shown)
        rotations = self._shown.copy()
        rotations[0] = _by(np.array([[0.0, self.heading, 0.0]]), rotations[:1])[0]
        root = clips.root[self._now] + self._root
        where = self.place + _turned(root[[0, 2]], self.heading)
        translation = np.array([where[0], root[1], where[1]]) - clips.origin
        return Pose(rotations.astype(np.float32), translation.astype(np.float32))

    def _advance(self, wish: np.ndarray, off: float, dt: float) -> None:
        """Place, heading, and what is left of the last jump, a frame on."""
        clips = self.clips
        self.velocity += (wish - self.velocity) * (1.0 - 0.5 ** (dt / SETTLE))
        self.place = self.place + dt * _turned(clips.velocity[self._now], self.heading)
        steer = np.clip(np.log(2.0) / SETTLE * off, -STEER, STEER)
        self.heading += dt * (clips.turn[self._now] + steer)
        self._joints, self._joint_speed = _decayed(self._joints, self._joint_speed, dt)
        self._root, self._root_speed = _decayed(self._root, self._root_speed, dt)

    def _transition(self, found: int) -> None:
        """Goes on from another frame: what differs is kept, with its velocity, and then decays."""
        clips, now = self.clips, self._now
        fps = clips.fps
        old, new = (np.array([max(i - (clips.left[i] == 0), 0), i + (clips.left[i] > 0)]) for i in (now, found))
        speeds = [_between(clips.rotations[i[1]], clips.rotations[i[0]]) * fps for i in (old, new)]
        moves = [(clips.root[i[1]] - clips.root[i[0]]) * fps for i in (old, new)]
        self._joints = _between(_by(self._joints, clips.rotations[now]), clips.rotations[found])
        self._joint_speed = self._joint_speed + speeds[0] - speeds[1]
        self._root = self._root + clips.root[now] - clips.root[found]
        self._root_speed = self._root_speed + moves[0] - moves[1]
        self._now = found

    def _allowed(self, family: str | None) -> np.ndarray:
        if family is not None and family not in self.clips.families:
            raise ValueError(f"no clips called {family!r}: there are {', '.join(self.clips.families)}")
        chosen = self.wander if family is None else (family,)
        numbers = [self.clips.families.index(name) for name in chosen]
        return np.isin(self.clips.family, numbers)

    def _query(self, now: int | None, wish: np.ndarray, off: float) -> np.ndarray:
        """The features of what the character does, and is to do: go like that, and turn by `off` rad."""
        clips = self.clips
        query = np.zeros(clips.features.shape[1]) if now is None else clips.features[now] / clips.scale + clips.mean
        path, facing = [], []
        for seconds in AHEAD:
            rest = 0.5 ** (seconds / SETTLE)
            lag = SETTLE / np.log(2.0) * (1.0 - rest)
            path.append(_turned(wish * (seconds - lag) + self.velocity * lag, -self.heading))
            facing.append([np.sin(off * (1.0 - rest)), np.cos(off * (1.0 - rest))])
        query[: 4 * len(AHEAD)] = np.concatenate([np.ravel(path), np.ravel(facing)])
        return (query - clips.mean) * clips.scale

    def _search(self, query: np.ndarray, allowed: np.ndarray) -> tuple[int, float]:
        """The best frame, and by how much it is better than the present one."""
        usable = allowed & (self.clips.left > EVERY)
        cost = np.sum((self.clips.features - query) ** 2, axis=1)
        found = int(np.argmin(np.where(usable, cost, np.inf)))
        return found, cost[self._now] - cost[found]


def _decayed(offset: np.ndarray, speed: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """An offset and its velocity on their way to zero: a critically damped spring, exactly."""
    rate = 2.0 * np.log(2.0) / BLEND
    push = speed + rate * offset
    fade = np.exp(-rate * dt)
    return fade * (offset + dt * push), fade * (speed - rate * dt * push)
