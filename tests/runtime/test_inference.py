import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import slowly
from toy import small

from clothjax.files import storage
from clothjax.networks import normalisation, psi
from clothjax.runtime import inference, loading, models, specialise
from clothjax.simulation import assembly
from clothjax.training import stage1, stage2
from clothjax.types import Material, Motion, Pose


@pytest.fixture(scope="module")
def trained():
    """A model of both stages, with noise in place of training: its numbers mean nothing, its code paths all do."""
    config = dataclasses.replace(small(), motions=("walk_0", "dance_0"))
    experiment = assembly.assemble(config)
    reel, _ = assembly.training_clips(experiment)
    first = stage1.init(experiment.scene, reel, config)
    joints = psi.input_joints(experiment.names, config.stage2)
    phi = {"params": first.params, "statistics": first.statistics}
    teacher, _ = stage2.teach(phi, experiment.scene, reel, joints, config)
    second = stage2.init(teacher, first.params["garment"], config)
    drawn = np.random.default_rng(0)
    noisy = jax.tree.map(lambda x: x + 0.03 * drawn.standard_normal(x.shape, np.float32), second.params)
    # twelve frames of a teacher span next to nothing: as if it had seen more
    wide = normalisation.Normalizers(*(
        scale._replace(low=0 * scale.low - 1e6, high=0 * scale.high + 1e6) for scale in second.normalizers
    ))  # fmt: skip

    def wearer(betas, material=None):
        return loading.build(
            config, experiment.garment, experiment.body, experiment.names, second.garment, noisy, wide,
            betas=betas, material=material,
        )  # fmt: skip

    clip = assembly.motion(experiment, "walk_3")
    motion = Motion(clip.rotations[:30], clip.translation[:30].astype(np.float32), clip.fps)
    return wearer(np.linspace(-1, 1, 10)), motion, teacher, wearer


def test_animate_is_step_over_the_frames(trained):
    model, motion, *_ = trained
    vertices, ok = inference.animate(model, motion)
    poses = [Pose(jnp.asarray(r), jnp.asarray(t)) for r, t in zip(motion.rotations, motion.translation)]
    state = inference.initial_state(model, poses[0])
    for t, pose in enumerate(poses):
        state, frame = inference.step(model, state, pose)
        np.testing.assert_allclose(frame, vertices[t], atol=1e-5)
    assert vertices.shape == (30, 1016, 3) and ok.all()


def test_step_is_compiled_once_for_every_character(trained):
    _, motion, _, wearer = trained
    traces = []
    traced = jax.jit(lambda *given: (traces.append(1), inference.step.__wrapped__(*given))[1])
    pose = Pose(jnp.asarray(motion.rotations[0]), jnp.asarray(motion.translation[0]))
    state = inference.initial_state(wearer(np.zeros(10)), pose)
    for scale in (0.1, 0.5, 1.0):
        state, _ = traced(wearer(np.full(10, scale)), state, pose)
    assert len(traces) == 1


def test_a_crowd_is_each_of_its_characters(trained):
    _, motion, _, wearer = trained
    wearers = [wearer(np.full(10, 0.5 * i), Material(0.2 + 0.1 * i, 2e4, 4e4, 1e-5)) for i in range(4)]
    crowd = loading.crowd(wearers)
    pose = Pose(jnp.asarray(motion.rotations[:4]), jnp.asarray(motion.translation[:4]))
    states = jax.tree.map(lambda *x: jnp.stack(x), *(
        inference.initial_state(model, Pose(pose.rotations[i], pose.translation[i])) for i, model in enumerate(wearers)
    ))  # fmt: skip
    following, together = inference.step_crowd(crowd, states, pose)
    assert np.abs(together[0] - together[3]).max() > 1e-3
    for i, model in enumerate(wearers):
        state, vertices = inference.step(model, *jax.tree.map(lambda x, i=i: x[i], (states, pose)))
        np.testing.assert_allclose(together[i], vertices, atol=1e-5)
        np.testing.assert_allclose(following.latent[i], state.latent, atol=1e-5)


def test_a_crowd_is_of_one_garment(trained):
    model, _, _, wearer = trained
    other = wearer(np.ones(10))
    changed = other.network._replace(shapes=2 * other.network.shapes)
    with pytest.raises(ValueError, match=r"models\[1\] differs from models\[0\] in more than its wearer"):
        loading.crowd([model, dataclasses.replace(other, network=changed)])
    fewer = [specialise.specialise(each, blendshapes=4) for each in (model, other)]
    with pytest.raises(ValueError, match="whose blend shapes `specialise` has not fitted"):
        loading.crowd(fewer)
    with pytest.raises(ValueError, match="at least one"):
        loading.crowd([])


