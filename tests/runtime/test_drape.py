"""A Psi with forces in use: it is the one that was trained, on every mesh, and feels what pushes it."""

import dataclasses
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from samples import random_force_psi, random_model, slowly
from scipy.spatial.distance import cdist

import clothjax as cj
from clothjax.body import skinning
from clothjax.commands import convert
from clothjax.config import Config
from clothjax.evaluation import rollouts
from clothjax.export import safetensors
from clothjax.files import checkpoint, configuration, storage
from clothjax.geometry.clusters import middles
from clothjax.geometry.vectors import at_corners
from clothjax.material import configured_material
from clothjax.networks import animators, forces, normalisation, phi
from clothjax.physics import contact_search, energies, relaxation
from clothjax.physics.energies import GRAVITY
from clothjax.runtime import drape, inference, loading, specialise, trained
from clothjax.simulation import assembly, characters, rollout, time_step
from clothjax.types import ClothState, Contact, Material, Motion, Pose

FRAMES = 12


@pytest.fixture(scope="module")
def forced():
    return random_force_psi()


@pytest.fixture(scope="module")
def model(forced):
    return forced.model(betas=np.linspace(-1, 1, 10))


@pytest.fixture(scope="module")
def motion(forced):
    clip = assembly.motion(forced.experiment, "dance_3")
    return Motion(clip.rotations[:FRAMES], clip.translation[:FRAMES].astype(np.float32), clip.fps)


def pose(motion, frame):
    return Pose(jnp.asarray(motion.rotations[frame], jnp.float32), jnp.asarray(motion.translation[frame]))


@pytest.fixture(scope="module")
def relaxing():
    return random_force_psi(relaxation=3)


@pytest.fixture(scope="module")
def coarse():
    """The garment that feels has a quarter of the vertices."""
    return random_force_psi(relaxation=3, meshes=("skirt_4000", "skirt_1000"))


def stiff(model):
    """The same model without relaxation."""
    cloth = model.wearer.cloth._replace(mobility=None)
    return dataclasses.replace(model, wearer=model.wearer._replace(cloth=cloth))


@pytest.mark.parametrize("kind", ["forced", "coarse", *slowly("relaxing")])
def test_it_is_the_animator_of_training(kind, motion, request):
    """Frame by frame from the same state, over a dance."""
    forced = request.getfixturevalue(kind)
    model, experiment = forced.model(betas=np.linspace(-1, 1, 10)), forced.experiment
    config, scene = experiment.config, experiment.scene
    character = characters.dress(
        scene, jnp.linspace(-1, 1, 10), jax.tree.map(jnp.float32, configured_material(config)), config.physics
    )
    make = animators.force_psi_animator(forced.garment, forced.scales)
    animator = make({"params": forced.predictor}, scene, character, config)
    windows = rollouts.windows(motion)
    advance = jax.jit(lambda state, poses: rollout.advance(animator, scene, character, state, poses, config)[0])

    @jax.jit
    def begun(code, poses):
        """Where a garment that is shown is, and where codes put the one that feels in its place."""
        window = characters.window(scene, character, poses)
        felt = phi.felt(forced.garment, scene, character, code, window.following, config.model)
        return time_step.start(character, window, len(code)), felt - poses.translation[2][None]

    state, moved = inference.initial_state(model, pose(motion, 1)), []
    for frame in range(FRAMES - 2):
        hung, poses = state.drape, jax.tree.map(lambda x, frame=frame: x[frame], windows)
        before = ClothState(hung.position, hung.velocity, 0 * hung.velocity, state.latent, hung.change)
        if scene.felt is not None:  # the garment that is shown has a place of its own
            before = begun(state.latent, poses)[0]._replace(latent=state.latent, change=hung.change)
        expected = advance(before, poses)
        state, _ = inference.step(model, state, pose(motion, frame + 2))
        if scene.felt is not None:
            np.testing.assert_allclose(state.drape.position, begun(state.latent, poses)[1], atol=2e-5)
            if frame > 0:  # it rests at first, where in training it moves with the body
                np.testing.assert_allclose(state.latent, expected.latent, atol=2e-5)
        else:
            np.testing.assert_allclose(state.latent, expected.latent, atol=2e-5)
            np.testing.assert_allclose(state.drape.position, expected.position, atol=2e-5)
            np.testing.assert_allclose(state.drape.velocity, expected.velocity, atol=2e-5)
        moved.append(np.abs(state.drape.change).max())
    assert min(moved) > 1e-3  # it does not merely hold the code


