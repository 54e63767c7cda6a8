import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax.body import motion_clips, skinning
from clothjax.config import Config, MaterialConfig, Stage2Config
from clothjax.networks import decoder, mlp, normalisation, psi
from clothjax.networks.psi import Psi
from clothjax.simulation import assembly
from clothjax.training import stage2
from clothjax.training.stage2 import Teacher
from clothjax.types import Material
from data_prep.smpl import NAMES


@pytest.mark.parametrize("count", [24, 52, 55])
def test_smpl_gives_the_input_count_of_the_thesis(count):
    kept = psi.input_joints(NAMES[count], Config().stage2)
    rotations = jnp.broadcast_to(jnp.eye(3), (3, count, 3, 3))
    inputs = psi.pose_inputs(rotations, jnp.zeros((3, count, 3)), jnp.zeros((2, 3)), kept, 30.0)
    material = Material(*(jnp.float32(x) for x in (0.2, 2e4, 4e4, 1e-5)))
    constants = psi.constant_inputs(jnp.zeros(10), material, MaterialConfig())
    np.testing.assert_array_equal(kept, np.arange(20))
    assert inputs.size + constants.size == 551
    assert inputs.size + constants.size + 2040 == 2591


def test_materials_are_scaled_to_zero_and_one_over_their_ranges():
    config = MaterialConfig()
    ranges = (config.density_range, config.mu_range, config.lam_range, config.bending_range)
    low = Material(*(jnp.float32(limits.low) for limits in ranges))
    high = Material(*(jnp.float32(limits.high) for limits in ranges))
    np.testing.assert_allclose(psi.constant_inputs(jnp.zeros(1), low, config)[1:], 0, atol=1e-5)
    np.testing.assert_allclose(psi.constant_inputs(jnp.zeros(1), high, config)[1:], 1, atol=1e-5)
    middle = low._replace(bending=jnp.sqrt(low.bending * high.bending))
    np.testing.assert_allclose(psi.constant_inputs(jnp.zeros(1), middle, config)[2], 0.5, atol=1e-4)


def test_one_material_for_all_is_no_input_and_betas_are_still_bounded():
    config = dataclasses.replace(Config(), material=MaterialConfig(sample=False))
    material = Material(*(jnp.float32(x) for x in (0.2, 2e4, 4e4, 1e-5)))
    betas = jnp.array([-1.5, 0.3, 1.9])
    constants = psi.constant_inputs(betas, material, config.material)
    np.testing.assert_array_equal(constants, betas)
    inside, known = psi.bounded_constants(constants, config)
    np.testing.assert_array_equal(inside, betas)
    assert known
    inside, known = psi.bounded_constants(2 * betas, config)
    np.testing.assert_allclose(inside, [-2.0, 0.6, 2.0], rtol=1e-6)
    assert not known


def test_velocity_is_in_metres_a_second_and_in_the_heading_frame():
    positions = jnp.array([[[0.0, 1.0, 0.0], [0.3, 1.5, 0.0]]] * 3)
    angle = np.pi / 2  # facing +X
    turn = jnp.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]], jnp.float32)
    rotations = jnp.stack([jnp.stack([turn, jnp.eye(3)])] * 3)
    advance = jnp.array([[0.05, 0.0, 0.0], [0.04, 0.0, 0.0]])
    inputs = psi.pose_inputs(rotations, positions, advance, np.array([0, 1]), 30.0)
    # walking the way it faces is +Z in its own frame
    np.testing.assert_allclose(inputs[:6], [0, 0, 1.5, 0, 0, 1.2], atol=1e-6)
    # and facing is not seen: the root's rotation is the identity
    np.testing.assert_allclose(inputs[6:12], [1, 0, 0, 0, 1, 0], atol=1e-6)
    # what is on its left, +X in the world turned away, is ahead
    np.testing.assert_allclose(inputs[-3:], [0, 0.5, 0.3], atol=1e-6)


