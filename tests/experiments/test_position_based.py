"""XPBD as the benchmark uses it: its springs are the membrane they stand for, and its frames are physical."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax.evaluation import metrics
from clothjax.geometry import topology
from clothjax.material import configured_material
from clothjax.physics import energies
from clothjax.simulation import assembly, characters
from experiments.benchmark import position_based
from experiments.compare_solvers.engines import scene

MU, LAM = 2.4e4, 2.4e4  # Pa: alike, for which springs and a membrane have one Poisson's ratio, 1/3


def test_springs_are_the_membrane_when_both_are_widened():
    flat = scene("edge", 12).flat
    faces = np.asarray(scene("edge", 12).mesh.faces)
    edges, strain = topology.edges(faces), 1e-4
    stiffness = position_based.springs(flat, faces, edges, MU, LAM)
    lengths = np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1)
    springs = 0.5 * np.sum(stiffness * (strain * lengths) ** 2)
    with jax.enable_x64(True):
        rest = energies.rest_measures(jnp.asarray(flat), topology.mesh(faces))
        wide = (1 + strain) * jnp.asarray(flat)[faces]
        membrane = energies.stretching(wide, rest.inverse, rest.face_area, MU, LAM).sum()
    assert springs == pytest.approx(float(membrane), rel=1e-3)


def wears(garment):
    pytest.importorskip("newton")
    experiment = assembly.assemble(dataclasses.replace(small(), garment=garment))
    material = configured_material(experiment.config)._replace(bending=jnp.zeros(()))  # or pleats unfold as they fall
    character = characters.dress(experiment.scene, jnp.zeros(10), material, experiment.config.physics)
    engine = position_based.Xpbd(experiment, character, substeps=32, iterations=2)
    return experiment, engine, np.asarray(character.template, np.float64), np.asarray(character.body)


def test_what_nothing_holds_falls():
    experiment, engine, now, body = wears("tshirt_1000")
    new = engine.step(now, np.zeros_like(now), now, np.stack([body + [0.0, 50.0, 0.0]] * 2))
    fallen = 0.5 * energies.GRAVITY / experiment.config.fps**2 * (1 + 1 / 32)  # the implicit steps that Newton takes
    np.testing.assert_allclose(new, now - [0.0, fallen, 0.0], atol=0.01 * fallen)


def test_pinned_vertices_are_carried():
    _, engine, now, body = wears("skirt_1000")
    held = now + [0.01, 0.0, 0.0]
    new = engine.step(now, np.zeros_like(now), held, np.stack([body] * 2))
    np.testing.assert_allclose(new[engine.pinned], held[engine.pinned], atol=1e-6)
    assert engine.pinned.any() and np.isfinite(new).all() and not np.allclose(new[~engine.pinned], now[~engine.pinned])


def test_cloth_is_pushed_out_of_a_body_that_moves_into_it():
    experiment, engine, now, body = wears("skirt_1000")
    bodies, faces = np.stack([body, body + [0.0, 0.0, 0.06]]), np.asarray(experiment.scene.body.faces)
    deep, _ = metrics.penetration(now, bodies[1], faces)
    new = engine.step(now, np.zeros_like(now), now, bodies)
    left, _ = metrics.penetration(new, bodies[1], faces)
    free = ~engine.pinned
    assert deep[free].max() > 5e-3 and left[free].max() < 1e-3


def test_friction_takes_cloth_along_with_a_body_that_slides_past():
    """A body that grows wider as it goes forwards, against the sides of a skirt."""
    experiment, engine, now, body = wears("skirt_1000")
    wider = body * [1.2, 1.0, 1.0]
    faces = np.asarray(experiment.scene.body.faces)
    deep, _ = metrics.penetration(now, wider, faces)
    aside = ~engine.pinned & (deep > 3e-3) & (np.abs(now[:, 2] - now[:, 2].mean()) < 0.05)
    still, along = (
        engine.step(now, np.zeros_like(now), now, np.stack([wider, wider + [0.0, 0.0, forwards]]))
        for forwards in (0.0, 0.02)
    )
    taken = (along - still)[aside, 2]
    assert aside.sum() > 5
    assert np.median(taken) > 0.002 and taken.max() < 0.03