def test_what_is_shown_is_relaxed_on_its_own_mesh(coarse, motion):
    """In steps of its own, where nothing is touched; then in the two rounds of what is pushed out."""
    model, experiment = coarse.model(), coarse.experiment
    config, scene = experiment.config, experiment.scene
    character = characters.dress(
        scene, jnp.zeros(10), jax.tree.map(jnp.float32, configured_material(config)), config.physics
    )
    window = characters.window(scene, character, jax.tree.map(lambda x: x[0], rollouts.windows(motion)))
    code = 0.5 * jax.random.normal(jax.random.key(2), model.network.code_bounds.low.shape)
    as_decoded = dataclasses.replace(config.model, relaxation=0, relaxation_momentum=0.0, shown_relaxation=0)
    expected = phi.decode(coarse.garment, scene, character, code, window, as_decoded)
    mobility = relaxation.mobility(character.rest, character.material, scene.mesh, phi.free(scene.garment))
    for steps in ((5, 0.8), (6, 0.5), (6, 0.5)):
        expected = relaxation.relaxed(expected, mobility, character.rest, character.material, scene.mesh, *steps)
    rotations, joints = skinning.forward_kinematics(
        pose(motion, 2).rotations, model.wearer.joints, np.array(model.parents)
    )
    transforms = inference._transforms(model, rotations, joints)
    hung = drape.begin(model, code, transforms)
    count = len(hung.position), len(model.network.predictor.mesh.edges)
    far = [jnp.full((n, 3), -9.0) for n in count]
    up = [jnp.zeros_like(x).at[:, 1].set(1.0) for x in far]
    planes = [Contact(x, x, n, n, jnp.zeros(len(x), jnp.int32)) for x, n in zip(far, up)]
    touched = drape.Touched(*planes, jnp.ones(count[1], bool))
    found = drape.shown_outside(model, code, hung, touched, transforms)
    root = np.asarray(motion.translation[2] - motion.translation[1])
    np.testing.assert_allclose(found, expected - root[None], atol=3e-5)
    unrelaxed = drape.shown(model, code, transforms)
    assert 1e-3 < np.abs(np.asarray(found - unrelaxed)).max() < 0.05


def test_what_is_shown_touches_the_faces_that_are_nearest_to_it(coarse, motion):
    """Or nearly so: they are those of the coarse mesh around it, of which one vertex alone has a face farther off."""
    model = coarse.model()
    parts, cloth = model.network.predictor, model.wearer.cloth
    state = inference.initial_state(model, pose(motion, 1))
    advance = jnp.asarray(motion.translation[2] - motion.translation[1])
    rotations, joints = skinning.forward_kinematics(
        pose(motion, 2).rotations, model.wearer.joints, np.array(model.parents)
    )
    transforms = inference._transforms(model, rotations, joints)
    _, touched = drape.predict(model, state.latent, state.drape, transforms, pose(motion, 2), advance, None)
    shown = np.asarray(drape.shown(model, state.latent, transforms))  # held, as what feels is
    body = drape._skin(drape._rows(parts.body, transforms), cloth.body.T).T
    centroids, normals = (np.asarray(rows) for rows in contact_search.centroids(body, parts.faces))
    apart = cdist(shown, centroids)
    near = apart.min(axis=1) < 0.05
    assert near.sum() > 1000

    def farther(points):
        return np.mean((np.linalg.norm(points - shown, axis=1) - apart.min(axis=1))[near])

    planes = drape._nearest_beside(jnp.asarray(shown), touched, parts.felt)
    of_one = farther(np.asarray(touched.vertices.point_next[parts.felt.nearest]))
    assert 0 <= farther(np.asarray(planes.point_next)) < 0.3 * of_one and of_one > 1e-3
    face = np.argmin(cdist(planes.point_next, centroids), axis=1)
    np.testing.assert_allclose(planes.normal_next, normals[face], atol=1e-4)
    nowhere = touched._replace(far=jnp.ones_like(touched.far))  # edges in reach of no face
    fewer = drape._nearest_beside(jnp.asarray(shown), nowhere, parts.felt)
    vertices = np.asarray(touched.vertices.point_next)
    assert cdist(np.asarray(fewer.point_next), vertices).min(axis=1).max() < 1e-6
    assert np.abs(np.asarray(fewer.point_next - planes.point_next)).max() > 1e-3


def test_the_garment_that_feels_is_a_level_of_detail_of_the_same_states(coarse, motion):
    """A scene can change from one to the other in any frame, and they are near each other."""
    fine, rough = coarse.model(betas=np.ones(10)), coarse.model(betas=np.ones(10), coarse=True)
    assert rough.network.predictor.felt is None and rough.wearer.template.shape[1] < fine.wearer.template.shape[1] / 3
    felt = coarse.experiment.scene.felt
    one, other = (inference.initial_state(model, pose(motion, 0)) for model in (fine, rough))
    for t in range(1, FRAMES):
        one, shown = inference.step(fine, one, pose(motion, t))
        other, roughly = inference.step(fine if t == 6 else rough, other, pose(motion, t))
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, atol=3e-5)
        if t == 6:
            np.testing.assert_allclose(roughly, shown, atol=3e-5)
        else:
            apart = np.linalg.norm(felt.on_garment.interpolated(shown) - roughly, axis=1)
            free = ~np.asarray(felt.garment.pinned)
            assert np.median(apart[free]) < 3e-3


def test_the_garment_that_feels_is_skinned_as_the_one_that_is_shown(coarse, motion):
    """Before relaxation the two are apart by no more than their templates, on any body."""
    felt, garment = coarse.experiment.scene.felt, coarse.experiment.garment
    free, own = ~np.asarray(felt.garment.pinned), storage.load_garment("skirt_1000", coarse.experiment.body)
    of_templates = felt.on_garment.interpolated(np.asarray(garment.vertices)) - own.vertices
    code = 0.5 * jax.random.normal(jax.random.key(2), coarse.model().network.code_bounds.low.shape)

    def shown(model):
        rotations, joints = skinning.forward_kinematics(
            pose(motion, 9).rotations, model.wearer.joints, np.array(model.parents)
        )
        return drape.shown(model, code, inference._transforms(model, rotations, joints))

    whole, rough = (coarse.model(betas=np.ones(10), coarse=flag) for flag in (False, True))
    apart = felt.on_garment.interpolated(shown(whole)) - shown(rough)
    apart, of_templates = (np.linalg.norm(x, axis=1)[free] for x in (apart, of_templates))
    assert np.mean(apart) < 1.5 * np.mean(of_templates) + 1e-4


