"""Forces on the vertices of a garment, by kind."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import sheet, time_step

from clothjax.config import PhysicsConfig
from clothjax.networks import forces
from clothjax.physics import incremental_potential


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