def _rotating_teacher(sequences=24, frames=60, size=6, seed=0) -> Teacher:
    """A linear system with input, Z' = A Z + B x, contracting, as cloth at rest is."""
    random = np.random.default_rng(seed)
    matrix = 0.9 * np.linalg.qr(random.normal(size=(size, size)))[0]
    drive = random.normal(size=(4, size))
    poses = np.cumsum(random.normal(size=(sequences, frames, 4)), axis=1) * 0.1
    latents = np.zeros((sequences, frames + 1, size))
    for t in range(frames):
        latents[:, t + 1] = latents[:, t] @ matrix + poses[:, t] @ drive
    return Teacher(latents.astype(np.float32), poses.astype(np.float32), np.zeros((sequences, 3), np.float32))


def _config(**stage) -> Config:
    config = Config()
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, decoder=(8,), blendshapes=5),
        stage2=dataclasses.replace(config.stage2, **stage),
    )


def _garment(config, size=6, vertices=7):
    shape = (config.model.blendshapes, vertices, 3)
    basis = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    return decoder.init(jax.random.key(2), size, basis, config.model)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_share_of_the_loss_is_the_vertex_error_over_the_vertices_variance(share):
    teacher = _rotating_teacher(sequences=3, frames=5)
    config = _config(vertex_share=share, noise=0.0, rollout=1, hidden=(8,))
    garment = _garment(config)
    state = stage2.init(teacher, garment, config)
    network = decoder.of(garment, config.model)
    decode = jax.vmap(lambda z: network.apply({"params": garment}, z, jnp.ones(7)))
    codes = jnp.asarray(teacher.latents[0, :2])
    value = stage2.rollout_loss(
        state.params, state, codes, jnp.asarray(teacher.poses[0, :1]), jnp.zeros(3), jax.random.key(0), config
    )
    normal = [normalisation.normalise(state.normalizers.latent, z) for z in codes]
    pose = normalisation.normalise(state.normalizers.pose, jnp.asarray(teacher.poses[0, 0]))
    predicted = Psi(config.stage2).apply({"params": state.params}, normal[0], pose, jnp.zeros(3))
    every = decode(jnp.asarray(teacher.latents[:, 1:].reshape(-1, 6)))
    pair = decode(jnp.stack([normalisation.denormalise(state.normalizers.latent, predicted), codes[1]]))
    vertex = jnp.mean((pair[0] - pair[1]) ** 2) / jnp.mean((every - every.mean(0, keepdims=True)) ** 2)
    expected = (1 - share) * jnp.mean((predicted - normal[1]) ** 2) + share * vertex
    np.testing.assert_allclose(value, expected, rtol=1e-4)


def test_motions_of_training_are_ordinary_though_the_teacher_did_not_play_them():
    config = dataclasses.replace(small(), motions=("walk_0", "arms_0"))
    experiment = assembly.assemble(config)
    reel, _ = assembly.training_clips(experiment)
    kept = psi.input_joints(experiment.names, config.stage2)
    rows = stage2.ordinary_poses(experiment.scene, reel, kept, config)
    latents = np.random.default_rng(0).normal(size=(1, 7, 6)).astype(np.float32)
    teacher = Teacher(latents, rows[None, :6], np.zeros((1, 3), np.float32))

    def ordinary(normalizers, name):
        poses = assembly.as_clips(assembly.motion(experiment, name))
        joints = skinning.shaped_joints(experiment.body, jnp.zeros(10))

        def one(frame):
            inputs = psi.window_inputs(
                motion_clips.poses(jax.tree.map(jnp.asarray, poses), frame),
                joints,
                experiment.body.parents,
                kept,
                config.fps,
            )
            inputs = normalisation.normalise(normalizers.pose, inputs)
            return normalisation.bounded(inputs, normalizers.pose.low, normalizers.pose.high)[1]

        return np.mean(jax.vmap(one)(jnp.arange(2, 100)))

    alone = stage2.init(teacher, _garment(config), config).normalizers
    wide = stage2.init(teacher, _garment(config), config, rows).normalizers
    for name in config.motions:
        assert ordinary(alone, name) < 0.5 and ordinary(wide, name) == 1.0
    assert ordinary(wide, "jump_0") < 0.5