def test_what_feels_is_pushed_by_an_external_acceleration(coarse, motion):
    """In training as in use: momentum gains mass times it, pulled back to the code, and nothing else changes."""
    experiment, push = coarse.experiment, jnp.array([3.0, 5.0, -2.0])
    config, scene = experiment.config, experiment.scene
    character = characters.dress(
        scene, jnp.zeros(10), jax.tree.map(jnp.float32, configured_material(config)), config.physics
    )
    window = characters.window(scene, character, jax.tree.map(lambda x: x[0], rollouts.windows(motion)))
    code = 0.5 * jax.random.normal(jax.random.key(2), coarse.scales.low.shape)
    state = time_step.start(character, window, len(code))._replace(latent=code)
    given = (coarse.garment, scene, character, state, window, config)
    calm, pushed = animators.forces_on_code(*given), animators.forces_on_code(*given, push)

    def skinned(code):
        displaced = phi.displacement(coarse.garment, scene, code, config.model)
        return phi.skinned(displaced, scene, character, window.following)

    expected = jax.vjp(skinned, code)[1](character.felt.mass[:, None] * push[None])[0]
    np.testing.assert_allclose(pushed[0] - calm[0], expected, atol=2e-3 * np.abs(expected).max())
    np.testing.assert_array_equal(pushed[1:], calm[1:])


def test_another_garment_feels_for_none():
    with pytest.raises(ValueError, match=r"model\.felt and the garment lie up to \d+ mm apart: give the same"):
        random_force_psi(meshes=("skirt_1000", "pants_1000"))


def test_a_part_of_what_is_relaxed_by_itself_differs_at_its_border_alone(coarse, motion):
    model = coarse.model()
    low = np.flatnonzero(model.wearer.template[1] < np.median(model.wearer.template[1]))
    whole, half = (inference.animate(each, motion) for each in (model, specialise.part(model, low)))
    assert np.abs(np.asarray(whole[0][-1] - whole[0][0])).max() > 0.01
    apart = np.linalg.norm(whole[0][:, low] - half[0], axis=-1)
    below = np.argsort(model.wearer.template[1, low])[:500]  # 17 steps reach 17 edges far, and ever less
    assert apart[:, below].max() < 2e-4 and 1e-3 < apart.max() < 0.05
    np.testing.assert_allclose(inference.animate(specialise.specialise(model), motion)[0], whole[0], atol=2e-5)


def test_the_same_mesh_in_the_place_of_its_own_feels_the_same(motion):
    own, felt = (random_force_psi(relaxation=3, meshes=("skirt_1000", name)) for name in ("", "skirt_1000"))
    assert felt.experiment.scene.felt is not None and own.experiment.scene.felt is None
    one, other = (
        inference.rollout(it.model(), motion, lambda state, _: state.drape.position, vertices=False)
        for it in (own, felt)
    )
    assert np.abs(np.asarray(one[-1] - one[0])).max() > 0.01
    np.testing.assert_allclose(one, other, atol=1e-4)


def test_vertices_are_its_garment_in_the_world_outside_of_what_it_touches(forced, model, motion):
    """The planes are those of the held garment at the new pose, found here by the scene of training and brute force."""
    experiment = forced.experiment
    config, scene = experiment.config, experiment.scene
    character = characters.dress(
        scene, jnp.linspace(-1, 1, 10), jax.tree.map(jnp.float32, configured_material(config)), config.physics
    )
    before = inference.initial_state(model, pose(motion, 1))
    after, vertices = inference.step(model, before, pose(motion, 2))
    window = characters.window(scene, character, jax.tree.map(lambda x: x[0], rollouts.windows(motion)))
    held = np.asarray(phi.decode(forced.garment, scene, character, before.latent, window, config.model))
    points, normals = (np.asarray(x) for x in characters.surface(scene, window.following))
    edges, offset, root = np.asarray(scene.mesh.edges), config.physics.collision_offset, motion.translation[1]

    def planes(places):
        apart = cdist(places, points)
        face = apart.argmin(axis=1)
        return points[face], normals[face], apart.min(axis=1)

    def gap(places, plane):
        return np.sum((places - plane[0]) * plane[1], axis=1)

    def depth(places, plane, target):
        return np.clip(target - gap(places, plane), 0.0, drape.DEEPEST)[:, None]

    own, between = planes(held), planes(held[edges].mean(axis=1))
    hung = np.asarray(after.drape.position) + motion.translation[2] - root
    both = ((hung, own), (hung[edges].mean(axis=1), between))
    targets = [np.minimum(offset, gap(places, plane) + drape.DEEPEST) for places, plane in both]
    push = depth(hung[edges].mean(axis=1), between, np.where(between[2] < drape.REACH, targets[1], -np.inf))
    total, count = np.zeros_like(hung), np.zeros((len(hung), 1))
    for end in edges.T:
        np.add.at(total, end, push * between[1])
        np.add.at(count, end, push > 0)
    expected = hung + total / np.maximum(count, 1)
    expected = expected + depth(expected, own, targets[0]) * own[1]
    apart = np.linalg.norm(np.asarray(vertices) - root - expected, axis=1)
    assert np.mean(apart < 2e-5) > 0.97  # a face of another cluster may be nearest
    by_edges = np.linalg.norm(expected - hung - depth(hung, own, targets[0]) * own[1], axis=1) > 1e-4
    assert by_edges.sum() > 30 and (gap(hung, own) < offset - drape.DEEPEST).sum() > 10
    assert 10 < (between[2] >= drape.REACH).sum() < len(edges) - 100
    unseen, nothing = inference.step(model, before, pose(motion, 2), False)
    assert nothing is None
    np.testing.assert_allclose(unseen.latent, after.latent, atol=1e-6)


