"""Motion matching (Clavet, GDC 2016; Holden et al. 2020): a character, made of clips, that goes where a player says.

Every few frames, a search finds the frame of all clips that best fits the character's motion and the player's wish.
If it fits better than the present frame, the character continues from it, and the jump is inertialised away (Bollo, GDC
2018). Clips need not turn: the character is also steered.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation

from clothjax.body import skinning
from clothjax.types import Motion, Pose

AHEAD = (1 / 3, 2 / 3, 1.0)  # s, times of the matched trajectory
SMOOTH = 1.7  # s, window that smooths the path of the hips to that of the character
# the wish counts more than the present motion: few clips have a start, a stop and every turn between their frames
WEIGHTS = {"path": 3.0, "facing": 1.5, "feet": 0.75, "feet_velocity": 1.0, "hips_velocity": 1.0}
MIN_DEVIATION = 0.1  # m, m/s: the deviation of features that hardly differ
SEARCH_INTERVAL = 6  # frames from search to search
SWITCH_GAIN = 1.0  # squared distance of features that another frame must save
VELOCITY_HALFLIFE = 0.25  # s, half-life of the difference from the player's wish
BLEND = 0.12  # s, half-life of the springs that remove jumps
STEER = np.radians(110.0)  # rad/s, the most that steering adds to the turns of the clips
TURN_RATE_FACTOR = 1.5  # how many times as fast as in the clips a joint may turn
MIN_TURN_RATE = 1.0  # rad/s, the limit of a joint that hardly turns in the clips


class Library(NamedTuple):
    """The N frames of all clips in a row, relative to the character's place on the ground and its heading."""

    rotations: np.ndarray  # [N, J, 3, 3] local; the root's without the heading
    root: np.ndarray  # [N, 3] m, place of the root joint
    origin: np.ndarray  # [3] m, place of the root joint in the canonical pose
    velocity: np.ndarray  # [N, 2] m/s, of the character: sideways, ahead
    turn: np.ndarray  # [N] rad/s, rate at which the heading turns
    features: np.ndarray  # [N, F] weighted, in standard deviations
    mean: np.ndarray  # [F]
    scale: np.ndarray  # [F] factors of the features: weight over standard deviation
    family: np.ndarray  # [N] family of the frame's clip: an index into `families`
    left: np.ndarray  # [N] frames that follow in the same clip
    families: tuple[str, ...]
    fastest: np.ndarray  # [J] rad/s, largest rate of each joint in all clips
    fps: float


def library(
    clips: Mapping[str, Motion], joints: np.ndarray, parents: Sequence[int] | np.ndarray, names: Sequence[str]
) -> Library:
    """Build a library of clips; names that differ only in a final number are a family ("walk_0", "walk_1").

    Args:
        joints: [J, 3] m of the body.
        parents: of the joints.
        names: of the joints.

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
    positions = jax.jit(jax.vmap(lambda rotations: skinning.forward_kinematics(rotations, joints, parents)[1]))
    families = tuple(dict.fromkeys(_family(name) for name in clips))
    parts: list[dict[str, np.ndarray]] = []
    for name, clip in clips.items():
        if clip.fps != fps or len(clip.rotations) < fps:
            raise ValueError(
                f"{name} has {len(clip.rotations)} frames at {clip.fps} a second; it needs at least a second at {fps}"
            )
        parts.append(_frames(clip, positions, feet))
        parts[-1]["family"] = np.full(len(clip.rotations), families.index(_family(name)))
    frames = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    blocks = [frames[name].reshape(len(frames["turn"]), -1) for name in WEIGHTS]
    features = np.concatenate(blocks, axis=1)
    # one deviation for all features of a kind, so that they keep their proportions
    deviations = [max(block.std(axis=0).mean(), MIN_DEVIATION) for block in blocks]
    scale = np.concatenate(
        [
            np.full(block.shape[1], weight / deviation)
            for weight, block, deviation in zip(WEIGHTS.values(), blocks, deviations, strict=True)
        ]
    )
    mean = features.mean(axis=0)
    fastest = np.max([part["speed"].max(axis=0) for part in parts], axis=0)
    return Library(
        rotations=frames["rotations"],
        root=frames["root"],
        origin=joints[0],
        velocity=frames["velocity"],
        turn=frames["turn"],
        features=(features - mean) * scale,
        mean=mean,
        scale=scale,
        family=frames["family"],
        left=frames["left"],
        families=families,
        fastest=np.maximum(fastest, MIN_TURN_RATE / TURN_RATE_FACTOR),
        fps=float(fps),
    )


def _family(name: str) -> str:
    """Strip the final number of a clip's name."""
    return name.rstrip("0123456789").rstrip("_")


