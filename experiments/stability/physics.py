"""Energies at random, extreme and degenerate configurations, and in float32 against float64."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import material
from clothjax.body import motion_clips
from clothjax.config import Config
from clothjax.geometry import proximity
from clothjax.physics import contact_search, incremental_potential, solver
from clothjax.physics.energies import bending, collision, friction, gravity, inertia, stretching
from clothjax.simulation import assembly, characters, time_step
from clothjax.types import EdgeContact, SelfContact

FAR = 1e3  # m from the origin
MATERIAL = {"mu": (1.6e4, 6.4e4), "lam": (3.5e3, 9.4e4), "bending": (6e-8, 1.4e-3)}
FRAME = 40  # of the walk on which precision is measured


def points(random: np.random.Generator, count: int, corners: int) -> np.ndarray:
    """Return elements [count, corners, 3] m of 0.1 um to 10 m: random, degenerate (points, lines, planes), far away."""
    size = 10.0 ** random.uniform(-7, 1, (count, 1, 1))
    shape = random.normal(size=(count, corners, 3))
    kind = random.integers(0, 8, count)
    line = random.normal(size=(count, 1, 3)) * random.normal(size=(count, corners, 1))
    shape = np.where((kind == 1)[:, None, None], line, shape)
    shape = np.where((kind == 2)[:, None, None], line.round(), shape)  # on a line, corners equal by chance
    shape[kind == 3] = shape[kind == 3][:, :1]  # a point
    shape[kind == 4, -1] = shape[kind == 4, 0]  # the last corner on the first
    shape[kind == 5, :, 1] = 0.0  # in a plane
    shape = np.where((kind == 6)[:, None, None], shape.round(), shape)  # folded flat, equal lengths, right angles
    elements = size * shape
    elements[kind == 7] += FAR
    return elements


def terms(random: np.random.Generator, count: int) -> dict[str, tuple[Callable, np.ndarray, tuple]]:
    """Return for each term its energy of one element, `count` elements, and the other arguments."""

    def unit(vectors):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    def draw(name):
        return random.uniform(*MATERIAL[name], count)

    rest = random.normal(size=(count, 2, 2)) + 2 * np.eye(2)
    inverse = np.linalg.inv(rest) / 10.0 ** random.uniform(-4, 0, (count, 1, 1))
    area = 10.0 ** random.uniform(-8, 0, count)
    angle = random.uniform(-np.pi, np.pi, count)
    mass = 10.0 ** random.uniform(-6, 0, count)
    normal = unit(random.normal(size=(count, 3)))
    normal[random.random(count) < 0.1] = 0.0  # of a face without area
    place = np.where(random.random(count) < 0.2, random.integers(0, 2, count), random.uniform(size=count))
    weights = random.dirichlet(np.ones(3), count)
    one = points(random, count, 1)[:, 0]
    slip = np.where(random.random((count, 1)) < 0.2, normal * one[:, :1], one)  # along the normal: no slip at all
    config = Config().physics

    def at_edge(ends, place, point, normal):
        return incremental_potential.edge_collision(ends, EdgeContact(place, point, normal), config)

    def on_self(corners, weights, normal):
        return incremental_potential.self_collision(
            corners, SelfContact(jnp.zeros(3, jnp.int32), weights, normal), config
        )

    def batched(energy):
        return lambda element, *rest: energy(element[None], *(x[None] for x in rest))[0]

    return {
        "stretching": (
            batched(stretching),
            points(random, count, 3),
            (inverse, area, draw("mu"), draw("lam")),
        ),
        "bending": (batched(bending), points(random, count, 4), (area, angle, draw("bending"))),
        "gravity": (lambda x, m: gravity(x[1], m), one, (mass,)),
        "inertia": (inertia, one, (mass, 10.0 ** random.uniform(-3, 0, count))),
        "friction": (batched(friction), slip, (normal, mass, random.random(count) < 0.9)),
        "collision": (
            lambda x, p, n: collision(contact_search.distance(x, p, n)),
            one,
            (one + 1e-3 * random.normal(size=one.shape), normal),
        ),
        "edge_collision": (at_edge, points(random, count, 2), (place, points(random, count, 1)[:, 0], normal)),
        "self_collision": (on_self, points(random, count, 4), (weights, normal)),
    }


def contacts(random: np.random.Generator, count: int) -> tuple[Callable, np.ndarray, tuple]:
    """Return the distance to a body with degenerate faces, and points on its corners, edges, faces, in- and outside."""
    corner = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.2, 0.2) for z in (-0.1, 0.1)])
    body = np.concatenate([corner, corner[:1], [[0.1, 0.2, 0.1]]])  # two vertices twice
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [8, 6, 4],
         [1, 5, 7], [1, 7, 3], [0, 8, 4], [7, 9, 3]]
    )  # fmt: skip
    weights = random.dirichlet(np.full(3, 0.1), count).round(1)
    weights[:, 0] = 1.0 - weights[:, 1] - weights[:, 2]
    on = np.einsum("vk,vkc->vc", weights, body[faces[random.integers(0, len(faces), count)]])
    off = np.where(random.random((count, 1)) < 0.5, 0.0, 10.0 ** random.uniform(-9, 1, (count, 1)))
    patches = proximity.patches(body, faces)

    def distances(positions):
        contact = contact_search.find(positions, *2 * (jnp.asarray(body, positions.dtype),), patches)
        return contact_search.distance(positions, contact.point_next, contact.normal_next)

    return distances, on + off * random.normal(size=(count, 3)), ()


def count_nonfinite(count: int, seed: int = 0) -> dict[str, dict[str, int]]:
    """Count the configurations of each term with an energy, gradient or Hessian product that is not finite.

    All are in float32; the Hessian is applied to a random direction.
    """
    random = np.random.default_rng(seed)
    result = {}
    for name, (energy, elements, rest) in terms(random, count).items():
        single = [jnp.asarray(x, jnp.float32) if x.dtype != bool else jnp.asarray(x) for x in (elements, *rest)]
        direction = jnp.asarray(random.normal(size=elements.shape), jnp.float32)

        def one(element, direction, *rest, energy=energy):
            def gradient(element):
                return jax.grad(energy)(element, *rest)

            return energy(element, *rest), *jax.jvp(gradient, (element,), (direction,))

        values = jax.jit(jax.vmap(one))(single[0], direction, *single[1:])
        result[name] = _counts(values, count)
    distances, positions, _ = contacts(random, count)
    positions = jnp.asarray(positions, jnp.float32)
    values = jax.jit(lambda x: (distances(x), jax.grad(lambda y: jnp.sum(distances(y)))(x)))(positions)
    result["contact"] = _counts(values, count)
    return result


def _counts(values: tuple, count: int) -> dict[str, int]:
    wrong = [~np.isfinite(np.asarray(x, np.float64).reshape(count, -1)).all(axis=1) for x in values]
    return {"configurations": count} | dict(
        zip(("energy", "gradient", "hessian"), (int(w.sum()) for w in wrong), strict=False)
    )


def precision(config: Config, away: float = 0.0) -> dict[str, dict[str, float]]:
    """Measure relative errors of float32 against float64 in the energy and the gradient of every term on a garment.

    Both get the same numbers, rounded to float32: a step of a walk, its garment shaken by a millimetre.

    Args:
        away: m, the distance of everything from the origin along all axes.
    """
    config = with_self_contact(config)
    experiment = assembly.assemble(config)
    scene = experiment.scene
    character = characters.dress(
        scene, jnp.asarray(assembly.betas(config)), material.configured_material(config), config.physics
    )
    windows = jax.tree.map(jnp.asarray, assembly.as_clips(assembly.motion(experiment, config.evaluation.motions[0])))

    @jax.jit
    def state(key):
        window = characters.window(scene, character, motion_clips.poses(windows, jnp.int32(FRAME)))
        cloth = time_step.start(character, window, 0)
        shaken = 1e-3 * jax.random.normal(key, (2, *cloth.position.shape))
        cloth = cloth._replace(position=cloth.position + shaken[0])
        step = time_step.time_step(scene, character, cloth, window, 1.0 / config.fps, config)
        return step, characters.skinned(character, window.following) + shaken[1]

    step, new = jax.tree.map(np.asarray, state(jax.random.key(0)))
    moved = step._replace(
        position=step.position + np.float32(away),
        contact=step.contact._replace(
            point=step.contact.point + np.float32(away), point_next=step.contact.point_next + np.float32(away)
        ),
        edge_contact=step.edge_contact._replace(point_next=step.edge_contact.point_next + np.float32(away)),
    )

    def evaluate(new, step):
        def energies(x):
            return incremental_potential.energies(x, step, scene.mesh, config.physics)

        return energies(new), jax.jacrev(energies)(new)

    single = jax.jit(evaluate)(new + np.float32(away), moved)
    with jax.enable_x64(True):
        double = jax.jit(evaluate)(*jax.tree.map(solver.to_float64, (new + np.float32(away), moved)))
        (energy, gradient), (exact, exact_gradient) = (jax.tree.map(solver.to_float64, x) for x in (single, double))
    return {
        name: {
            "value": float(exact[name]),
            "energy": float(abs(energy[name] - exact[name]) / max(abs(exact[name]), 1e-30)),
            "gradient": float(
                np.linalg.norm(gradient[name] - exact_gradient[name]) / max(np.linalg.norm(exact_gradient[name]), 1e-30)
            ),
        }
        for name in exact
    }


def with_self_contact(config: Config) -> Config:
    """Return the same experiment with every term."""
    return replace(config, physics=replace(config.physics, edge_contact=True, self_contact=True, self_offset=0.02))