def test_what_is_pushed_out_is_relaxed_outside_of_the_body(relaxing, motion):
    """It has less stretching energy than where it is only pushed out, is as far outside, and so are its edges."""
    model = relaxing.model()
    state, cloth = inference.initial_state(model, pose(motion, 0)), model.wearer.cloth
    mesh, offset = model.network.predictor.mesh, model.config.physics.collision_offset

    def stretching(position):
        corners = at_corners(position, mesh.faces)
        rest = cloth.rest
        terms = energies.stretching(corners, rest.inverse, rest.face_area, cloth.material.mu, cloth.material.lam)
        return float(jnp.sum(terms))

    lower, shallower = [], []
    for t in range(1, 6):
        rotations, joints = skinning.forward_kinematics(
            pose(motion, t).rotations, model.wearer.joints, np.array(model.parents)
        )
        transforms = inference._transforms(model, rotations, joints)
        advance = pose(motion, t).translation - pose(motion, t - 1).translation
        _, touched = drape.predict(model, state.latent, state.drape, transforms, pose(motion, t), advance, None)
        state, vertices = inference.step(model, state, pose(motion, t))
        vertices -= pose(motion, t).translation[None]

        def targets(x, planes):
            gap = contact_search.distance(x, planes.point_next, planes.normal_next)
            return gap, jnp.minimum(offset, gap + drape.DEEPEST)

        planes, hung = touched.vertices, state.drape.position
        gap, apart = targets(hung, planes)
        found = contact_search.distance(vertices, planes.point_next, planes.normal_next)
        assert jnp.sum((gap < offset) & (gap > offset - drape.DEEPEST)) > 20
        assert jnp.all(found > apart - 1e-5)
        push = (planes.point_next, planes.normal_next, apart, drape.DEEPEST)
        only = contact_search.pushed_out(hung, *push)
        at, (_, apart) = touched.edges, targets(middles(hung, mesh.edges), touched.edges)
        by_edges = (mesh.edges, at.point_next, at.normal_next, apart, drape.DEEPEST)
        stiff = contact_search.pushed_out(contact_search.edges_pushed_out(hung, *by_edges), *push)
        lower.append(stretching(vertices) / stretching(stiff))
        depths = [
            jnp.maximum(apart - targets(middles(x, mesh.edges), touched.edges)[0], 0.0).sum() for x in (vertices, only)
        ]
        shallower.append(float(depths[0] / depths[1]))
    assert max(lower) < 0.9 and max(shallower) < 0.5


def test_an_acceleration_against_gravity_is_no_gravity(forced, motion):
    model, light = forced.model(), random_force_psi(without=("gravity",)).model()
    first = inference.initial_state(light, pose(motion, 0))
    free = inference.step(light, first, pose(motion, 1))[1]
    held = inference.step(model, first, pose(motion, 1), external=jnp.array([0.0, GRAVITY, 0.0]))[1]
    falls = inference.step(model, first, pose(motion, 1))[1]
    np.testing.assert_allclose(held, free, atol=1e-6)
    assert np.abs(falls - free).max() > 1e-5


def test_a_motion_is_animated_with_an_acceleration_for_each_frame(model, motion):
    external = jnp.zeros((FRAMES, 3)).at[4].set(jnp.array([30.0, 0.0, 0.0]))
    calm, pushed = (inference.animate(model, motion, x)[0] for x in (None, external))
    np.testing.assert_allclose(pushed[:4], calm[:4], atol=1e-6)
    assert np.abs(pushed[4] - calm[4]).max() > 1e-4


@pytest.mark.parametrize("steps", [3, *slowly(0)])
def test_on_a_body_that_stands_it_comes_to_rest_until_something_moves_or_pushes_it(steps, motion):
    """A random network never does by itself. Its code is not clipped: a clipped change would not shrink."""
    model = random_force_psi(limit=1e3, relaxation=steps).model()
    state, changes = inference.initial_state(model, pose(motion, 0)), []
    state = state._replace(drape=state.drape._replace(still=jnp.float32(0)))
    wind, stands, tilted = jnp.array([1e-3, 0.0, 0.0]), pose(motion, 0), None

    def change(state, pose, external=None):
        return float(jnp.abs(inference.step(model, state, pose, False, external)[0].drape.change).max())

    for frame in range(370):
        awake = state._replace(drape=state.drape._replace(still=jnp.float32(0)))
        free = change(awake, stands)
        before = state
        state, _ = inference.step(model, state, stands, False)
        share = float(jnp.abs(state.drape.change).max()) / free
        changes.append(free)
        assert share == pytest.approx(0.95 ** max(0, frame + 1 - 60), rel=2e-2, abs=1e-3)
    assert min(changes) > 1e-2 and inference.resting(before, state)
    turned = stands.rotations.at[3].set(stands.rotations[3] @ jnp.array([[1.0, -1e-3, 0], [1e-3, 1, 0], [0, 0, 1]]))
    tilted = Pose(turned, stands.translation)
    shifted = Pose(stands.rotations, stands.translation + jnp.array([0.0, 0.0, 1e-3]))
    for it in (change(state, tilted), change(state, shifted), change(state, stands, wind)):
        assert it == pytest.approx(free, rel=0.5)
    assert change(state, stands, 0 * wind) < 1e-3 * free