def test_a_code_that_the_network_does_not_hold_is_forgotten():
    stage = _config(hidden=(8,)).stage2
    params = psi.init(jax.random.key(0), 6, 4, 3, stage)
    silent = jax.tree.map(jnp.zeros_like, params)
    code = jnp.arange(6.0)
    kept = Psi(stage).apply({"params": silent}, code, jnp.ones(4), jnp.ones(3))
    np.testing.assert_allclose(kept, 0.9 * code, rtol=1e-6)


def test_trained_with_noise_it_follows_its_teacher_in_closed_loop():
    teacher = _rotating_teacher()
    config = _config(steps=600, hidden=(48,), batch=32, rollout=4, learning_rate=3e-3)
    state = stage2.init(teacher, _garment(config), config)
    state, _ = stage2.make_update(teacher, config, 600)(state)
    unseen = teacher  # its first sequence, but from end to end instead of four frames at a time
    normalizers = state.normalizers

    def follow(latent, pose):
        pose = normalisation.normalise(normalizers.pose, pose)
        latent = Psi(config.stage2).apply({"params": state.params}, latent, pose, jnp.zeros(3))
        return latent, normalisation.denormalise(normalizers.latent, latent)

    start = normalisation.normalise(normalizers.latent, jnp.asarray(unseen.latents[0, 0]))
    _, predicted = jax.lax.scan(follow, start, jnp.asarray(unseen.poses[0]))
    error = np.abs(np.asarray(predicted) - unseen.latents[0, 1:])[-20:].mean()
    assert error < 0.35 * np.abs(unseen.latents[0, 1:]).mean()


def test_the_noise_on_the_first_code_is_felt_by_the_whole_rollout():
    teacher = _rotating_teacher(sequences=2, frames=8)

    def gradient(noise):
        config = _config(noise=noise, rollout=3, hidden=(8,))
        state = stage2.init(teacher, _garment(config), config)
        return jax.grad(stage2.rollout_loss)(
            state.params, state, jnp.asarray(teacher.latents[0, :4]), jnp.asarray(teacher.poses[0, :3]),
            jnp.zeros(3), jax.random.key(1), config,
        )["dense_0"]["kernel"]  # fmt: skip

    assert not np.allclose(gradient(0.3), gradient(0.0))


def test_a_widened_range_holds_what_was_seen_since():
    rng = np.random.default_rng(0)
    scale = normalisation.measure(rng.normal(size=(50, 3)))
    more = np.array([[10.0, 0.0, -10.0]])
    wide = normalisation.widened(scale, more)
    row = normalisation.normalise(wide, more[0])
    assert ((wide.low <= row + 1e-6) & (row <= wide.high + 1e-6)).all()
    np.testing.assert_array_equal(wide.mean, scale.mean)
    assert wide.low[0] == scale.low[0] and wide.high[2] == scale.high[2] and wide.high[1] == scale.high[1]


def test_a_gated_network_multiplies_the_inputs_of_each_direction_by_gates():
    """In a second implementation, loop by loop; the character has no scales of its own."""
    rng = np.random.default_rng(0)
    network, inputs = (
        psi.ForcePsi(Stage2Config(hidden=(8, 6), gated=True), 4, 3),
        rng.normal(size=23).astype(np.float32),
    )
    params = mlp.init(network, jax.random.key(0), jnp.zeros(23))
    assert set(params) == {"linear", "mlp"} and psi.of_character(params, jnp.ones(3)) is params
    params = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), params)
    kernels, biases = ([np.asarray(params["mlp"][f"dense_{i}"][name]) for i in range(3)] for name in ("kernel", "bias"))
    x = inputs
    for kernel, bias in zip(kernels[:2], biases[:2]):
        x = np.maximum(x @ kernel + bias, 0)
    gates = x @ kernels[2] + biases[2]
    expected = inputs @ np.asarray(params["linear"]["kernel"]) + np.asarray(params["linear"]["bias"])
    for direction in range(4):
        for kind in range(5):
            expected[direction] += gates[4 * kind + direction] * inputs[4 * kind + direction]
    np.testing.assert_allclose(mlp.apply(network, params, inputs), expected, rtol=1e-4, atol=1e-4)
    one = psi.ForcePsi(network.config, 4)
    np.testing.assert_array_equal(mlp.apply(one, params, inputs), mlp.apply(network, params, inputs))


