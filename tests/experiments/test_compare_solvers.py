"""The comparison of our solver with Newton's: its scenes, Newton's energies written by us, and the two side by side."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from clothjax.physics import energies, incremental_potential
from experiments.compare_solvers import engines, report
from experiments.compare_solvers.engines import CONFIG, MATERIAL, SCENES

DT = 1 / 120


def stretching(law, strain):
    """Energy J of one triangle with the in-plane deformation I + strain [2, 2]."""
    inverse = jnp.asarray([[[40.0, -10.0], [0.0, 50.0]]])
    edges = jnp.concatenate([jnp.identity(2, strain.dtype) + strain, jnp.zeros((1, 2), strain.dtype)]) @ jnp.linalg.inv(
        inverse[0]
    )
    corners = jnp.stack([edges[:, 0], edges[:, 1], jnp.zeros(3)])[None]
    return law(corners, inverse, jnp.full(1, 2.5e-4), MATERIAL.mu, MATERIAL.lam)[0]


def test_newtons_membrane_is_ours_to_second_order():
    ours, newtons = energies.stretching, engines.neo_hookean
    with jax.enable_x64(True):
        zero = jnp.zeros((2, 2))
        assert abs(stretching(newtons, zero)) < 1e-15
        np.testing.assert_allclose(jax.grad(lambda e: stretching(newtons, e))(zero), 0.0, atol=1e-12)
        second = [jax.hessian(lambda e, law=law: stretching(law, e))(zero) for law in (ours, newtons)]
        np.testing.assert_allclose(second[1], second[0], atol=1e-10 * np.abs(second[0]).max())
        # and no farther: in one direction ours is stiffer, by a tenth at a strain of 10 %
        pulled = jnp.diag(jnp.array([0.1, 0.0]))
        assert stretching(newtons, pulled) < 0.95 * stretching(ours, pulled)


def test_contacts_are_as_deep_under_a_vertex():
    weight = energies.GRAVITY * MATERIAL.density * engines.SIZE**2 / 100
    depth = np.sqrt(weight / (3 * CONFIG.collision_stiffness))
    assert engines.contact_stiffness(100) * depth == pytest.approx(weight)
    with jax.enable_x64(True):
        distance = jnp.full(100, CONFIG.collision_offset - depth)
        force = -CONFIG.collision_stiffness * jax.grad(lambda d: engines.quadratic(d, CONFIG.collision_offset).sum())(
            distance
        )
    np.testing.assert_allclose(force, weight)


@pytest.mark.parametrize("name", SCENES)
def test_scenes(name):
    scene = engines.scene(name, 6)
    assert len(scene.flat) == 36 and len(scene.mesh.faces) == 50
    assert scene.pinned.sum() == {"hang": 6, "edge": 6, "corners": 2, "sphere": 0}[name]
    step = engines.Reference(scene, DT).time_step()
    terms = report.energies(scene, scene.start)
    assert terms["stretching"] < 1e-12 and terms["gravity"] == terms["collision"] == 0
    np.testing.assert_allclose(step.mass.sum(), MATERIAL.density * engines.SIZE**2, rtol=1e-6)


def test_the_plane_of_a_vertex_touches_the_sphere():
    scene = engines.scene("sphere", 6)
    contact = engines.Reference(scene, DT).time_step().contact
    np.testing.assert_allclose(np.linalg.norm(contact.point - scene.centre, axis=1), engines.SPHERE)
    gap = np.sum((scene.start - contact.point) * contact.normal, axis=1)
    np.testing.assert_allclose(gap, np.linalg.norm(scene.start - scene.centre, axis=1) - engines.SPHERE)


def test_our_pins_carry_the_weight_at_rest():
    scene = engines.scene("hang", 6)
    engine = engines.Reference(scene, 1e3)  # a step so long that there is no inertia
    engine.advance()
    assert engine.converged
    assert report.pins(scene, engine.position) == pytest.approx(1, abs=1e-5)


def test_laws_of_another_solver_replace_ours_in_that_call_only():
    scene = engines.scene("hang", 4)

    def stretching(laws):
        engine = engines.Reference(scene, DT)
        position = engine.position * np.array([1.1, 1.3, 0.9])
        with jax.enable_x64(True):
            terms = incremental_potential.energies(position, engine.time_step(), scene.mesh, engines.CONFIG, laws)
        return float(terms["stretching"])

    ours = stretching(incremental_potential.LAWS)
    newtons = stretching(engines.NEWTONS_LAWS)
    assert newtons > 0 and abs(newtons / ours - 1) > 1e-3
    assert stretching(incremental_potential.LAWS) == ours


def test_distances():
    one = np.zeros((2, 3, 3))
    other = one.copy()
    other[0, 0, 0], other[1, :, 1] = 3e-3, 1e-3
    assert report.distances(one, other) == pytest.approx(
        {"mean_mm": 1.0, "max_mm": 3.0, "end_mean_mm": 1.0, "end_max_mm": 1.0}
    )


def test_without_newton_it_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "newton", None)
    with pytest.raises(ImportError, match=r"clothjax\[compare\]"):
        engines.Vbd(engines.scene("edge", 4), DT, 1)


@pytest.mark.parametrize("name", ["corners", "sphere"])
def test_ours_and_newtons_take_the_same_steps(name):
    """With the same energies, while neither folds: 3 mm of stretch, 50 mm of fall, 0.05 mm of difference.

    What is left is float32, the iterations and the length of bent edges; any wrong constant or factor of an energy
    makes it tens of times larger.
    """
    pytest.importorskip("newton")
    scene = engines.scene(name, 8)
    newton = engines.Vbd(scene, DT, 100)
    ours = engines.Reference(scene, DT, laws=engines.NEWTONS_LAWS)
    tracks, _ = report.simulate({"ours": ours, "newton": newton}, 4, 4)
    assert np.abs(tracks["ours"][-1] - scene.start).max() > 0.03
    assert report.distances(tracks["ours"], tracks["newton"])["max_mm"] < 0.05
