"""Relaxation: a few steps down the stretching energy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clothjax.geometry import topology
from clothjax.geometry.vectors import at_corners
from clothjax.physics import energies, relaxation
from clothjax.types import Material

CLOTH = Material(jnp.float32(0.2), jnp.float32(23600.0), jnp.float32(44400.0), jnp.float32(4e-5))


@pytest.fixture(scope="module")
def sheet():
    """A sheet of 12 x 12 vertices 2 cm apart, its mesh and rest measures."""
    size = 12
    x, y = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    vertices = 0.02 * np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    corner = np.arange(size * size).reshape(size, size)
    a, b, c, d = (part.reshape(-1) for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    mesh = topology.free_mesh(np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), np.zeros(size**2, bool))
    vertices = jnp.asarray(vertices, jnp.float32)
    return vertices, mesh, energies.rest_measures(vertices, mesh)


def stretching(x, mesh, rest, cloth=CLOTH):
    corners = at_corners(x, mesh.faces)
    return jnp.sum(energies.stretching(corners, rest.inverse, rest.face_area, cloth.mu, cloth.lam))


def of(sheet, x, steps=4, free=None, cloth=CLOTH, momentum=0.0):
    _, mesh, rest = sheet
    free = jnp.ones(len(x)) if free is None else free
    return relaxation.relaxed(x, relaxation.mobility(rest, cloth, mesh, free), rest, cloth, mesh, steps, momentum)


def rough(sheet, size=1e-3):
    vertices, *_ = sheet
    return vertices + size * jnp.asarray(np.random.default_rng(0).normal(size=vertices.shape), jnp.float32)


def test_mobility_is_over_the_stiffest_direction_of_a_vertex(sheet):
    """Of a vertex alone, whose Hessian has (2 mu + lambda) along the gradients that are parallel."""
    vertices, mesh, rest = sheet
    single = topology.free_mesh(np.array([[0, 1, 2]]), np.zeros(3, bool))
    corners = jnp.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.03, 0.08, 0.0]])
    alone = energies.rest_measures(corners, single)
    hessian = jax.hessian(lambda x: stretching(x, single, alone))(corners)
    own = jnp.stack([jnp.linalg.eigvalsh(hessian[i, :, i])[-1] for i in range(3)])
    np.testing.assert_allclose(relaxation.mobility(alone, CLOTH, single, jnp.ones(3)), relaxation.RATE / own, rtol=1e-4)
    mobility = relaxation.mobility(rest, CLOTH, mesh, jnp.ones(len(vertices)))
    hessian = jax.hessian(lambda x: stretching(x, mesh, rest))(vertices)
    own = jnp.stack([jnp.linalg.eigvalsh(hessian[i, :, i])[-1] for i in range(len(vertices))])
    ratio = mobility * own / relaxation.RATE
    assert ratio.max() < 1.0 + 1e-4 and ratio.min() > 0.3  # a sum of the stiffest of each face is no less


def test_the_energy_of_roughness_falls_with_every_step(sheet):
    _, mesh, rest = sheet
    x = rough(sheet)
    found = [float(stretching(of(sheet, x, steps), mesh, rest)) for steps in range(7)]
    assert all(after < 0.7 * before for before, after in zip(found[:3], found[1:4], strict=True))
    assert all(after < before for before, after in zip(found[3:], found[4:], strict=False))
    assert found[4] < 0.1 * found[0]


def test_a_step_is_what_its_formula_says(sheet):
    _, mesh, rest = sheet
    x = rough(sheet, 1e-4)  # far from the bound of a step
    mobility = relaxation.mobility(rest, CLOTH, mesh, jnp.ones(len(x)))
    expected = x - mobility[:, None] * jax.grad(lambda x: stretching(x, mesh, rest))(x)
    np.testing.assert_allclose(of(sheet, x, 1), expected, atol=5e-7)


@pytest.mark.parametrize("momentum", [0.5, 0.7])
def test_momentum_goes_on_with_the_last_step_and_reaches_farther(sheet, momentum):
    """By the formula; on a stretch as long as the sheet; roughness, which plain steps take out faster, still falls."""
    vertices, mesh, rest = sheet
    mobility = relaxation.mobility(rest, CLOTH, mesh, jnp.ones(len(vertices)))
    x = before = rough(sheet, 1e-4)
    for _ in range(3):
        push = jax.grad(lambda x: stretching(x, mesh, rest))(x)
        x, before = x - (1 + momentum) * mobility[:, None] * push + momentum * (x - before), x
    np.testing.assert_allclose(of(sheet, rough(sheet, 1e-4), 3, momentum=momentum), x, atol=1e-6)
    long = vertices * jnp.array([[1.02, 1.0, 1.0]])
    plain, found = (stretching(of(sheet, long, 6, momentum=share), mesh, rest) for share in (0.0, momentum))
    assert found < 0.9 * plain
    assert stretching(of(sheet, rough(sheet), 6, momentum=momentum), mesh, rest) < 0.2 * stretching(
        rough(sheet), mesh, rest
    )
    far = rough(sheet, 0.02)
    assert stretching(of(sheet, far, 60, momentum=momentum), mesh, rest) < 0.01 * stretching(far, mesh, rest)


def test_smooth_folds_stay(sheet):
    """A cylinder is not stretched, so only the polygon of its edges moves."""
    vertices, *_ = sheet
    angle = vertices[:, 0] / 0.08
    bent = jnp.stack([0.08 * jnp.sin(angle), vertices[:, 1], 0.08 * jnp.cos(angle)], axis=1)
    assert jnp.abs(of(sheet, bent) - bent).max() < 2e-3 < jnp.abs(bent - vertices).max() / 10


def test_rest_and_pins_do_not_move_and_turning_commutes(sheet):
    vertices, *_ = sheet
    np.testing.assert_allclose(of(sheet, vertices), vertices, atol=1e-6)
    x, free = rough(sheet), jnp.ones(len(vertices)).at[:12].set(0.0)
    pinned = of(sheet, x, free=free)
    np.testing.assert_array_equal(pinned[:12], x[:12])
    assert jnp.all(jnp.any(pinned[12:] != x[12:], axis=1))
    turn = jnp.asarray(Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix(), jnp.float32)
    shift = jnp.array([[0.1, 0.2, -0.3]])
    turned = of(sheet, jnp.matmul(x, turn.T, precision="highest") + shift)
    np.testing.assert_allclose(turned, jnp.matmul(of(sheet, x), turn.T, precision="highest") + shift, atol=2e-6)


def test_stiffer_cloth_relaxes_alike(sheet):
    x, stiff = rough(sheet), CLOTH._replace(mu=7 * CLOTH.mu, lam=7 * CLOTH.lam)
    np.testing.assert_allclose(of(sheet, x, cloth=stiff), of(sheet, x), atol=1e-6)


def test_cloth_far_out_of_shape_moves_little_and_stays_finite(sheet):
    vertices, *_ = sheet
    for far in (20.0 * vertices, 0.0 * vertices, vertices.at[5].add(3.0)):
        for steps in (1, 4):
            moved = jnp.linalg.norm(of(sheet, far, steps) - far, axis=1)
            assert jnp.isfinite(moved).all() and moved.max() <= steps * relaxation.LONGEST * (1 + 1e-3)


def test_the_hessian_product_is_that_of_differentiation(sheet):
    """In float64, for triangles far out of shape, and for cloth that differs from face to face."""
    with jax.enable_x64():
        rng = np.random.default_rng(2)
        corners, moves = rng.normal(size=(2, 30, 3, 3))
        inverse, area, mu, lam = rng.normal(size=(30, 2, 2)), *rng.uniform(0.5, 2.0, size=(3, 30))

        def gradient(x):
            return jax.grad(lambda x: jnp.sum(energies.stretching(x, inverse, area, mu, lam)))(x)

        expected = jax.jvp(gradient, (jnp.asarray(corners),), (jnp.asarray(moves),))[1]
        found = energies.stretching_hessian_product(corners, moves, inverse, area, mu, lam)
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-15)


@pytest.mark.parametrize("momentum", [0.0, 0.6])
def test_derivatives_of_relaxation_are_those_of_its_formula(sheet, momentum):
    """By positions, rest measures and cloth, in reverse mode and as the Hessian that conditions the descent."""
    with jax.enable_x64():
        wide = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64) if x.dtype == jnp.float32 else x, (*sheet, CLOTH))
        vertices, mesh, rest, base = wide
        rng = np.random.default_rng(1)
        x, weights = vertices + 1e-3 * rng.normal(size=vertices.shape), rng.normal(size=vertices.shape)
        mobility = relaxation.mobility(rest, base, mesh, jnp.ones(len(x)))

        def plain(x, inverse, mu):
            there, cloth = rest._replace(inverse=inverse), base._replace(mu=mu)
            last = jnp.zeros_like(x)
            for _ in range(3):
                move = -(1 + momentum) * mobility[:, None] * jax.grad(lambda x: stretching(x, mesh, there, cloth))(x)
                length = jnp.sum(move * move, axis=-1, keepdims=True)
                last = move / jnp.sqrt(1.0 + length / relaxation.LONGEST**2) + momentum * last
                x += last
            return jnp.sum(weights * x * x)

        def found(x, inverse, mu):
            there, cloth = rest._replace(inverse=inverse), base._replace(mu=mu)
            return jnp.sum(weights * relaxation.relaxed(x, mobility, there, cloth, mesh, 3, momentum) ** 2)

        arguments = (x, rest.inverse, base.mu)
        for one, other in zip(*(jax.grad(f, (0, 1, 2))(*arguments) for f in (plain, found)), strict=True):
            np.testing.assert_allclose(other, one, rtol=1e-8, atol=1e-12 * np.abs(one).max())
        direction = rng.normal(size=x.shape)
        one, other = (
            jax.jvp(jax.grad(partial(f, inverse=rest.inverse, mu=base.mu)), (x,), (direction,))[1]
            for f in (plain, found)
        )
        np.testing.assert_allclose(other, one, rtol=1e-8, atol=1e-10 * np.abs(one).max())
        several = jnp.stack([x, vertices])
        each = jax.vmap(jax.grad(found), (0, None, None))(several, *arguments[1:])
        np.testing.assert_allclose(each[0], jax.grad(found)(*arguments), rtol=1e-8, atol=1e-12)