def _frames(clip: Motion, positions: Callable, feet: list[int]) -> dict[str, np.ndarray]:
    """Return the per-frame fields of `Library` for one clip, and its features by kind.

    Args:
        positions: from local rotations [T, J, 3, 3] to joint positions [T, J, 3] m.
    """
    fps, count = clip.fps, len(clip.rotations)
    rotations, translation = (np.asarray(x, np.float64) for x in (clip.rotations, clip.translation))
    places = np.asarray(positions(rotations.astype(np.float32))) + translation[:, None]
    window = min(int(SMOOTH * fps) | 1, count - 1 | 1)
    ground = np.asarray(savgol_filter(places[:, 0, [0, 2]], window, 2, axis=0))
    root = rotations[:, 0]
    facing = np.unwrap(np.arctan2(root[:, 0, 2] - root[:, 2, 0], root[:, 0, 0] + root[:, 2, 2]))
    facing = np.asarray(savgol_filter(facing, window, 2))
    velocity = np.gradient(ground, axis=0) * fps

    def own(vectors: np.ndarray) -> np.ndarray:
        """Express horizontal vectors [T, ..., 2] in the frame of the character."""
        return _rotate(vectors, -facing.reshape(count, *[1] * (vectors.ndim - 2)))

    path, ahead = [], []
    for seconds in AHEAD:
        then = np.arange(count) + round(seconds * fps)
        beyond = np.maximum(then - count + 1, 0)[:, None] / fps
        there = ground[np.minimum(then, count - 1)] + beyond * velocity[-1]
        path.append(own(there - ground))
        angle = facing[np.minimum(then, count - 1)] - facing
        ahead.append(np.stack([np.sin(angle), np.cos(angle)], axis=-1))
    relative = places - np.concatenate([ground[:, :1], np.zeros((count, 1)), ground[:, 1:]], axis=1)[:, None]
    relative[..., [0, 2]] = own(relative[..., [0, 2]])
    speed = np.gradient(relative, axis=0) * fps
    faced = rotations.copy()
    faced[:, 0] = Rotation.from_rotvec(np.stack([0 * facing, -facing, 0 * facing], axis=1)).as_matrix() @ root
    return {
        "rotations": faced,
        "root": relative[:, 0],
        "velocity": own(velocity),
        "turn": np.gradient(facing) * fps,
        "left": np.arange(count)[::-1].copy(),
        "speed": fps * np.linalg.norm(_rotation_vectors(faced[1:], faced[:-1]), axis=-1),
        "path": np.stack(path, axis=1),
        "facing": np.stack(ahead, axis=1),
        "feet": relative[:, feet],
        "feet_velocity": speed[:, feet],
        "hips_velocity": speed[:, 0],
    }


