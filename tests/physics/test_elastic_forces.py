"""Elastic forces in closed form are minus the gradient of the elastic energies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import MATERIAL, sheet

from clothjax.physics import elastic_forces, energies


def elastic(position, rest, mesh):
    return elastic_forces.elastic(position, rest, MATERIAL, mesh, elastic_forces.around(mesh, len(position)))


def energy(position, rest, mesh):
    of_faces = (rest.inverse, rest.face_area, MATERIAL.mu, MATERIAL.lam)
    of_hinges = (rest.hinge_area, rest.hinge_angle, MATERIAL.bending)
    stretched = energies.stretching(position[mesh.faces], *of_faces)
    return jnp.sum(stretched) + jnp.sum(energies.bending(position[mesh.hinges], *of_hinges))


@pytest.mark.parametrize("rough", [1e-3, 0.02, 0.2])
def test_they_are_minus_the_gradient_of_the_energies(rough):
    """In float64, of a sheet that is hardly bent, creased, and crumpled so that hinges fold over."""
    with jax.enable_x64(True):
        vertices, mesh = sheet(7)
        rest = energies.rest_measures(vertices, mesh)
        rest = rest._replace(hinge_angle=rest.hinge_angle + 0.3)
        position = jnp.asarray(vertices + rough * np.random.default_rng(0).normal(size=vertices.shape))
        expected = -jax.grad(energy)(position, rest, mesh)
        found = elastic(position, rest, mesh)
        np.testing.assert_allclose(found, expected, atol=1e-9 * float(jnp.abs(expected).max()))


def test_they_are_finite_where_faces_have_no_area():
    vertices, mesh = sheet(4)
    rest = energies.rest_measures(vertices, mesh)
    for position in (np.zeros_like(vertices), vertices * [1, 1, 0]):
        found = elastic(jnp.asarray(position, jnp.float32), rest, mesh)
        assert np.isfinite(found).all()


def test_they_add_up_to_nothing():
    """No force on the whole and no torque: the cloth cannot pull itself along."""
    with jax.enable_x64(True):
        vertices, mesh = sheet(7)
        rest = energies.rest_measures(vertices, mesh)
        position = jnp.asarray(vertices + 0.03 * np.random.default_rng(1).normal(size=vertices.shape))
        found = elastic(position, rest, mesh)
        np.testing.assert_allclose(found.sum(axis=0), 0, atol=1e-9)
        np.testing.assert_allclose(jnp.cross(position, found).sum(axis=0), 0, atol=1e-9)