def test_a_psi_without_forces_refuses_an_acceleration(motion):
    model = random_model(skip=True)
    state = inference.initial_state(model, pose(motion, 0))
    with pytest.raises(ValueError, match=r"feels no external acceleration: it was trained without stage2\.forces"):
        inference.step(model, state, pose(motion, 1), external=jnp.zeros(3))


@pytest.mark.parametrize("kind", ["relaxing", *slowly("forced")])
def test_a_part_and_another_mesh_feel_what_the_whole_feels(kind, motion, request):
    forced = request.getfixturevalue(kind)
    model = forced.model(betas=np.linspace(-1, 1, 10))
    whole, _ = inference.animate(model, motion)
    vertices = np.arange(0, 500)
    seen, _ = inference.animate(specialise.part(model, vertices), motion)

    def same(found, expected):
        # a vertex that its edges push into the body is not pushed out by more than the limit at once
        assert np.mean(np.linalg.norm(found - expected, axis=-1) < 1e-5) > 0.999

    same(seen, whole[:, vertices])
    mesh = specialise.on_mesh(model, forced.experiment.garment, np.linspace(-1, 1, 10))  # the same one, as another
    assert mesh.network.predictor.felt is not None
    again, _ = inference.animate(specialise.part(mesh, vertices), motion)
    same(again, whole[:, vertices])
    same(inference.animate(mesh, motion)[0], whole)
    with pytest.raises(ValueError, match="shows another mesh, or a part, already"):
        specialise.on_mesh(mesh, forced.experiment.garment, np.zeros(10))


def test_specialised_it_is_the_same(model, motion):
    whole = np.asarray(inference.animate(model, motion)[0])
    small = specialise.specialise(model)
    assert len(small.moving) < len(model.moving) == small.wearer.joints.shape[0]
    np.testing.assert_allclose(inference.animate(small, motion)[0], whole, atol=2e-5)
    equalised, _ = inference.animate(specialise.equalised(small), motion)
    np.testing.assert_allclose(equalised[:3], whole[:3], atol=1e-4)  # a random network magnifies rounding


@pytest.mark.slow
def test_specialised_with_fewer_shapes_it_is_nearly_the_same(forced, model, motion):
    mesh = specialise.on_mesh(model, forced.experiment.garment, np.linspace(-1, 1, 10))
    first = inference.initial_state(model, pose(motion, 0))
    expected, moved = (inference.step(model, first, pose(motion, frame))[1] for frame in (1, 8))
    for each in (model, mesh):
        few = specialise.specialise(each, blendshapes=8)
        apart = np.abs(inference.step(few, first, pose(motion, 1))[1] - expected).mean()
        assert 1e-6 < apart < 0.3 * np.abs(moved - expected).mean()


@pytest.mark.slow
def test_specialised_it_relaxes_as_before(relaxing, motion):
    model = relaxing.model(betas=np.linspace(-1, 1, 10))
    whole, _ = inference.animate(model, motion)
    assert np.abs(whole - inference.animate(stiff(model), motion)[0]).max() > 1e-2
    np.testing.assert_allclose(inference.animate(specialise.specialise(model), motion)[0], whole, atol=2e-5)
    first = inference.initial_state(model, pose(motion, 0))
    expected, moved = (inference.step(model, first, pose(motion, frame))[0].drape for frame in (1, 8))
    few = specialise.specialise(model, blendshapes=8)
    less = specialise.specialise(model, max_influences=2)
    mesh = specialise.on_mesh(model, relaxing.experiment.garment, np.linspace(-1, 1, 10))
    for each, share in ((few, 0.03), (less, 0.5), (mesh, 1e-3), (specialise.part(model, np.arange(500)), 1e-3)):
        found = inference.step(each, first, pose(motion, 1))[0].drape
        apart = np.abs(found.position - expected.position).mean()
        assert apart < share * np.abs(moved.position - expected.position).mean()
        unrelaxed = inference.step(stiff(each), first, pose(motion, 1))[0].drape
        assert apart < np.abs(unrelaxed.position - expected.position).mean()