def test_a_gated_network_drops_what_its_gates_read_not_what_they_multiply():
    """Without gates nothing is dropped; with them, another part in each draw, and none without a key."""
    network, inputs = psi.ForcePsi(Stage2Config(hidden=(64,), gated=True), 4, 3), jnp.ones(23)
    params = mlp.init(network, jax.random.key(0), jnp.zeros(23))
    alone = params | {"mlp": jax.tree.map(jnp.zeros_like, params["mlp"])}
    drawn = [{"rngs": {"dropout": jax.random.key(i)}} for i in range(2)]
    for options in drawn:
        np.testing.assert_array_equal(mlp.apply(network, alone, inputs, **options), mlp.apply(network, alone, inputs))
    first, second = (mlp.apply(network, params, inputs, **options) for options in drawn)
    assert (first != second).all()


def test_the_network_of_one_character_is_that_of_all_at_its_constants():
    """Each input and each output of a layer is scaled on its own."""
    rng = np.random.default_rng(0)
    constants, inputs = rng.normal(size=3).astype(np.float32), rng.normal(size=(5, 17)).astype(np.float32)
    inputs[:, 14:] = constants
    network = psi.ForcePsi(Stage2Config(hidden=(8, 6)), 4, 3)
    params = mlp.init(network, jax.random.key(0), jnp.zeros(17))
    plain = {name: layer for name, layer in params.items() if name != "character"}
    for_one = psi.ForcePsi(Stage2Config(hidden=(8, 6)), 4)
    np.testing.assert_allclose(mlp.apply(network, params, inputs), mlp.apply(for_one, plain, inputs), rtol=1e-5)
    assert psi.of_character(plain, jnp.asarray(constants)) is plain
    scales = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), params["character"])
    assert {name: x.shape for name, x in scales.items()} == {
        "inputs": (3, 14), "linear": (3, 4), "dense_0": (3, 8), "dense_1": (3, 6)
    }  # fmt: skip
    layers = [np.array(plain["mlp"][f"dense_{i}"]["kernel"]) for i in range(3)]
    factors = {name: 1 + constants @ np.asarray(x) for name, x in scales.items()}
    seen = np.concatenate([inputs[:, :14] * factors["inputs"], inputs[:, 14:]], axis=1)
    x = np.maximum((seen @ layers[0]) * factors["dense_0"], 0)
    x = np.maximum((x @ layers[1]) * factors["dense_1"], 0) @ layers[2]
    expected = x + (seen @ np.asarray(plain["linear"]["kernel"])) * factors["linear"]  # biases are zero at first
    all_of_it = params | {"character": scales}
    np.testing.assert_allclose(mlp.apply(network, all_of_it, inputs), expected, rtol=1e-4, atol=1e-4)
    one = psi.of_character(all_of_it, jnp.asarray(constants))
    np.testing.assert_allclose(mlp.apply(for_one, one, inputs), expected, rtol=1e-4, atol=1e-4)
    biased = {"mlp": plain["mlp"] | {"dense_0": plain["mlp"]["dense_0"] | {"bias": jnp.ones(8)}}}
    one = psi.of_character(all_of_it | biased, jnp.asarray(constants))
    np.testing.assert_array_equal(one["mlp"]["dense_0"]["bias"], 1.0)
    found = mlp.apply(network, all_of_it | biased, inputs)
    np.testing.assert_allclose(mlp.apply(for_one, one, inputs), found, rtol=1e-4, atol=1e-4)