def test_a_motion_of_another_rate_or_skeleton_is_refused(trained):
    model, motion, *_ = trained
    with pytest.raises(ValueError, match="60 frames a second, the garment was trained for 30"):
        inference.animate(model, motion._replace(fps=60.0))
    with pytest.raises(ValueError, match="has 24 joints, the garment's body 31"):
        inference.animate(model, motion._replace(rotations=motion.rotations[:, :24]))


def test_a_garment_that_nobody_sees_goes_on(trained):
    model, motion, *_ = trained
    pose = Pose(jnp.asarray(motion.rotations[3]), jnp.asarray(motion.translation[3]))
    state = inference.initial_state(model, Pose(motion.rotations[2], motion.translation[2]))
    seen, vertices = inference.step(model, state, pose)
    unseen, nothing = inference.step(model, state, pose, vertices=False)
    assert vertices is not None and nothing is None
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), seen, unseen)


@pytest.mark.parametrize("name", ["tshirt", "tshirt_pose", *slowly("skirt")])
def test_a_garment_at_rest_can_be_left_alone(name):
    model = loading.load(name)
    clip = storage.load_motion("walk_3", model.names)
    poses = [Pose(jnp.asarray(clip.rotations[t]), jnp.asarray(clip.translation[t], jnp.float32)) for t in range(20)]
    state = inference.initial_state(model, poses[0])
    for pose in poses:
        before = state
        state, _ = inference.step(model, state, pose)
        assert not inference.resting(before, state)
    frames = 0
    while not inference.resting(before, state):
        before, frames = state, frames + 1
        state, frozen = inference.step(model, state, poses[-1])
        assert frames < 300
    assert frames > 2
    apart, rested = [], state
    for _ in range(300):
        state, vertices = inference.step(model, state, poses[-1])
        apart.append(np.linalg.norm(vertices - frozen, axis=1))
    if state.drape is not None:
        moved = np.linalg.norm(state.drape.position - rested.drape.position, axis=1)
        assert moved.max() < 5e-5
    assert np.max(apart) < 2e-4  # of all frames: a vertex may be pushed out of the one or the other of two faces


def test_psi_does_not_see_place_or_heading(trained):
    model, motion, *_ = trained
    angle = 2.0
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], np.float32)
    turned = np.array(motion.rotations)
    turned[:, 0] = turn @ turned[:, 0]
    moved = Motion(turned, motion.translation @ turn.T + np.float32([3.0, 0.5, -2.0]), motion.fps)
    plain, _ = inference.animate(model, motion)
    other, _ = inference.animate(model, moved)
    # the body turns about its root joint, which is not at the origin
    root = np.asarray(model.wearer.joints[0])
    expected = (np.asarray(plain) - root) @ turn.T + root + np.float32([3.0, 0.5, -2.0])
    np.testing.assert_allclose(other, expected, atol=2e-4)


def test_the_state_says_nothing_of_the_frames_before_the_last_two(trained):
    model, motion, *_ = trained
    pose = Pose(jnp.asarray(motion.rotations[3]), jnp.asarray(motion.translation[3]))
    state = inference.initial_state(model, pose)
    size = sum(x.size for x in jax.tree.leaves(state))
    joints = motion.rotations.shape[1]
    assert size == state.latent.size + 2 * (9 * joints + 3 * joints + 3) + len(models.CAUSES)


def test_a_frame_that_is_not_finite_is_the_last_one_again(trained):
    model, motion, *_ = trained
    for broken in (motion.rotations, motion.translation):
        wrong = np.array(broken)
        wrong[10].flat[3 % wrong[10].size] = np.nan
        held = [np.array(x) for x in motion[:2]]
        held[0][10], held[1][10] = held[0][9], held[1][9]
        parts = (wrong, motion.translation) if broken is motion.rotations else (motion.rotations, wrong)
        # only what is broken is replaced by the whole last pose
        vertices, ok = inference.animate(model, Motion(*parts, motion.fps))
        expected, fine = inference.animate(model, Motion(*held, motion.fps))
        np.testing.assert_array_equal(vertices, expected)
        assert not ok[10] and (np.asarray(ok) == np.asarray(fine))[np.arange(30) != 10].all()