@pytest.mark.parametrize("kind", ["relaxing", *slowly("forced")])
def test_a_crowd_is_each_of_its_characters(kind, motion, request):
    forced = request.getfixturevalue(kind)
    wearers = [forced.model(betas=np.full(10, i), material=Material(0.2 + 0.1 * i, 2e4, 4e4, 1e-5)) for i in range(2)]
    poses = Pose(jnp.asarray(motion.rotations[[0, 5]], jnp.float32), jnp.asarray(motion.translation[[0, 5]]))
    each = [inference.initial_state(model, jax.tree.map(lambda x, i=i: x[i], poses)) for i, model in enumerate(wearers)]
    states = jax.tree.map(lambda *x: jnp.stack(x), *each)
    external = jnp.array([[0.0, 0.0, 0.0], [30.0, 0.0, -10.0]])
    _, together = inference.step_crowd(loading.crowd(wearers), states, poses, external)
    for i, model in enumerate(wearers):
        mine = jax.tree.map(lambda x, i=i: x[i], poses)
        _, alone = inference.step(model, each[i], mine, external=external[i])
        np.testing.assert_allclose(together[i], alone, atol=1e-5)
    assert np.abs(together[1] - inference.step(wearers[1], each[1], mine)[1]).max() > 1e-4
    if kind == "relaxing":
        _, alone = inference.step(stiff(wearers[1]), each[1], mine, external=external[1])
        assert np.abs(together[1] - alone).max() > 3e-3


def test_it_stays_finite_whatever_comes_in(model, motion):
    """Poses that are not numbers, a leap of a kilometre, a state that is lost."""
    state = inference.initial_state(model, pose(motion, 0))
    broken = pose(motion, 1)._replace(translation=jnp.array([np.nan, 0, 0]))
    state, vertices = inference.step(model, state, broken)
    assert np.isfinite(vertices).all() and not state.ok
    state, vertices = inference.step(model, state, pose(motion, 1)._replace(translation=jnp.array([1e3, 0, 0])))
    assert np.isfinite(vertices).all()
    state, vertices = inference.step(model, state, pose(motion, 1), external=jnp.array([np.nan, 0.0, 0.0]))
    assert np.isfinite(vertices).all() and state.outside.tolist()[0]
    lost = state.drape._replace(velocity=jnp.full_like(state.drape.velocity, np.nan))
    state, vertices = inference.step(model, state._replace(drape=lost), pose(motion, 2))
    assert np.isfinite(vertices).all() and not state.ok
    for frame in range(3, 8):
        state, vertices = inference.step(model, state, pose(motion, frame))
    assert np.isfinite(vertices).all()


def test_blend_shapes_are_packed_as_finely_as_their_weights_need(forced, tmp_path):
    """Those whose weights go far have all of eight bits, others steps of what a vertex may be off at full range."""
    skip = np.asarray(forced.garment["skip"])
    shapes = np.random.default_rng(0).normal(size=forced.garment["blendshapes"].shape, scale=1e-3).astype(np.float32)
    spans = np.ones(len(skip), np.float32)
    spans[: len(shapes)] = np.geomspace(1.0, 1e4, len(shapes))
    scales = forced.scales._replace(low=jnp.asarray(-spans / 2), high=jnp.asarray(spans / 2))
    garment = forced.garment | {"blendshapes": shapes}
    phi = {"params": {"garment": garment, "inverse_hessian": np.eye(len(skip), dtype=np.float32)}}
    phi["statistics"] = {"mesh": normalisation.empty_statistics(3)}
    trained.write(tmp_path, forced.experiment.config, phi, forced.predictor, scales)
    error = np.abs(np.asarray(trained.psi(tmp_path).garment["blendshapes"]) - shapes)
    steps = trained.FINEST / np.maximum(np.sqrt(skip.T**2 @ spans**2), 1.0)
    largest = np.abs(shapes).max()
    assert (error <= 0.51 * np.maximum(steps, largest / 127)[:, None, None]).all()
    coarse = steps > largest / 127
    assert 0 < coarse.sum() < len(shapes)
    assert (error.max(axis=(1, 2)) > 0.51 * largest / 127)[coarse].all()


def test_resting_is_of_cloth_that_stays_where_it_is(model, motion):
    before = inference.initial_state(model, pose(motion, 0))
    still = before._replace(drape=before.drape._replace(velocity=0 * before.drape.velocity))
    swings = before._replace(drape=before.drape._replace(velocity=0 * before.drape.velocity + 1e-3))
    assert inference.resting(before, still) and not inference.resting(before, swings)


def test_a_packed_one_is_loaded_with_its_coarse_mesh_and_as_it_alone(coarse, forced, motion, tmp_path):
    inverse = np.asarray(coarse.scales.whitening.back, np.float64) @ np.asarray(coarse.scales.whitening.back)
    for name, it in (("coarse", coarse), ("alone", forced)):
        phi = {"params": {"garment": it.garment, "inverse_hessian": inverse.astype(np.float32)}}
        phi["statistics"] = {"mesh": normalisation.empty_statistics(3)}
        trained.write(tmp_path / name, it.experiment.config, phi, it.predictor, it.scales)
    fine, rough = (loading.load(tmp_path / "coarse", coarse=flag) for flag in (False, True))
    assert fine.network.predictor.felt is not None and rough.network.predictor.felt is None
    np.testing.assert_array_equal(rough.wearer.template, fine.wearer.cloth.template)
    felt = coarse.experiment.scene.felt.garment
    np.testing.assert_array_equal(rough.faces, felt.faces)
    for weights in (rough.network.weights, fine.network.predictor.felt.weights):
        np.testing.assert_allclose(weights, felt.weights.T, atol=1e-6)
    np.testing.assert_allclose(rough.network.shapes, fine.network.predictor.felt.shapes, atol=1e-7)
    assert rough.config.garment == "skirt_1000" and not rough.config.model.felt
    out = tmp_path / "c.safetensors"
    convert.main([str(tmp_path / "coarse"), "--to", "safetensors", "--coarse", "--out", str(out)])
    np.testing.assert_array_equal(safetensors.from_safetensors(out).wearer.template, rough.wearer.template)
    with pytest.raises(ValueError, match=r"alone: has no coarse mesh: it was trained without model\.felt"):
        loading.load(tmp_path / "alone", coarse=True)


