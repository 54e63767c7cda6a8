"""The networks of peers: their inputs, their units, and that the physics trains them."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import settings
from toy import small

from clothjax import material
from clothjax.body import motion_clips
from clothjax.config import PeerConfig
from clothjax.evaluation.report import evaluate, table
from clothjax.networks import animators, baselines, psi
from clothjax.runtime import trained
from clothjax.simulation import assembly, characters, rollout
from clothjax.training import laplacian_shapes, pipeline, stage1
from clothjax.training.loss import weighing
from clothjax.types import Pose
from experiments import gallery, render

NETWORKS = ("ncs", pytest.param("snug", marks=pytest.mark.slow), "direct")


@pytest.fixture(scope="module", params=NETWORKS)
def built(request):
    """An experiment without contact, its reel, the joints that are inputs, and the state before the first step."""
    config = settings(request.param)
    physics = dataclasses.replace(config.physics, body="none", edge_contact=False)
    experiment = assembly.assemble(dataclasses.replace(config, physics=physics))
    reel = jax.tree.map(jnp.asarray, assembly.training_clips(experiment)[0])
    kept = psi.input_joints(experiment.names, experiment.config.stage2)
    shapes = laplacian_shapes.laplacian(experiment.scene, experiment.config)
    return experiment, reel, kept, stage1.init_baseline(experiment.scene, reel, kept, shapes, experiment.config)


@pytest.fixture(scope="module")
def chain():
    """Two joints, one above the other."""
    return jnp.array([[0.0, 1.0, 0.0], [0.0, 1.5, 0.0]]), np.array([-1, 0]), np.array([0, 1])


def about_y(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def test_ncs_sees_acceleration_in_the_joints_own_frame_and_nothing_where_nothing_moves(chain):
    joints, parents, kept = chain
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter turn about z
    rotations = jnp.asarray(np.broadcast_to(np.stack([turn, np.eye(3)]), (3, 2, 3, 3)), jnp.float32)
    still = Pose(rotations, jnp.zeros((3, 3)))
    static, dynamic = baselines.joint_inputs(still, joints, parents, kept, 30.0)
    assert not np.any(dynamic)
    np.testing.assert_allclose(static[0], [0, 1, 0, -1, 0, 0, *(turn.T @ [0, -1, 0])], atol=1e-6)
    falling = still._replace(translation=jnp.array([[0.0, 0, 0], [0, 0, 0], [0, -0.01, 0]]))
    _, dynamic = baselines.joint_inputs(falling, joints, parents, kept, 30.0)
    np.testing.assert_allclose(dynamic[:, :9], 0.0, atol=1e-5)
    np.testing.assert_allclose(dynamic[:, 9:], [[-9.0, 0, 0]] * 2, atol=1e-4)


def test_ncs_sees_rates_of_rotations(chain):
    joints, parents, kept = chain
    nod = np.array([[1, 0, 0], [0, np.cos(0.1), -np.sin(0.1)], [0, np.sin(0.1), np.cos(0.1)]])
    rotations = np.tile(np.eye(3), (3, 2, 1, 1))
    rotations[2, 1] = nod
    _, dynamic = baselines.joint_inputs(
        Pose(jnp.asarray(rotations, jnp.float32), jnp.zeros((3, 3))), joints, parents, kept, 30.0
    )
    expected = 30.0 * np.concatenate([(nod - np.eye(3))[:, :2].T.reshape(-1), nod.T @ [0, -1, 0] + [0, 1, 0]])
    np.testing.assert_allclose(dynamic[1, :9], expected, atol=2e-5)
    np.testing.assert_allclose(dynamic[0], 0.0, atol=1e-5)


def test_only_the_dynamic_inputs_know_of_earlier_frames(chain):
    joints, parents, kept = chain
    turns = jnp.asarray([[about_y(0.3 * t), np.eye(3)] for t in range(3)], jnp.float32)
    turning = Pose(turns, jnp.asarray([[0.1 * t, 1.0, 0.0] for t in range(3)], jnp.float32))
    still = Pose(jnp.stack([turns[2]] * 3), jnp.stack([turning.translation[2]] * 3))
    config, constants = settings("ncs"), jnp.zeros(3)
    moved, resting = (baselines.inputs(poses, joints, constants, parents, kept, config) for poses in (turning, still))
    np.testing.assert_allclose(moved["static"], resting["static"], atol=1e-6)
    assert np.abs(moved["dynamic"]).max() > 1.0 and np.abs(resting["dynamic"]).max() < 1e-4


def test_the_unit_is_flaxs():
    unit = baselines.GRU(4)
    rows = jax.random.normal(jax.random.key(2), (6, 5))
    params = unit.init(jax.random.key(0), jnp.zeros(4), rows[0])["params"]
    params["input"]["bias"] = jax.random.normal(jax.random.key(1), (12,))
    cell = nn.GRUCell(4)
    names = ("z", "r", "n")
    theirs = {
        f"i{name}": {"kernel": kernel, "bias": bias}
        for name, kernel, bias in zip(
            names, jnp.split(params["input"]["kernel"], 3, axis=1), jnp.split(params["input"]["bias"], 3)
        )
    } | {f"h{name}": {"kernel": kernel} for name, kernel in zip(names, jnp.split(params["state"]["kernel"], 3, axis=1))}
    theirs["hn"]["bias"] = jnp.zeros(4)
    one = other = jnp.zeros(4)
    for row in rows:
        one = unit.apply({"params": params}, one, row)
        other, _ = cell.apply({"params": theirs}, other, row)
    np.testing.assert_allclose(one, other, atol=1e-6)
    assert np.abs(one).max() > 0.1


def test_the_dynamic_code_is_zero_while_nothing_moves():
    config = settings("ncs")
    params = baselines.init(jax.random.key(0), 2, 3, jnp.zeros((1, 7, 3)), config)
    static = jnp.ones(21)
    network = baselines.network(config, 7)
    _, memory = network.apply({"params": params}, jnp.zeros(8), static, jnp.zeros((2, 12)))
    assert not np.any(memory)
    _, memory = network.apply({"params": params}, jnp.zeros(8), static, jnp.ones((2, 12)))
    assert np.any(memory)


def test_facing_and_place_are_not_seen(built):
    experiment, reel, kept, state = built
    config = experiment.config
    betas = jnp.linspace(-1, 1, 10)
    constants = psi.constant_inputs(betas, material.configured_material(config), config.material)
    poses = motion_clips.poses(reel, jnp.int32(7))
    memory = 0.1 * jnp.ones(animators.memory_size(experiment.scene, config))

    @jax.jit
    def run(poses):
        joints, parents = jnp.asarray(experiment.body.joints), experiment.scene.body.parents
        seen = baselines.inputs(poses, joints, constants, parents, kept, config)
        return baselines.network(config, len(experiment.garment.vertices)).apply(
            {"params": state.params}, memory, **seen
        )

    root = int(kept[0])
    turn = jnp.asarray(about_y(1.0), jnp.float32)
    turned = Pose(poses.rotations.at[:, root].set(turn[None] @ poses.rotations[:, root]), poses.translation @ turn.T)
    for one, other in zip(run(poses), run(turned)):
        np.testing.assert_allclose(one, other, atol=2e-5 * float(jnp.max(jnp.abs(one))))


def test_gradients_pass_through_memory_over_the_whole_rollout(built):
    experiment, reel, kept, state = built
    config = experiment.config
    character = characters.dress(experiment.scene, jnp.zeros(10), material.configured_material(config), config.physics)
    simulation = jax.tree.map(lambda x: x[0], state.pool)

    def gradient(frames):
        def loss(memory):
            animate = animators.baseline_animator(kept)({"params": state.params}, experiment.scene, character, config)
            cloth = simulation.cloth._replace(latent=memory)
            total, _ = rollout.training_rollout(
                animate, experiment.scene, character, cloth, reel, simulation.frame, simulation.fresh,
                frames, config, weighing(config.loss, jnp.int32(0)),
            )  # fmt: skip
            return frames * total

        return jax.jit(jax.grad(loss))(0.1 * jnp.ones_like(simulation.cloth.latent))

    first, all_three = gradient(1), gradient(3)
    assert np.any(first)
    assert np.abs(all_three - first).max() > 1e-3 * np.abs(first).max()


def test_the_physics_trains_it(built):
    experiment, reel, kept, begun = built
    config = dataclasses.replace(
        experiment.config,
        stage1=dataclasses.replace(experiment.config.stage1, learning_rate=3e-3, restart_probability=0.0),
    )
    update = stage1.make_update(experiment.scene, reel, config, 3, 40, animator=animators.baseline_animator(kept))
    shapes = begun.params.get("garment", {}).get("blendshapes")
    started = jax.tree.map(jnp.copy, begun)
    state, metrics = update(started)
    assert np.isfinite(metrics["loss"]).all() and int(state.step) == 40
    # how the same simulations begin once more, with the network that they have trained
    fresh = begun._replace(params=jax.tree.map(jnp.copy, state.params))
    _, again = update(fresh)
    assert np.mean(again["loss"][:9]) < 0.95 * np.mean(metrics["loss"][:9])
    assert shapes is None or np.any(np.asarray(state.params["garment"]["blendshapes"]) != shapes)


@pytest.mark.slow
def test_it_is_trained_measured_and_read_back_as_an_experiment(tmp_path):
    config = settings("ncs", steps=20)
    config = dataclasses.replace(
        config, evaluation=dataclasses.replace(config.evaluation, frames=24, long_frames=26, solver_frames=20)
    )
    pipeline.train(config, tmp_path)
    read, model = trained.network(tmp_path)
    assert read.peer == config.peer and model["params"]["blendshapes"].shape == (9, 3 * 1016)
    report = evaluate(tmp_path)
    assert set(report["evaluation"]) == {"lbs", "ncs"}
    assert np.isfinite(report["evaluation"]["ncs"]["energy_gap"]) and report["evaluation"]["ncs"]["finite"]
    assert "ncs" in table(report["evaluation"])
    for program in (render, gallery):
        with pytest.raises(ValueError, match=r"ncs.*has no Phi"):
            program.main([str(tmp_path), "--out", str(tmp_path / "picture.webp")])


def test_a_long_first_step_is_refused():
    with pytest.raises(ValueError, match=r"stage1\.start_timestep"):
        dataclasses.replace(small(), peer=PeerConfig("ncs"))