def _rotate(vectors: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Rotate horizontal vectors [..., 2], x and z, about +Y."""
    sine, cosine = np.sin(angle), np.cos(angle)
    x, z = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x + sine * z, cosine * z - sine * x], axis=-1)


def _rotation_vectors(after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return the rotation vectors [..., 3] that take the rotation matrices `before` to `after`."""
    matrices = after @ np.swapaxes(before, -1, -2)
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_rotvec().reshape(*matrices.shape[:-2], 3)


def _apply(vectors: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """Apply rotation vectors [J, 3] to rotation matrices [J, 3, 3]."""
    return Rotation.from_rotvec(vectors).as_matrix() @ matrices


class Player:
    """A character that a player steers: each `step` gives the pose of its next frame.

    Args:
        clips: the library from which its motion is taken.
        wander: the families in which it moves when no other is requested; default all.
    """

    def __init__(self, clips: Library, wander: Sequence[str] | None = None):
        self.clips = clips
        self.wander = tuple(clips.families if wander is None else wander)
        self.place, self.heading = np.zeros(2), 0.0
        self.velocity = np.zeros(2)  # m/s, smoothed velocity of the player's wish
        self._joints = np.zeros(clips.rotations.shape[1:-1])
        self._joint_speed = np.zeros_like(self._joints)
        self._root, self._root_speed = np.zeros(3), np.zeros(3)
        self._since = self._now = 0
        self._now, _ = self._search(self._query(None, np.zeros(2), 0.0), self._allowed(None))
        self._shown = clips.rotations[self._now]

    def step(self, velocity: np.ndarray, facing: float | None = None, family: str | None = None) -> Pose:
        """Advance by one frame and return its pose.

        Args:
            velocity: [2] m/s in the world, x and z, that the player wishes.
            facing: rad from +z to +x, the heading that the player wishes; default that of the velocity, or none.
            family: the only family of clips to use, such as "jump"; default those of `wander`.

        Raises:
            ValueError: for an unknown family.
        """
        clips, dt = self.clips, 1.0 / self.clips.fps
        velocity = np.asarray(velocity, np.float64)
        heading = self.heading if facing is None else facing
        if facing is None and np.linalg.norm(velocity) > 0.1:
            heading = np.arctan2(velocity[0], velocity[1])
        off = (heading - self.heading + np.pi) % (2 * np.pi) - np.pi
        allowed = self._allowed(family)
        self._since += 1
        ended = clips.left[self._now] == 0
        if ended or not allowed[self._now] or self._since >= SEARCH_INTERVAL:
            best, gain = self._search(self._query(self._now, velocity, off), allowed)
            if ended or not allowed[self._now] or gain > SWITCH_GAIN:
                self._transition(best)
            self._since = 0
        self._now += int(clips.left[self._now] > 0)
        self._advance(velocity, off, dt)
        pose = _apply(self._joints, clips.rotations[self._now])
        step = _rotation_vectors(pose, self._shown)
        largest = TURN_RATE_FACTOR * clips.fastest * dt
        length = np.linalg.norm(step, axis=-1)
        share = np.minimum(1.0, largest / np.maximum(length, 1e-12))
        self._shown = _apply(share[:, None] * step, self._shown)
        rotations = self._shown.copy()
        rotations[0] = _apply(np.array([[0.0, self.heading, 0.0]]), rotations[:1])[0]
        root = clips.root[self._now] + self._root
        ground = self.place + _rotate(root[[0, 2]], self.heading)
        translation = np.array([ground[0], root[1], ground[1]]) - clips.origin
        return Pose(rotations.astype(np.float32), translation.astype(np.float32))

    def _advance(self, wish: np.ndarray, off: float, dt: float) -> None:
        """Advance place, heading and the remainder of the last jump by one frame."""
        clips = self.clips
        self.velocity += (wish - self.velocity) * (1.0 - 0.5 ** (dt / VELOCITY_HALFLIFE))
        self.place = self.place + dt * _rotate(clips.velocity[self._now], self.heading)
        steer = np.clip(np.log(2.0) / VELOCITY_HALFLIFE * off, -STEER, STEER)
        self.heading += dt * (clips.turn[self._now] + steer)
        self._joints, self._joint_speed = _decayed(self._joints, self._joint_speed, dt)
        self._root, self._root_speed = _decayed(self._root, self._root_speed, dt)

    def _transition(self, target: int) -> None:
        """Continue from another frame; the offset between the two, with its velocity, then decays."""
        clips, now = self.clips, self._now
        fps = clips.fps
        old, new = (np.array([max(i - (clips.left[i] == 0), 0), i + (clips.left[i] > 0)]) for i in (now, target))
        speeds = [_rotation_vectors(clips.rotations[i[1]], clips.rotations[i[0]]) * fps for i in (old, new)]
        moves = [(clips.root[i[1]] - clips.root[i[0]]) * fps for i in (old, new)]
        self._joints = _rotation_vectors(_apply(self._joints, clips.rotations[now]), clips.rotations[target])
        self._joint_speed = self._joint_speed + speeds[0] - speeds[1]
        self._root = self._root + clips.root[now] - clips.root[target]
        self._root_speed = self._root_speed + moves[0] - moves[1]
        self._now = target

    def _allowed(self, family: str | None) -> np.ndarray:
        """Return a mask [N] of the frames of a family; None: of those in `wander`."""
        if family is not None and family not in self.clips.families:
            raise ValueError(f"no clips called {family!r}: there are {', '.join(self.clips.families)}")
        chosen = self.wander if family is None else (family,)
        numbers = [self.clips.families.index(name) for name in chosen]
        return np.isin(self.clips.family, numbers)

    def _query(self, now: int | None, wish: np.ndarray, off: float) -> np.ndarray:
        """Return the features of frame `now`, with the wished trajectory: its velocity and a turn by `off` rad."""
        clips = self.clips
        query = np.zeros(clips.features.shape[1]) if now is None else clips.features[now] / clips.scale + clips.mean
        path, facing = [], []
        for seconds in AHEAD:
            rest = 0.5 ** (seconds / VELOCITY_HALFLIFE)
            lag = VELOCITY_HALFLIFE / np.log(2.0) * (1.0 - rest)
            path.append(_rotate(wish * (seconds - lag) + self.velocity * lag, -self.heading))
            facing.append([np.sin(off * (1.0 - rest)), np.cos(off * (1.0 - rest))])
        query[: 4 * len(AHEAD)] = np.concatenate([np.ravel(path), np.ravel(facing)])
        return (query - clips.mean) * clips.scale

    def _search(self, query: np.ndarray, allowed: np.ndarray) -> tuple[int, float]:
        """Return the best frame, and how much lower its cost is than the present frame's."""
        usable = allowed & (self.clips.left > SEARCH_INTERVAL)
        cost = np.sum((self.clips.features - query) ** 2, axis=1)
        best = int(np.argmin(np.where(usable, cost, np.inf)))
        return best, cost[self._now] - cost[best]


def _decayed(offset: np.ndarray, speed: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Decay an offset and its velocity towards zero for `dt` seconds: the exact critically damped spring."""
    rate = 2.0 * np.log(2.0) / BLEND
    push = speed + rate * offset
    fade = np.exp(-rate * dt)
    return fade * (offset + dt * push), fade * (speed - rate * dt * push)