def test_what_is_relaxed_by_itself_is_shown_outside_of_what_is_touched(coarse, motion):
    """In two rounds, each with planes that are found here by loops: the nearest of six, raised by 1.5 of the height of
    arcs over edges."""
    model, offset = coarse.model(), coarse.experiment.config.physics.collision_offset
    felt, pushed, anew = model.network.predictor.felt, [], []
    fabric = model.wearer.cloth.shown.rest, model.wearer.cloth.material
    elastic = relaxation.Elastic(fabric[0].inverse, fabric[0].face_area, fabric[1].mu, fabric[1].lam)
    number = {frozenset(edge): i for i, edge in enumerate(model.network.predictor.mesh.edges.tolist())}
    count = len(model.wearer.cloth.mass)
    beside = []
    for a, b, c in felt.around.tolist():
        of_edges = (number.get(frozenset(pair)) for pair in ((a, b), (b, c), (c, a)))
        beside.append([a, b, c, *(count + edge for edge in of_edges if edge is not None)])
    sides = {tuple(sorted(pair)) for a, b, c in felt.mesh.faces.tolist() for pair in ((a, b), (b, c), (c, a))}

    def planes_of(garment, touched):
        both = (touched.vertices, touched.edges)
        points, normals = (np.concatenate([getattr(x, name) for x in both]) for name in ("point_next", "normal_next"))
        far = np.concatenate([np.zeros(count, bool), touched.far])
        chosen = []
        for place, among in zip(garment, beside, strict=True):
            apart = [np.inf if far[i] else np.linalg.norm(points[i] - place) for i in among]
            chosen.append(among[int(np.argmin(apart))])
        normal, height = normals[chosen], np.zeros(len(garment))
        for a, b in sides:
            arc = (normal[a] - normal[b]) @ (garment[a] - garment[b]) / 8
            height[[a, b]] = np.maximum(height[[a, b]], min(arc, forces.HIGHEST))
        assert height.max() > 1e-4
        return points[chosen] + 1.5 * height[:, None] * normal, normal, np.array(chosen)

    state = inference.initial_state(model, pose(motion, 0))
    for t in range(1, 4):
        rotations, joints = skinning.forward_kinematics(
            pose(motion, t).rotations, model.wearer.joints, np.array(model.parents)
        )
        transforms = inference._transforms(model, rotations, joints)
        advance = pose(motion, t).translation - pose(motion, t - 1).translation
        _, touched = drape.predict(model, state.latent, state.drape, transforms, pose(motion, t), advance, None)
        state, vertices = inference.step(model, state, pose(motion, t))
        cloth, garment = model.wearer.cloth, drape.shown(model, state.latent, transforms)
        garment = relaxation.relaxed(garment, cloth.shown.mobility, cloth.shown.rest, cloth.material, felt.mesh, 5, 0.8)
        changed = []
        for _ in range(2):
            point, normal, nearest = planes_of(np.asarray(garment), touched)
            changed.append(nearest)
            apart, deep = np.minimum(offset, np.sum((garment - point) * normal, axis=1) + drape.DEEPEST), []

            def outside(x, point=point, normal=normal, apart=apart, deep=deep):
                depth = np.clip(apart - np.sum((x - point) * normal, axis=1), 0.0, drape.DEEPEST)
                deep.append(depth)
                return x + depth[:, None] * normal

            before = np.asarray(garment)
            for _ in range(6):
                now = outside(np.asarray(garment))
                pull = relaxation.stretching_gradient(jnp.float32(now), felt.mesh.faces, elastic)
                move = -1.5 * np.asarray(cloth.shown.mobility)[:, None] * pull
                move /= np.sqrt(1 + np.sum(move**2, axis=1, keepdims=True) / relaxation.LONGEST**2)
                garment, before = now + move + 0.5 * (now - before), now
            garment = outside(garment)
            pushed.append(np.sum(deep[0] > 1e-3))
        anew.append(np.sum(changed[0] != changed[1]))
        found = vertices - pose(motion, t).translation[None]
        # beside a vertex between two planes it may be the other one
        assert np.mean(np.linalg.norm(found - garment, axis=1) < 1e-5) > 0.98
    assert min(pushed[::2]) > 50 and min(anew) > 20


def test_a_packed_one_is_the_same_but_for_rounding(forced, motion, tmp_path):
    inverse = np.asarray(forced.scales.whitening.back, np.float64) @ np.asarray(forced.scales.whitening.back)
    phi = {"params": {"garment": forced.garment, "inverse_hessian": inverse.astype(np.float32)}}
    phi["statistics"] = {"mesh": normalisation.empty_statistics(3)}
    trained.write(tmp_path, forced.experiment.config, phi, forced.predictor, forced.scales)
    again = trained.psi(tmp_path).normalizers
    np.testing.assert_allclose(again.whitening.to, forced.scales.whitening.to, atol=1e-3)
    model, packed = forced.model(), cj.load(tmp_path)
    first = inference.initial_state(model, pose(motion, 0))
    whole, found = (inference.step(each, first, pose(motion, 1))[0] for each in (model, packed))
    moved = jnp.linalg.norm(whole.drape.change)
    assert jnp.linalg.norm(found.latent - whole.latent) < 0.2 * moved  # matrices are packed in eight bits
    assert packed.config == forced.experiment.config


