"""Forces on the vertices of a garment, by kind."""

import dataclasses

import jax
import numpy as np
import pytest
from samples import sheet, time_step

from clothjax.config import PhysicsConfig
from clothjax.networks import forces
from clothjax.physics import incremental_potential


@pytest.mark.parametrize("without", [(), ("bending",), ("gravity",), ("bending", "gravity")])
def test_a_kind_is_minus_the_gradient_of_its_energies_that_there_are(without):
    """In float64, of a creased sheet that moves over ground which is not felt."""
    config = dataclasses.replace(PhysicsConfig(), without=without)
    with jax.enable_x64(True):
        vertices, mesh = sheet(5)
        random = np.random.default_rng(0)
        step = time_step(vertices, mesh, velocity=0.01 * random.normal(size=vertices.shape))
        step = step._replace(material=step.material._replace(bending=10.0), contact=None, touching=None)
        position = vertices + 0.01 * random.normal(size=vertices.shape)
        found = forces.on_vertices(position, step, mesh, config)

        def energy(names, new):
            terms = incremental_potential.energies(new, step, mesh, config)
            return sum(terms.get(name, 0.0) for name in names)

        for kind, names in zip(found, forces.KINDS.values()):
            expected = -jax.grad(lambda new, names=names: 1.0 * energy(names, new) + 0.0 * new.sum())(position)
            np.testing.assert_allclose(kind, expected, atol=1e-9 * max(float(np.abs(expected).max()), 1.0))