def test_a_first_frame_that_is_not_finite_is_the_canonical_pose(trained):
    model, motion, *_ = trained
    rotations = np.array(motion.rotations)
    rotations[0] = np.inf
    state = inference.initial_state(model, Pose(rotations[0], motion.translation[0]))
    np.testing.assert_array_equal(state.rotations[0], np.broadcast_to(np.eye(3), rotations[0].shape))
    assert not state.ok
    vertices, ok = inference.animate(model, Motion(rotations, motion.translation, motion.fps))
    assert np.isfinite(vertices).all() and not ok[0]


def test_what_training_has_not_seen_is_said_and_leaves_the_code_where_training_had_it(trained):
    model, motion, *_ = trained
    assert inference.animate(model, motion)[1].all()
    fast = motion._replace(translation=motion.translation * np.float32(1e9))
    assert not inference.animate(model, fast)[1][2:].any()
    far = motion._replace(translation=motion.translation + np.float32([[3e38, 0, 0]]))
    stretched = motion._replace(rotations=np.float32(1e25) * motion.rotations)
    for wild in (far, stretched):
        vertices, ok = inference.animate(model, wild)
        assert np.isfinite(vertices).all() and not ok.any()
    bounds = model.network.code_bounds
    strict = bounds._replace(low=0 * bounds.low - 0.5, high=0 * bounds.high + 0.5)
    narrow = dataclasses.replace(model, network=model.network._replace(code_bounds=strict))
    state = inference.initial_state(narrow, Pose(motion.rotations[0], motion.translation[0]))
    told = []
    for rotations, translation in zip(motion.rotations, motion.translation):
        state, vertices = inference.step(narrow, state, Pose(jnp.asarray(rotations), jnp.asarray(translation)))
        told.append(bool(state.ok))
        assert np.isfinite(vertices).all() and float(jnp.abs(state.latent).max()) <= 0.5
    assert not all(told)


def test_the_state_tells_what_was_out_of_the_range_of_training(trained):
    model, motion, _, wearer = trained
    pose = Pose(jnp.asarray(motion.rotations[1]), jnp.asarray(motion.translation[1]))
    bounds = model.network.code_bounds
    strict = bounds._replace(low=0 * bounds.low - 1e-6, high=0 * bounds.high + 1e-6, slack=0 * bounds.slack)
    cases = {
        "not finite": (model, pose._replace(translation=jnp.full(3, np.nan))),
        "pose": (model, pose._replace(translation=pose.translation + 1e5)),
        "wearer": (wearer(np.full(10, 9.0)), pose),
        "code": (dataclasses.replace(model, network=model.network._replace(code_bounds=strict)), pose),
    }
    assert set(cases) == set(models.CAUSES)
    usual = bounds._replace(low=0 * bounds.low - 1e9, high=0 * bounds.high + 1e9)
    for cause, (each, asked) in cases.items():
        if cause != "code":  # what is unlike training may bring the code out too
            each = dataclasses.replace(each, network=each.network._replace(code_bounds=usual))
        state = inference.initial_state(
            each, Pose(jnp.asarray(motion.rotations[0]), jnp.asarray(motion.translation[0]))
        )
        state, _ = inference.step(each, state, asked)
        assert np.array(models.CAUSES)[np.asarray(state.outside)].tolist() == [cause] and not state.ok
    state, _ = inference.step(model, inference.initial_state(model, pose), pose)
    assert state.ok and not np.asarray(state.outside).any()


def test_a_wearer_or_a_cloth_outside_the_range_of_training_is_said(trained):
    model, motion, _, wearer = trained
    limit, cloth = model.config.stage1.betas, model.config.material
    first = np.eye(10)[0]
    usual = Material(cloth.density, cloth.mu, cloth.lam, cloth.bending)
    for betas, material, fine in (
        (limit * first, usual, True),
        (1.5 * limit * first, usual, False),
        (0 * first, usual._replace(density=cloth.density_range.high), True),
        (0 * first, usual._replace(density=3 * cloth.density_range.high), False),
    ):
        assert bool(inference.animate(wearer(betas, material), motion)[1].all()) == fine


def test_wrong_betas_are_refused(trained):
    with pytest.raises(ValueError, match=r"betas have shape \(3,\); this body takes \(10,\)"):
        trained[-1](np.zeros(3))


def test_the_teacher_starts_from_zero_and_its_inputs_are_what_an_engine_has(trained):
    model, _motion, teacher, _ = trained
    assert (teacher.latents[:, 0] == 0).all()
    assert teacher.latents.shape[1] == teacher.poses.shape[1] + 1
    kept = len(model.input_joints)
    assert teacher.poses.shape[-1] == 6 + 3 * 6 * kept + 3 * 3 * (kept - 1)