def test_it_is_in_float32_in_a_process_that_is_not(forced, model, motion):
    expected, _ = inference.animate(model, motion)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        again = forced.model(betas=np.linspace(-1, 1, 10))
        found, _ = inference.animate(again, motion._replace(translation=motion.translation.astype(np.float64)))
        assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_a_model_has_the_network_of_its_character():
    """It has no scales left, of which no export knows, and steps as with them; with another's it steps otherwise."""
    it = random_force_psi(scaled=0.02)
    model, clip = it.model(betas=np.ones(10)), storage.load_motion("walk_0")
    predictor = model.network.predictor
    assert set(predictor.params) == {"linear", "mlp"}
    state = inference.initial_state(model, Pose(clip.rotations[0], clip.translation[0]))
    pose = Pose(clip.rotations[1], clip.translation[1])

    def stepped(params):
        network = model.network._replace(predictor=predictor._replace(params=params))
        return inference.step(dataclasses.replace(model, network=network), state, pose)[0].latent

    ours, other = predictor.params, it.model(betas=-np.ones(10)).network.predictor.params
    np.testing.assert_allclose(stepped(it.predictor), stepped(ours), atol=1e-4)
    assert np.abs(stepped(other) - stepped(ours)).max() > 0.01


@pytest.fixture
def packed(tmp_path):
    """A random Psi with forces that is packed, and the folder."""
    it = random_force_psi(scaled=0.02)
    statistics = normalisation.Statistics(*(np.zeros(1, np.float32) for _ in normalisation.Statistics._fields))
    phi = {"params": {"garment": it.garment, "inverse_hessian": np.eye(40, dtype=np.float32)}}
    far = jnp.full(40, 1e6)  # so that no shape is stored with fewer bits
    scales = it.scales._replace(low=-far, high=far)
    trained.write(tmp_path, it.experiment.config, phi | {"statistics": {"mesh": statistics}}, it.predictor, scales)
    return it, tmp_path


def test_a_packed_model_errs_by_half_a_step_of_each_run(packed):
    """Of every 32 entries, so that a large one costs its neighbours alone the bits, in all arrays, shapes too."""
    it, folder = packed
    found = trained.psi(folder)
    pairs = [
        *zip(checkpoint.named(it.predictor).values(), checkpoint.named(found.predictor).values(), strict=True),
        (it.garment["blendshapes"], found.garment["blendshapes"]),
    ]
    with np.load(folder / trained.WEIGHTS) as file:
        assert file["phi/garment/blendshapes"].dtype == file["predictor/linear/kernel"].dtype == np.int8
        assert file["phi/inverse_hessian"].dtype == np.float32
        for name in (name for name in file.files if name.endswith("|scale")):
            assert not (file[name].view(np.uint32) & 0xFFFF).any(), name  # deflates well
    for expected, leaf in pairs:
        expected, leaf = np.asarray(expected).reshape(-1), np.asarray(leaf).reshape(-1)
        for start in range(0, expected.size, trained.RUN):
            run = expected[start : start + trained.RUN]
            assert np.abs(leaf[start : start + trained.RUN] - run).max() <= np.abs(run).max() / 252


def test_a_model_packed_with_a_scale_for_each_column_is_read(packed):
    _, folder = packed
    with np.load(folder / trained.WEIGHTS) as file:
        arrays = dict(file)
    name, rng = "predictor/linear/kernel", np.random.default_rng(0)
    arrays[name] = rng.integers(-127, 128, size=arrays[name].shape).astype(np.int8)
    arrays[f"{name}|scale"] = rng.uniform(size=arrays[name].shape[1]).astype(np.float32)
    for other in [key.removesuffix("|scale") for key in arrays if key.endswith("|scale") and not key.startswith(name)]:
        del arrays[f"{other}|scale"]
        arrays[other] = arrays[other].astype(np.float16)
    np.savez(folder / trained.WEIGHTS, **(arrays | {"format": np.int32(3)}))
    found = trained.psi(folder).predictor["linear"]["kernel"]
    np.testing.assert_allclose(found, arrays[name] * arrays[f"{name}|scale"], rtol=1e-6)


def test_a_packed_model_of_before_forces_is_one_without_them(tmp_path):
    folder = tmp_path / "old"
    shutil.copytree(trained.find("tshirt_pose"), folder)
    settings = yaml.safe_load((folder / trained.CONFIG).read_text())
    del settings["stage2"]["forces"]
    (folder / trained.CONFIG).write_text(yaml.safe_dump(settings))
    assert isinstance(trained.psi(folder).normalizers, normalisation.Normalizers)


def test_a_run_of_before_forces_is_one_without_them(monkeypatch, tmp_path):
    settings = configuration.to_dict(Config())
    del settings["stage2"]["forces"]
    monkeypatch.setattr(checkpoint, "steps", lambda folder: [])
    monkeypatch.setattr(checkpoint, "latest", lambda folder: SimpleNamespace(config=settings))
    monkeypatch.setattr(checkpoint, "read", lambda folder, *wanted: ({name: {} for name in wanted}, None))
    assert not trained.network(tmp_path)[0].stage2.forces
