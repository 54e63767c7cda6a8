"""The reference solver against closed forms, another optimiser and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
from samples import DT, sheet, time_step

from clothjax.config import PhysicsConfig
from clothjax.physics import energies, hessians, incremental_potential, solver

CONFIG = PhysicsConfig()


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def crumpled(seed=0, **kwargs):
    """A small sheet thrown at the ground, deep in it in places: everything in the potential counts."""
    vertices, mesh = sheet()
    random = np.random.default_rng(seed)
    position = vertices + 0.01 * random.standard_normal(vertices.shape)
    velocity = 0.01 * random.standard_normal(vertices.shape)
    return time_step(vertices, mesh, position, velocity, ground=-5e-3, touching=True, **kwargs), mesh


def nothing_pinned(step):
    return np.zeros(len(step.position), bool)


def potential(step, mesh):
    with jax.enable_x64(True):
        function = jax.jit(jax.value_and_grad(lambda x: incremental_potential.potential(x, step, mesh, CONFIG)))

    def evaluate(flat):
        with jax.enable_x64(True):
            value, gradient = function(flat.reshape(-1, 3))
            return float(value), np.asarray(gradient).reshape(-1)

    return evaluate


def test_free_fall():
    vertices, mesh = sheet()
    velocity = np.broadcast_to([0.02, 0.01, -0.03], vertices.shape)
    step = time_step(vertices, mesh, velocity=velocity)
    start = vertices + 0.005 * np.random.default_rng(0).standard_normal(vertices.shape)
    new, info = solver.solve_step(start, step, mesh, nothing_pinned(step), CONFIG, tolerance=1e-9)
    assert info.converged
    fall = np.array([0.0, -energies.GRAVITY * DT**2, 0.0])
    np.testing.assert_allclose(new, vertices + velocity + fall, atol=1e-9)


def test_a_hanging_sheet_pulls_at_its_pins_with_its_weight(x64):
    """Long steps without velocity approach rest, where the pins carry the weight, and its moment."""
    vertices, mesh = sheet()
    pinned = np.isclose(vertices[:, 0], 0.0)
    hanging = vertices[:, [1, 0, 2]] * [1, -1, 1]
    step = time_step(vertices, mesh, hanging, dt=1e3)
    new, info = solver.solve_step(hanging, step, mesh, pinned, CONFIG, tolerance=1e-8)
    assert info.converged
    still = step._replace(mass=np.zeros_like(step.mass))
    force = -np.asarray(jax.grad(incremental_potential.potential)(new, still, mesh, CONFIG))
    weight = energies.GRAVITY * step.mass
    np.testing.assert_allclose(force[~pinned, 1], weight[~pinned], rtol=1e-5)
    np.testing.assert_allclose(force[pinned].sum(axis=0), [0, -weight[~pinned].sum(), 0], atol=1e-6)
    np.testing.assert_array_equal(new[pinned], hanging[pinned])
    # it is longer than at rest, most of all where it carries most
    row = new.reshape(6, 6, 3)[:, 2, 1]
    lengths = -np.diff(row)
    assert (np.diff(lengths) < 0).all() and lengths[-1] > 0.06


def test_a_dropped_sheet_rests_on_the_ground():
    vertices, mesh = sheet()
    step = time_step(vertices, mesh, ground=0.0, touching=True)
    new, info = solver.solve_step(vertices, step, mesh, nothing_pinned(step), CONFIG, tolerance=1e-9)
    assert info.converged
    # 3 k (offset - y)^2 = g m + m y / dt^2, vertex by vertex; the sheet is so soft that it changes little
    mass = step.mass.sum() / len(vertices)
    a, b, c = 3 * CONFIG.collision_stiffness, energies.GRAVITY * mass, mass / DT**2
    depth = CONFIG.collision_offset - np.linspace(0, 3e-3, 100001)
    height = CONFIG.collision_offset - depth[np.argmin(np.abs(a * depth**2 - b - c * (3e-3 - depth)))]
    np.testing.assert_allclose(new[:, 1].mean(), height, atol=1e-5)


def test_the_gradient_vanishes_where_it_says():
    step, mesh = crumpled()
    pinned = np.arange(36) < 4
    new, info = solver.solve_step(step.position, step, mesh, pinned, CONFIG, tolerance=1e-6)
    value, gradient = potential(step, mesh)(new)
    gradient = gradient.reshape(-1, 3)[~pinned]
    weights = energies.GRAVITY * step.mass[~pinned]
    assert info.converged and info.relative_gradient <= 1e-6
    rounding = 1e-12 * np.linalg.norm(weights)
    np.testing.assert_allclose(np.linalg.norm(gradient), info.gradient_norm, rtol=1e-6, atol=rounding)
    np.testing.assert_allclose(info.relative_gradient, info.gradient_norm / np.linalg.norm(weights), rtol=1e-12)
    np.testing.assert_allclose(info.energy, value, rtol=1e-12)
    np.testing.assert_array_equal(new[pinned], step.position[pinned])


@pytest.mark.parametrize("seed", range(3))
def test_not_above_the_minimum_of_another_optimiser(seed):
    step, mesh = crumpled(seed)
    _, info = solver.solve_step(step.position, step, mesh, nothing_pinned(step), CONFIG)
    options = {"maxiter": 5000, "maxfun": 20000, "ftol": 1e-15, "gtol": 1e-9, "maxcor": 30}
    other = scipy.optimize.minimize(
        potential(step, mesh), step.position.reshape(-1), jac=True, method="L-BFGS-B", options=options
    )
    # of 5e-3 J; both find the same minimum of the many
    assert info.converged
    assert info.energy <= other.fun + 1e-9


def test_the_result_is_a_minimum():
    """The Hessian there is positive definite: neither a saddle nor a maximum."""
    step, mesh = crumpled()
    new, info = solver.solve_step(step.position, step, mesh, nothing_pinned(step), CONFIG)
    evaluate = potential(step, mesh)
    columns = [
        (evaluate(new.reshape(-1) + h)[1] - evaluate(new.reshape(-1) - h)[1]) / 2e-7 for h in 1e-7 * np.eye(new.size)
    ]
    assert info.converged
    assert np.linalg.eigvalsh(0.5 * (np.array(columns) + np.transpose(columns))).min() > 0


def hessian_of(x, step, mesh):
    """The Hessian, dense, and the blocks on the diagonal of the semidefinite one."""
    pattern = hessians.structure(step, mesh)
    with jax.enable_x64(True):
        blocks, diagonal = hessians.blocks(x, jax.tree.map(jnp.asarray, step), mesh, pattern, CONFIG)
    return scipy.sparse.bsr_array((blocks, pattern.indices, pattern.indptr)).toarray(), diagonal


@pytest.mark.parametrize("edges", [False, True])
@pytest.mark.parametrize("self_contact", [False, True])
def test_hessian_is_that_of_finite_differences(edges, self_contact):
    step, mesh = crumpled(edges=edges, self_contact=self_contact)
    x = step.position + step.velocity
    exact, diagonal = hessian_of(x, step, mesh)
    evaluate = potential(step, mesh)
    for seed in range(5):
        direction = np.random.default_rng(seed).standard_normal(x.size)
        ahead, behind = (evaluate(x.reshape(-1) + s * direction)[1] for s in (1e-7, -1e-7))
        expected = (ahead - behind) / 2e-7
        np.testing.assert_allclose(exact @ direction, expected, atol=1e-5 * np.abs(expected).max())
    assert np.linalg.eigvalsh(exact).min() < 0  # a start that is worth testing
    np.testing.assert_allclose(diagonal, diagonal.transpose(0, 2, 1), atol=1e-9)
    assert np.linalg.eigvalsh(diagonal).min() > 0


def test_faces_of_hardly_any_area_have_the_hessian_of_the_energy():
    step, mesh = crumpled()
    x = step.position.copy()
    x[7] = x[8] + 1e-9  # an edge, of two faces
    exact, diagonal = hessian_of(x, step, mesh)
    with jax.enable_x64(True):
        expected = jax.hessian(lambda x: incremental_potential.potential(x, step, mesh, CONFIG))(jnp.asarray(x))
    expected = np.asarray(expected).reshape(x.size, x.size)
    np.testing.assert_allclose(exact, expected, atol=1e-9 * np.abs(expected).max())
    assert np.isfinite(diagonal).all()


@pytest.mark.parametrize("contact", [{}, {"ground": 1e-3, "edges": True, "self_contact": True}])
def test_the_semidefinite_hessian_is_exact_under_tension(contact):
    """Flat and pulled everywhere, without friction, free or in the ground: nothing was cut off."""
    vertices, mesh = sheet()
    exact, diagonal = hessian_of(1.05 * vertices, time_step(vertices, mesh, **contact), mesh)
    own = exact.reshape(len(vertices), 3, len(vertices), 3)[np.arange(len(vertices)), :, np.arange(len(vertices))]
    np.testing.assert_allclose(diagonal, own, atol=1e-9 * np.abs(exact).max())


def test_the_start_does_not_matter_where_the_potential_is_convex():
    """A pulled sheet in a short step: inertia outweighs everything that buckles."""
    vertices, mesh = sheet()
    pinned = np.isclose(vertices[:, 0], 0.0) | np.isclose(vertices[:, 0], 0.3)
    pulled = vertices * [1.05, 1, 1]
    step = time_step(vertices, mesh, pulled)
    ends = []
    for seed in range(3):
        start = pulled + 0.02 * np.random.default_rng(seed).standard_normal(pulled.shape)
        start[pinned] = pulled[pinned]
        new, info = solver.solve_step(start, step, mesh, pinned, CONFIG, tolerance=1e-7)
        assert info.converged
        ends.append(new)
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-7)
    np.testing.assert_allclose(ends[2], ends[0], atol=1e-7)


def test_too_few_iterations_are_no_convergence():
    step, mesh = crumpled()
    new, info = solver.solve_step(step.position, step, mesh, nothing_pinned(step), CONFIG, max_iterations=1)
    assert not info.converged and info.iterations == 1
    assert info.energy < potential(step, mesh)(step.position)[0]
    assert np.isfinite(new).all()


def test_a_minimum_is_left_alone():
    step, mesh = crumpled()
    new, _ = solver.solve_step(step.position, step, mesh, nothing_pinned(step), CONFIG)
    again, info = solver.solve_step(new, step, mesh, nothing_pinned(step), CONFIG)
    assert info.converged and info.iterations == 0
    np.testing.assert_array_equal(again, new)


def test_everything_pinned_is_solved_at_once():
    step, mesh = crumpled()
    new, info = solver.solve_step(step.position, step, mesh, np.ones(36, bool), CONFIG)
    assert info.converged and info.iterations == 0 and info.relative_gradient == 0
    np.testing.assert_array_equal(new, step.position)


def test_float32_in_float64_out_and_no_change_to_the_process():
    step, mesh = crumpled()
    single = jax.tree.map(lambda a: np.float32(a) if np.asarray(a).dtype == np.float64 else a, step)
    new, info = solver.solve_step(single.position, single, mesh, nothing_pinned(step), CONFIG, tolerance=1e-8)
    assert new.dtype == np.float64 and info.converged  # a tolerance that float32 could not reach
    assert jnp.ones(3).dtype == np.float32


def test_structure_holds_every_pair_of_neighbours_once():
    step, mesh = crumpled(edges=True, self_contact=True)
    pattern = hessians.structure(step, mesh)
    expected = np.eye(36, dtype=bool)
    for corners in (*mesh.faces, *mesh.hinges):
        expected[np.ix_(corners, corners)] = True
    apart = expected.sum()
    for vertex, corners in enumerate(step.self_contact.corners):
        both = [vertex, *corners]
        expected[np.ix_(both, both)] = True
    row = np.repeat(np.arange(36), np.diff(pattern.indptr))
    assert len(row) == expected.sum() > apart and expected[row, pattern.indices].all()


def test_mistakes_are_named():
    step, mesh = crumpled()
    start = step.position.copy()
    start[7, 1] = np.nan
    with pytest.raises(ValueError, match=r"new0\[7\]"):
        solver.solve_step(start, step, mesh, nothing_pinned(step), CONFIG)
    mass = step.mass.copy()
    mass[3] = 0
    with pytest.raises(ValueError, match="vertex 3 has mass"):
        solver.solve_step(step.position, step._replace(mass=mass), mesh, nothing_pinned(step), CONFIG)
