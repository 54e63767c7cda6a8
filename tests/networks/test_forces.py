"""Forces on the vertices of a garment, by kind."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import sheet, time_step

from clothjax.config import PhysicsConfig
from clothjax.geometry import clusters
from clothjax.networks import forces
from clothjax.physics import energies, incremental_potential


def creased():
    """A sheet that moves, where it is now and at a step: (step, mesh, position)."""
    vertices, mesh = sheet(5)
    random = np.random.default_rng(0)
    step = time_step(vertices, mesh, velocity=0.01 * random.normal(size=vertices.shape))
    step = step._replace(material=step.material._replace(bending=10.0), contact=None, touching=None)
    return step, mesh, vertices + 0.01 * random.normal(size=vertices.shape)


@pytest.mark.parametrize("without", [(), ("bending",), ("gravity",), ("bending", "gravity")])
def test_a_kind_is_what_its_energies_that_there_are_lose_along_the_way(without):
    """In float64, by central differences, over ground which is not felt."""
    config = dataclasses.replace(PhysicsConfig(), without=without)
    with jax.enable_x64(True):
        step, mesh, position = creased()
        found = forces.on_vertices(position, step, mesh, config)
        way = np.random.default_rng(1).normal(size=position.shape)
        for kind, names in zip(found, forces.KINDS.values()):
            before, after = (
                sum(float(terms.get(name, 0.0)) for name in names)
                for terms in (
                    incremental_potential.energies(position + h * way, step, mesh, config) for h in (-1e-6, 1e-6)
                )
            )
            assert float(jnp.sum(kind * way)) == pytest.approx((before - after) / 2e-6, rel=1e-6)


def test_elastic_forces_add_up_to_nothing():
    """No force on the whole and no torque: the cloth cannot pull itself along."""
    with jax.enable_x64(True):
        step, mesh, position = creased()
        elastic = forces.on_vertices(position, step, mesh, PhysicsConfig())[list(forces.KINDS).index("elasticity")]
        most = float(jnp.abs(elastic).max())
        assert most > 1e-3
        np.testing.assert_allclose(elastic.sum(axis=0), 0, atol=1e-12 * most)
        np.testing.assert_allclose(jnp.cross(position, elastic).sum(axis=0), 0, atol=1e-12 * most)


@pytest.mark.parametrize("radius, length", [(0.04, 0.03), (0.06, 0.045), (0.15, 0.045)])
def test_planes_over_a_round_body_are_raised_by_the_height_of_its_arcs(radius, length):
    """Around a cylinder of many facets: a polygon whose corners lie on their planes does not enter it."""
    turns = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    normals = np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1).astype(np.float32)
    count = int(np.ceil(2 * np.pi * radius / length))
    corners = radius * normals[np.arange(count) * 4000 // count]
    edges = np.stack([np.arange(count), np.roll(np.arange(count), -1)], axis=1)
    near = clusters.divided(corners, radius * normals)
    planes = forces.felt_planes(jnp.asarray(corners), (radius * normals, normals), near, jnp.asarray(edges))
    middles = np.asarray(planes.point_next)[edges].mean(axis=1)
    apart = np.linalg.norm(middles, axis=1) - radius
    height = radius * (1 - np.cos(np.pi / count))
    assert height > 1e-3 and (np.abs(apart) < 0.1 * height).all()


def test_planes_of_a_hollow_and_of_a_flat_body_are_not_raised_and_none_by_more_than_a_centimetre():
    inside = np.array([[0.05, 0, 0], [0, 0.05, 0], [0.0, 0.1, 0.0]], np.float32)  # the third edge is along a wall
    faces = inside[:, None] + np.zeros((3, 1, 3), np.float32)
    normals = np.array([[-1, 0, 0], [0, -1, 0], [0, -1, 0]], np.float32)
    near, edges = clusters.divided(inside, faces[:, 0]), np.array([[0, 1], [1, 2]], np.int32)

    def raised(normals, scale=1.0):
        at = jnp.asarray(scale * inside)
        planes = forces.felt_planes(
            at, (scale * jnp.asarray(faces[:, 0]), jnp.asarray(normals)), near, jnp.asarray(edges)
        )
        return np.linalg.norm(planes.point_next - at, axis=1)

    np.testing.assert_array_equal(raised(normals), 0.0)
    np.testing.assert_allclose(raised(-normals), [0.01, 0.01, 0.0], atol=1e-7)
    np.testing.assert_allclose(raised(-normals, 0.5), [0.05 / 8, 0.05 / 8, 0.0], atol=1e-7)


def test_a_felt_plane_is_a_spring_as_stiff_as_the_collision_energy_at_one_depth():
    offset, depths = 3e-3, jnp.array([1e-3, 2e-3, -1e-6])
    felt, cubic = (
        jax.vmap(lambda x, law=law: jax.grad(law)(x, offset))(offset - depths)
        for law in (forces.spring, energies.collision)
    )
    np.testing.assert_allclose(felt[0], cubic[0], rtol=1e-5)
    np.testing.assert_allclose(felt, [felt[0], 2 * felt[0], 0.0], rtol=1e-5)
    assert forces.DEPTH == 1e-3
