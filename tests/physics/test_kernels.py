"""The kernels in C++ compute what jax does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import sheet, time_step

from clothjax.config import PhysicsConfig
from clothjax.physics import compilers, incremental_potential, kernels, relaxation

needs_compilers = pytest.mark.skipif(
    None in map(compilers.compiler, compilers.PROGRAMS), reason="needs a C and a C++ compiler"
)
CONFIG = PhysicsConfig()
TERMS = ("stretching", "bending", "edge_collision")
OTHERS = ("gravity", "inertia", "collision", "friction")


def single(tree):
    return jax.tree.map(
        lambda leaf: np.asarray(leaf, np.float32) if np.asarray(leaf).dtype == np.float64 else leaf, tree
    )


@pytest.fixture(scope="module")
def crumpled():
    """A time step of a sheet of 400 vertices, half in the ground, bent at rest, and where its vertices go next."""
    vertices, mesh = sheet(20)
    random = np.random.default_rng(0)
    step = time_step(vertices + 0.01 * random.normal(size=vertices.shape), mesh, vertices, ground=0.0, edges=True)
    x = vertices + 0.004 * random.normal(size=vertices.shape)
    x[5] = x[4]  # faces without area
    x[30:33] = x[30]  # in one point
    return x, mesh, step


def potential(mesh, config=CONFIG):
    return lambda x, step: incremental_potential.potential(x, step, mesh, config)


@needs_compilers
@pytest.mark.parametrize("term", [*TERMS, "all"])
def test_energies_and_their_gradients_are_those_of_jax(crumpled, term):
    x, mesh, step = crumpled
    config = CONFIG if term == "all" else PhysicsConfig(without=[each for each in (*TERMS, *OTHERS) if each != term])
    with jax.enable_x64(True):
        energy, gradient = jax.device_get(jax.value_and_grad(potential(mesh, config))(x, step))
    assert energy > 0 and np.abs(gradient).max() > 0
    x, step = single((x, step))
    of_kernels = jax.jit(kernels.in_kernels(jax.value_and_grad(potential(mesh, config))))
    assert "ffi_call" in str(jax.make_jaxpr(of_kernels)(x, step))
    found, push = of_kernels(x, step)
    np.testing.assert_allclose(found, energy, rtol=2e-6)
    np.testing.assert_allclose(push, gradient, rtol=0, atol=1e-5 * np.abs(gradient).max())


@needs_compilers
def test_relaxation_and_its_derivative_are_those_of_jax(crumpled):
    x, mesh, step = crumpled
    free = np.arange(len(x)) % 7 > 0
    cotangent = np.random.default_rng(1).normal(size=x.shape)

    def relaxed(x, step, cotangent):
        mobility = relaxation.mobility(step.rest, step.material, mesh, jnp.asarray(free, x.dtype))
        new, pull = jax.vjp(lambda x: relaxation.relaxed(x, mobility, step.rest, step.material, mesh, 3), x)
        return new, pull(cotangent)[0]

    with jax.enable_x64(True):
        new, back = jax.device_get(relaxed(jnp.asarray(x), jax.tree.map(jnp.asarray, step), cotangent))
    assert np.abs(new - x)[free].max() > 1e-3 and np.abs(back - cotangent)[free].max() > 0.1
    found, pulled = jax.jit(kernels.in_kernels(relaxed))(*single((x, step, cotangent)))
    np.testing.assert_allclose(found, new, atol=1e-6)
    np.testing.assert_allclose(pulled, back, rtol=0, atol=2e-5 * np.abs(back).max())
    np.testing.assert_array_equal(found[~free], single(x)[~free])


@needs_compilers
def test_garments_of_a_batch_are_as_each_alone(crumpled):
    """Positions, measures at rest and cloth of their own, or shared."""
    x, mesh, step = single(crumpled)
    step = jax.tree.map(jnp.asarray, step)
    several = x[None] + np.float32(1e-3) * np.random.default_rng(2).normal(size=(3, *x.shape)).astype(np.float32)
    scales = jnp.array([0.5, 1.0, 2.0])

    def both(x, scale):
        rest = step.rest._replace(inverse=scale * step.rest.inverse, hinge_angle=scale * step.rest.hinge_angle)
        cloth = step.material._replace(mu=scale * step.material.mu)
        own = step._replace(rest=rest, material=cloth)
        mobility = relaxation.mobility(rest, cloth, mesh, jnp.ones(len(x)))

        def energy(x):
            return potential(mesh)(relaxation.relaxed(x, mobility, rest, cloth, mesh, 2), own)

        return jax.value_and_grad(energy)(x)

    in_kernels = kernels.in_kernels(both)
    for axes in ((0, 0), (0, None), (None, 0)):
        arguments = [each if axis == 0 else each[0] for each, axis in zip((jnp.asarray(several), scales), axes)]
        together = jax.jit(jax.vmap(in_kernels, axes))(*arguments)
        for i in range(3):
            alone = jax.jit(in_kernels)(*(each[i] if axis == 0 else each for each, axis in zip(arguments, axes)))
            for one, other in zip(alone, together):
                np.testing.assert_allclose(one, other[i], rtol=1e-6, atol=1e-6 * np.abs(one).max())


def test_jax_computes_what_kernels_cannot(crumpled, monkeypatch, capsys):
    x, mesh, step = crumpled
    with jax.enable_x64(True):  # in double precision
        traced = jax.make_jaxpr(kernels.in_kernels(potential(mesh)))(x, step)
        assert "ffi_call" not in str(traced)
    x, step = single((x, step))
    unknown = jax.make_jaxpr(kernels.in_kernels(lambda x, step, mesh: potential(mesh)(x, step)))(x, step, mesh)
    assert "ffi_call" not in str(unknown)
    assert "ffi_call" not in str(jax.make_jaxpr(potential(mesh))(x, step))  # not wrapped
    kernels._built.cache_clear()
    monkeypatch.setattr(compilers, "compiler", lambda language: None)
    compilers.register.cache_clear()
    for _ in range(2):
        assert "ffi_call" not in str(jax.make_jaxpr(kernels.in_kernels(potential(mesh)))(x, step))
    assert capsys.readouterr().out.count("no compiler for C++ on the path: install gcc or clang") == 1
    kernels._built.cache_clear()


def test_where_the_corners_of_a_vertex_are():
    corner, place = kernels.elements(np.array([[0, 1, 2], [2, 1, 3]]), 5)
    np.testing.assert_array_equal(corner, [[0, 2], [1, 1], [2, 3]])
    flat = np.append(corner.reshape(-1), -1)
    for vertex in range(5):
        at = place[:, vertex]
        np.testing.assert_array_equal(np.sort(flat[at[at < 6]]), [vertex] * (flat == vertex).sum())
    assert place.shape == (2, 5) and (place[:, 4] == 6).all()
