import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax import experiment, inference, latent_predictor, stage1, stage2
from clothjax.export import onnx as onnx_export
from clothjax.types import Motion, Pose


@pytest.fixture(scope="module")
def trained():
    """A model after a few steps of both stages: its numbers mean nothing, its code paths all do."""
    config = dataclasses.replace(small(), motions=("walk_0", "dance_0"))
    whole = experiment.assemble(config)
    reel, _ = experiment.training_clips(whole)
    first, _ = stage1.make_update(whole.scene, reel, config, 1, 20)(stage1.init(whole.scene, reel, config))
    joints = latent_predictor.kept_joints(whole.names, config.stage2)
    phi = {"params": first.params, "statistics": first.statistics}
    teacher, _ = stage2.teach(phi, whole.scene, reel, joints, config)
    second, _ = stage2.make_update(teacher, config, 20)(stage2.init(teacher, first.params["garment"], config))
    model = inference.build(
        config, whole.garment, whole.body, whole.names, second.garment, second.params, second.normalizers,
        betas=np.linspace(-1, 1, 10),
    )  # fmt: skip
    clip = experiment.motion(whole, "walk_3")
    return model, Motion(clip.rotations[:30], clip.translation[:30].astype(np.float32), clip.fps), teacher


def test_animate_is_step_over_the_frames(trained):
    model, motion, _ = trained
    vertices, ok = inference.animate(model, motion)
    poses = [Pose(jnp.asarray(r), jnp.asarray(t)) for r, t in zip(motion.rotations, motion.translation)]
    state = inference.initial_state(model, poses[0])
    for t, pose in enumerate(poses):
        state, frame = inference.step(model, state, pose)
        np.testing.assert_allclose(frame, vertices[t], atol=1e-5)
    assert vertices.shape == (30, 1016, 3) and ok.all()


def test_step_is_compiled_once_for_every_character(trained):
    model, motion, _ = trained
    traced = jax.jit(chex.assert_max_traces(inference.step.__wrapped__, n=1))
    pose = Pose(jnp.asarray(motion.rotations[0]), jnp.asarray(motion.translation[0]))
    state = inference.initial_state(model, pose)
    for scale in (1.0, 2.0, 3.0):
        other = dataclasses.replace(model, constants=scale * model.constants)
        state, _ = traced(other, state, pose)


def test_a_crowd_is_a_vmap(trained):
    model, motion, _ = trained
    pose = Pose(jnp.asarray(motion.rotations[:4]), jnp.asarray(motion.translation[:4]))
    states = jax.vmap(lambda p: inference.initial_state(model, p))(pose)
    _, together = jax.vmap(inference.step, (None, 0, 0))(model, states, pose)
    for i in range(4):
        alone = jax.tree.map(lambda x, i=i: x[i], (states, pose))
        np.testing.assert_allclose(together[i], inference.step(model, *alone)[1], atol=1e-5)


def test_psi_does_not_see_place_or_heading(trained):
    model, motion, _ = trained
    angle = 2.0
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], np.float32)
    turned = np.array(motion.rotations)
    turned[:, 0] = turn @ turned[:, 0]
    moved = Motion(turned, motion.translation @ turn.T + np.float32([3.0, 0.5, -2.0]), motion.fps)
    plain, _ = inference.animate(model, motion)
    other, _ = inference.animate(model, moved)
    # the body turns about its root joint, which is not at the origin
    root = np.asarray(model.joints[0])
    expected = (np.asarray(plain) - root) @ turn.T + root + np.float32([3.0, 0.5, -2.0])
    np.testing.assert_allclose(other, expected, atol=2e-4)


def test_the_state_says_nothing_of_the_frames_before_the_last_two(trained):
    model, motion, _ = trained
    pose = Pose(jnp.asarray(motion.rotations[3]), jnp.asarray(motion.translation[3]))
    state = inference.initial_state(model, pose)
    size = sum(x.size for x in state)
    joints = motion.rotations.shape[1]
    assert size == state.latent.size + 2 * (9 * joints + 3)


def test_wrong_betas_are_refused(trained):
    model, *_ = trained
    whole = experiment.assemble(model.config)
    with pytest.raises(ValueError, match=r"betas have shape \(3,\); this body takes \(10,\)"):
        inference.build(
            model.config, whole.garment, whole.body, whole.names, model.garment_params, model.predictor,
            model.normalizers, betas=np.zeros(3),
        )  # fmt: skip


def test_the_teacher_starts_from_zero_and_its_inputs_are_what_an_engine_has(trained):
    model, _motion, teacher = trained
    assert (teacher.latents[:, 0] == 0).all()
    assert teacher.latents.shape[1] == teacher.poses.shape[1] + 1
    kept = len(model.kept)
    assert teacher.poses.shape[-1] == 6 + 3 * 6 * kept + 3 * 3 * (kept - 1)


def test_onnx_runtime_agrees_in_closed_loop(trained, tmp_path):
    model, motion, _ = trained
    path = onnx_export.to_onnx(model, tmp_path / "g.onnx", Pose(motion.rotations[0], motion.translation[0]))
    assert onnx_export.check_onnx(path, model, motion) < 1e-4
    # a check that could not fail would pass another model's file, too
    other = dataclasses.replace(model, garment=model.garment._replace(vertices=1.01 * model.garment.vertices))
    assert onnx_export.check_onnx(path, other, motion) > 1e-3
