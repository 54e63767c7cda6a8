"""The reference solver over many frames, against closed forms and what contact has to hold."""

import jax
import numpy as np
import pytest
import scipy.optimize
from samples import MATERIAL, limb, sheet, time_step

from clothjax.config import PhysicsConfig
from clothjax.geometry import proximity, topology
from clothjax.physics import contact_search, energies, incremental_potential, solver

CONFIG = PhysicsConfig()


def test_a_narrow_strip_between_two_pins_hangs_as_a_catenary():
    """Long steps lead to rest. A strip that hardly stretches or bends has the sag of a chain of its length."""
    count, length, gap = 61, 1.0, 0.7
    along = np.linspace(0, length, count)
    flat = np.concatenate([np.stack([along, 0 * along, 0 * along + z], axis=1) for z in (0.0, 0.03)])
    a = np.arange(count - 1)
    faces = np.concatenate([np.stack([a, a + 1, a + count], 1), np.stack([a + 1, a + count + 1, a + count], 1)])
    mesh = topology.mesh(faces)
    # y = k cosh(x / k), of length 2 k sinh(gap / 2 k)
    k = scipy.optimize.brentq(lambda k: 2 * k * np.sinh(gap / (2 * k)) - length, 0.05, 10.0)
    half = gap / 2
    # from another curve, a parabola of about that length
    x = np.linspace(-half, half, count)
    start = np.concatenate([np.stack([x, 0.3 * ((x / half) ** 2 - 1), 0 * x + z], axis=1) for z in (0.0, 0.03)])
    pinned = np.zeros(2 * count, bool)
    pinned[[0, count - 1, count, 2 * count - 1]] = True
    step = time_step(flat, mesh, start, dt=0.3)
    step = step._replace(material=MATERIAL._replace(mu=2e6, lam=0.0, bending=1e-9))
    now = start
    for dt in (0.1, 0.3, 1.0, 10.0, 1e3):
        step = step._replace(position=now, velocity=np.zeros_like(now), timestep=np.float64(dt))
        now, info = solver.solve_step(now, step, mesh, pinned, CONFIG, tolerance=1e-7)
    assert info.converged
    sag = k * (np.cosh(half / k) - 1)
    # straight pieces of 17 mm hang a little higher than a curve, and stretch by about 1e-5
    np.testing.assert_allclose(-now[:, 1].min(), sag, atol=1e-3)
    curve = k * (np.cosh(now[:count, 0] / k) - np.cosh(half / k))
    np.testing.assert_allclose(now[:count, 1], curve, atol=1e-3)


def test_a_swinging_sheet_only_loses_energy():
    """Implicit Euler damps: kinetic, elastic and gravitational energy together fall in every step."""
    vertices, mesh = sheet()
    pinned = np.isclose(vertices[:, 0], 0.0)
    step = time_step(vertices, mesh)
    totals = []
    for _ in range(25):
        fall = np.array([0.0, -energies.GRAVITY / 900, 0.0])
        guess = np.where(pinned[:, None], step.position, step.position + step.velocity + fall)
        new, info = solver.solve_step(guess, step, mesh, pinned, CONFIG)
        assert info.ok
        velocity = new - step.position
        with jax.enable_x64(True):
            terms = incremental_potential.energies(new, step, mesh, CONFIG)
        kinetic = 0.5 * np.sum(step.mass * np.sum(velocity**2, axis=1)) * 900
        potential = energies.GRAVITY * np.sum(step.mass * new[:, 1])
        totals.append(kinetic + potential + float(terms["stretching"] + terms["bending"]))
        step = step._replace(position=new, velocity=velocity)
    assert (np.diff([0.0, *totals]) < 1e-12).all()
    assert new[:, 1].min() < -0.25 and totals[-1] < -0.01


@pytest.mark.parametrize("edges", [False, True])
def test_a_coarse_sheet_rests_on_a_bar_thinner_than_its_edges_if_these_touch(edges):
    """Its vertices are 60 mm apart, the bar is 10 mm wide and lies between two rows of them."""
    vertices, mesh = sheet()
    bar, faces = limb(0.005)
    bar = bar * np.float32([1, 0.5, 1]) + np.float32([0.15, -0.02, 0.15])  # its top is at -10 mm
    patches = proximity.patches(bar, faces)
    step = time_step(vertices, mesh)
    free = np.zeros(len(vertices), bool)
    for _ in range(12):
        positions = step.position.astype(np.float32)
        planes = contact_search.find(positions, bar, bar, patches)
        at_edges = contact_search.find_at_edges(positions, planes, mesh, bar, bar, patches) if edges else None
        step = step._replace(contact=planes, edge_contact=at_edges)
        new, info = solver.solve_step(step.position + step.velocity, step, mesh, free, CONFIG)
        assert info.converged
        step = step._replace(position=new, velocity=new - step.position)
    middle = new[mesh.edges[np.isclose(vertices[mesh.edges].mean(axis=1)[:, 0], 0.15)]].mean(axis=1)
    if edges:
        assert (np.abs(middle[:, 1] + 0.01) < 0.005).all()
        assert new[:, 1].min() < -0.1  # the rest hangs down on both sides
    else:
        assert (middle[:, 1] < -0.3).all()  # through it


def test_torn_or_sunken_cloth_is_not_ok_though_it_is_a_minimum():
    vertices, mesh = sheet()
    pinned = np.isclose(vertices[:, 0], 0.0) | np.isclose(vertices[:, 0], 0.3)
    for stretch, fine in ((1.2, True), (2.5, False)):
        pulled = vertices * [stretch, 1, 1]
        _, info = solver.solve_step(pulled, time_step(vertices, mesh, pulled), mesh, pinned, CONFIG)
        assert info.converged and info.ok == fine
        np.testing.assert_allclose(info.stretch, stretch, rtol=0.05)
    # 2 cm under a ground that hardly pushes, and a step of free fall deeper
    soft = PhysicsConfig(collision_stiffness=1e-6)
    step = time_step(vertices, mesh, ground=0.02)
    _, info = solver.solve_step(vertices, step, mesh, np.zeros(len(vertices), bool), soft)
    assert info.converged and not info.ok
    np.testing.assert_allclose(info.depth, 0.02 + energies.GRAVITY / 900, rtol=1e-3)
    # what is pinned there is no fault of the cloth's
    _, info = solver.solve_step(vertices, step, mesh, np.ones(len(vertices), bool), soft)
    assert info.ok and info.depth == 0


@pytest.mark.slow
def test_self_contact_keeps_two_layers_apart():
    """A sheet falls on another that is pinned: it stays above it, and goes through without self-contact."""
    low, mesh = sheet()
    count = len(low)
    both = np.concatenate([low, low + np.array([0.011, 0.01, 0.013])])
    faces = np.concatenate([mesh.faces, mesh.faces + count])
    double, patches = topology.mesh(faces), proximity.patches(both, faces)
    pinned = np.arange(2 * count) < count
    inner = count + np.flatnonzero((np.abs(low - 0.13)[:, [0, 2]] < 0.08).all(axis=1))
    for on in (True, False):
        step = time_step(both, double)
        for _ in range(6):
            found = contact_search.find_on_self(step.position.astype(np.float32), patches) if on else None
            step = step._replace(self_contact=found)
            guess = np.where(pinned[:, None], step.position, step.position + step.velocity)
            new, info = solver.solve_step(guess, step, double, pinned, CONFIG)
            assert info.converged
            step = step._replace(position=new, velocity=new - step.position)
        assert ((new[inner, 1] > 0) == on).all()
