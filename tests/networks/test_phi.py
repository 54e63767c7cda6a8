"""Phi's guess: down the potential in the space of codes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from clothjax.physics import descent

START = jnp.array([0.3, -1.0, 0.7])
GOAL = jnp.array([1.0, 0.0, -2.0])


def descend(inverse, start, decode, potential, steps=1, bound=1e6):
    return descent.descend(lambda g: inverse @ g, start, decode, potential, steps, bound)


@pytest.fixture
def coded():
    """The garment of 5 vertices of 3 codes, its squared distance to a goal, and the inverse Hessian of that."""
    basis = np.random.default_rng(0).normal(size=(3, 5, 3)).astype(np.float32)

    def decode(latent):
        return jnp.einsum("k,kvc->vc", latent, basis, precision="highest")

    goal = decode(GOAL)

    def potential(positions):
        return jnp.sum((positions - goal) ** 2)

    return (
        descent.regularised_inverse(descent.hessian(lambda z: potential(decode(z)), jnp.zeros(3)), 1e-9),
        decode,
        potential,
    )


def test_one_step_reaches_the_minimum_of_a_quadratic(coded):
    inverse, decode, potential = coded
    np.testing.assert_allclose(descend(inverse, START, decode, potential), GOAL, atol=1e-4)
    np.testing.assert_allclose(descend(inverse, GOAL, decode, potential), GOAL, atol=1e-5)
    done = descend(inverse, START, decode, lambda x: 1e6 * potential(x), bound=0.1)
    assert float(jnp.linalg.norm(done - START)) == pytest.approx(0.1, rel=1e-2)


def test_the_descent_begins_where_the_code_is_going_unless_that_is_worse(coded):
    _, decode, potential = coded
    nearer, farther = 0.3 * (GOAL - START), 3.0 * (GOAL - START)
    np.testing.assert_array_equal(descent.warm_start(START, nearer, decode, potential), START + nearer)
    np.testing.assert_array_equal(descent.warm_start(START, farther, decode, potential), START)
    np.testing.assert_array_equal(descent.warm_start(START, jnp.full(3, jnp.nan), decode, potential), START)


def test_steps_learn_the_curvature():
    """Without a preconditioner, on an uneven quadratic: each step tells of a direction, three tell of all."""
    weights = jnp.array([1.0, 30.0, 400.0])

    def potential(positions):
        return 0.5 * jnp.sum(weights[:, None] * (positions - GOAL[:, None]) ** 2)

    def decode(latent):
        return jnp.broadcast_to(latent[:, None], (3, 3))

    def left(steps):
        done = descend(jnp.eye(3), START, decode, potential, steps)
        return float(potential(decode(done)) / potential(decode(START)))

    assert left(8) < 0.1 and left(20) < 1e-6


def test_a_descent_has_a_gradient(coded):
    """By the goal of its potential, as finite differences tell."""
    inverse, decode, _ = coded

    def end(shift):
        potential = lambda x: jnp.sum((x - decode(GOAL + shift)) ** 2) + 0.1 * jnp.sum(x**4)  # noqa: E731
        return jnp.sum(descend(inverse, START, decode, potential, 3) * jnp.arange(1.0, 4.0))

    found = jax.grad(end)(jnp.zeros(3))
    step = 1e-2 * jnp.eye(3)
    expected = [(end(by) - end(-by)) / 2e-2 for by in step]
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.02)


@pytest.mark.parametrize("first", [np.nan, np.inf])
def test_a_descent_stays_at_a_code_without_energy_and_where_it_is_worse(coded, first):
    """An energy that is no number cannot fall; an infinite one falls to any finite one, and to nothing else."""
    inverse, decode, potential = coded
    there = decode(START)
    energy = lambda x: potential(x) + jnp.where(jnp.all(x == there), first, jnp.nan)  # noqa: E731
    for steps in (0, 1, 5):
        np.testing.assert_array_equal(descend(inverse, START, decode, energy, steps), START)


@pytest.mark.parametrize("tolerance", [0.1, 1e-3, 0.0])
def test_a_descent_converges_where_little_is_left_of_what_was_gained(tolerance):
    """It takes the steps of `descend`, and counts them from the first energy on."""
    weights = jnp.array([1.0, 30.0, 400.0])

    def potential(x):
        return 0.5 * jnp.sum(weights * (x - GOAL) ** 2)

    settings = (lambda g: g / 20, START, lambda code: code, potential)
    end, count = descent.converge(*settings, steps=9, bound=1e6, tolerance=tolerance)
    np.testing.assert_allclose(end, descent.descend(*settings, int(count), 1e6), rtol=1e-6)
    step = jax.jit(lambda at: descent._step(at, jax.value_and_grad(potential), settings[0], 1e6))
    at, expected = step(descent._blank(START)), 0
    first = at.energy
    while expected < 9:
        left = -0.5 * float(at.gradient @ at.direction)
        if expected >= 2 and left <= tolerance * float(first - at.energy + 0.01):
            break
        at, expected = step(at), expected + 1
    assert int(count) == expected and (tolerance > 0) == (expected < 9)


@pytest.mark.parametrize("known, newest", [(0, 0), (1, 1), (5, 3), (5, 20), (descent.MEMORY, 7)])
def test_the_direction_is_that_of_dense_bfgs(known, newest):
    """Against the update of the whole inverse Hessian, oldest step first, begun with the scaled preconditioner."""
    random, size = np.random.default_rng(known), 40
    mixed = random.normal(size=(2, size, size))
    hessian, inverse = mixed @ mixed.transpose(0, 2, 1) + np.eye(size)
    inverse = inverse / 2000
    moves, gradient = random.normal(size=(known, size)), random.normal(size=size)
    turns = moves @ hessian
    dense = inverse
    if known:
        dense = inverse * (moves[0] @ turns[0]) / (turns[0] @ inverse @ turns[0])
        assert descent.SCALE[0] < dense[0, 0] / inverse[0, 0] < descent.SCALE[1]
    for move, turn in zip(moves[::-1], turns[::-1], strict=True):
        part = np.eye(size) - np.outer(move, turn) / (move @ turn)
        dense = part @ dense @ part.T + np.outer(move, move) / (move @ turn)
    rows = (newest - np.arange(known)) % descent.MEMORY
    with jax.enable_x64(True):
        at = descent._blank(jnp.zeros(size))
        at = at._replace(
            gradient=jnp.asarray(gradient),
            moves=at.moves.at[rows].set(moves),
            turns=at.turns.at[rows].set(turns),
            products=at.products.at[np.ix_(rows, rows)].set(moves @ turns.T),
            newest=jnp.int32(newest),
        )
        found = descent._direction(jax.tree.map(jnp.asarray, at), lambda g: inverse @ g, 1e9)
    np.testing.assert_allclose(found, -dense @ gradient, rtol=1e-9)


def test_steps_beyond_the_memory_go_as_those_of_two_loops():
    """Against algorithm 7.4 of Nocedal & Wright on the last steps, where some tries are not taken."""
    random, size, kept = np.random.default_rng(0), 60, []
    mixed = random.normal(size=(size, size))
    inverse = np.diag(random.uniform(0.5, 2.0, size)) / size

    def objective(x):
        return 0.5 * jnp.sum((mixed @ x) ** 2) + jnp.sum(x**4), mixed.T @ (mixed @ x) + 4.0 * x**3

    def direction(gradient):
        rest, along = gradient, []
        for move, turn in reversed(kept):
            along.append((move @ rest) / (move @ turn))
            rest = rest - along[-1] * turn
        move, turn = kept[-1]
        rest = np.clip((move @ turn) / (turn @ inverse @ turn), *descent.SCALE) * (inverse @ rest)
        for (move, turn), share in zip(kept, reversed(along), strict=True):
            rest = rest + (share - (turn @ rest) / (move @ turn)) * move
        return -rest / np.sqrt(1.0 + rest @ rest / 9.0)

    refused = 0
    with jax.enable_x64(True):
        settings = (objective, lambda g: jnp.asarray(inverse) @ g, 3.0)
        step = jax.jit(lambda at: descent._step(at, *settings))
        at = step(descent._blank(jnp.asarray(3.0 * random.normal(size=size))))
        for _ in range(2 * descent.MEMORY + 9):
            last, at = at, step(at)
            if at.energy == last.energy:
                refused += 1
                continue
            kept = [*kept, (np.asarray(at.latent - last.latent), np.asarray(at.gradient - last.gradient))]
            kept = kept[-descent.MEMORY :]
            expected = direction(np.asarray(at.gradient))
            np.testing.assert_allclose(at.direction, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    assert refused > 0 and len(kept) == descent.MEMORY


def test_no_step_overshoots_what_the_hessian_does_not_know(coded):
    """A floor a thousand times stiffer than the cloth: every step goes down, and many end at the minimum."""
    inverse, decode, potential = coded

    def stiff(positions):
        return potential(positions) + 1e3 * jnp.sum(jnp.maximum(0.5 - positions[:, 1], 0.0) ** 2)

    ends = {n: descend(inverse, START, decode, stiff, n) for n in (1, 4, 60)}
    energies = [float(stiff(decode(z))) for z in (START, *ends.values())]
    assert energies == sorted(energies, reverse=True)
    slope = jax.grad(lambda z: stiff(decode(z)))
    assert jnp.linalg.norm(slope(ends[60])) < 1e-3 * jnp.linalg.norm(slope(START))
    # what the rest Hessian alone would do is worse than to stay
    assert stiff(decode(START - inverse @ slope(START))) > energies[0]


def test_where_the_potential_has_no_minimum_or_is_at_one(coded):
    inverse, decode, potential = coded
    away = descend(inverse, START, decode, lambda x: -potential(x))
    # as long as the cloth at rest would have it, and downhill
    np.testing.assert_allclose(away - START, START - GOAL, atol=1e-4)
    still = descend(inverse, START, decode, lambda x: 0.0 * jnp.sum(x), 3)
    np.testing.assert_array_equal(still, START)
    uphill = descend(-inverse, START, decode, potential)
    np.testing.assert_array_equal(uphill, START)


@pytest.mark.parametrize("softer", [3.0, 0.5, 15.0, 400.0])
def test_a_softer_or_a_stiffer_cloth_shows_in_the_first_step(coded, softer):
    inverse, decode, potential = coded
    done = descend(inverse, START, decode, lambda x: potential(x) / softer, 4)
    np.testing.assert_allclose(done, GOAL, atol=1e-3)


def test_no_step_goes_where_there_is_no_energy(coded):
    """A potential that is not finite past a plane, which lies between the start and what the first step tries."""
    inverse, decode, potential = coded
    half = float(0.5 * (START[0] + GOAL[0]))

    def walled(positions):
        first = jnp.einsum("vc,kvc->k", positions, jax.jacobian(decode)(START).transpose(2, 0, 1))
        return jnp.where(jnp.linalg.solve(gram, first)[0] < half, potential(positions), jnp.nan)

    shapes = jax.jacobian(decode)(START)  # [V, 3, K]
    gram = jnp.einsum("vck,vcl->kl", shapes, shapes)
    ends = [descend(inverse, START, decode, walled, steps) for steps in (1, 2, 4, 8, 30)]
    energies = [float(walled(decode(z))) for z in (START, *ends)]
    assert np.isfinite(energies).all() and energies == sorted(energies, reverse=True)
    assert energies[-1] < 0.3 * energies[0]  # a quarter of it is at the plane
