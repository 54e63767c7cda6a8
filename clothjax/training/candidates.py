"""Candidates: the faces of the body that a vertex of a garment comes near to, in rollouts of Phi."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.geometry.proximity import nearest_point
from clothjax.networks import animators
from clothjax.physics import contact_search
from clothjax.simulation import characters, rollout
from clothjax.simulation.scene import Scene
from clothjax.training import pool, sampling
from clothjax.types import Array, Pose

FRAMES = 30  # of a rollout
NEAR = 0.05  # m, what comes no nearer is counted only where nothing does


def make_rollout(scene: Scene, config: Config) -> Callable:
    """Return a function that rolls Phi out on a random clip, body and material; it says what the vertices are near to.

    Its arguments are a random key, Phi's `params` and `statistics`, and clips. It returns the face [T, V] whose
    centroid is nearest to each vertex, and its distance [T, V] m.
    """

    def sequence(key: Array, model: dict, clips: Clips) -> tuple[Array, Array]:
        character, poses = pool.draw(key, scene, clips, config, FRAMES)
        animator = animators.phi_animator(model, scene, character, config)
        positions = rollout.play(animator, scene, character, poses, config).position

        def nearest(inputs: tuple[Pose, Array]) -> tuple[Array, Array]:
            poses, position = inputs
            body = characters.window(scene, character, poses).following.body
            points, _ = contact_search.centroids(body, jnp.asarray(scene.body.faces))
            face = nearest_point(position, points)
            return face, jnp.linalg.norm(position - points[face], axis=-1)

        return jax.lax.map(nearest, (poses, positions))

    return sequence


def measure(
    model: dict,
    scene: Scene,
    clips: Clips,
    config: Config,
    progress: Callable[[int], None] = lambda _: None,
    device_mesh: Mesh | None = None,
) -> np.ndarray:
    """Return the faces [V, K] int32 that each vertex is near to most often, K being `labels.candidates`.

    Args:
        model: Phi's `params` and `statistics`.
        progress: called with the number of rollouts done.
        device_mesh: each device rolls out a part of them.
    """
    settings = config.labels
    keys = sampling.keys(settings.seed, settings.candidate_rollouts)
    arguments = (model, jax.tree.map(jnp.asarray, clips))
    faces, distances = sampling.make_sampler(make_rollout(scene, config), device_mesh)(keys, arguments, progress)
    vertices = faces.shape[-1]
    good = np.isfinite(distances).all(axis=-1)
    return most_frequent(faces[good], distances[good], len(scene.body.faces), settings.candidates).reshape(vertices, -1)


def most_frequent(faces: np.ndarray, distances: np.ndarray, count: int, most: int) -> np.ndarray:
    """Return the `most` faces that come most often for each vertex [V, most] int32; too few end with the first again.

    Args:
        faces, distances: [n, V] nearest faces, and how far they are, in m.
        count: number of faces.
    """
    samples, vertices = faces.shape
    often = np.zeros((vertices, count), np.int64)
    weights = np.where(distances < NEAR, samples + 1, 1)  # one that is near outweighs all that are far
    np.add.at(often, (np.broadcast_to(np.arange(vertices), faces.shape), faces), weights)
    best = np.argsort(-often, axis=1, kind="stable")[:, :most]
    there = np.take_along_axis(often, best, axis=1) > 0
    return np.where(there, best, best[:, :1]).astype(np.int32)
