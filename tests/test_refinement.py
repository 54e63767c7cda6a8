"""Psi in training is Psi in use, and refining it helps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import assert_same, small

from clothjax import (
    blendshapes,
    compact_latent,
    experiment,
    garment_model,
    inference,
    latent_predictor,
    refinement,
    sampling,
    stage1,
)
from clothjax import character as characters
from clothjax import clips as motion
from clothjax.config import RefinementConfig
from clothjax.latent_predictor import Normalizers, Scale
from clothjax.refinement import Frames, Frozen
from clothjax.types import ClothState, Pose

SIZE = 9


@pytest.fixture(scope="module")
def toy():
    """An untrained Psi, and all it is made of."""
    config = dataclasses.replace(small(), motions=("walk_0",))
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, latent=SIZE),
        refinement=RefinementConfig(
            steps=1600, rounds=2, sequences=4, frames=12, batch=16, learning_rate=3e-3, ema=0.9
        ),
    )
    whole = experiment.assemble(config)
    reel = jax.tree.map(jnp.asarray, experiment.training_clips(whole)[0])
    left, channels = compact_latent.latent_size(whole.scene, config.model)
    size = left * channels
    kept = latent_predictor.kept_joints(whole.names, config.stage2)
    count = 6 + 3 * 6 * len(kept) + 9 * (len(kept) - 1)
    constants = latent_predictor.constant_inputs(jnp.zeros(10), experiment.material(config), config.material)
    garment = garment_model.init(
        jax.random.key(0), size, 0.1 * blendshapes.laplacian(whole.scene, config), config.model
    )
    predictor = latent_predictor.init(jax.random.key(1), size, count, len(constants), config.stage2)
    rng = np.random.default_rng(0)

    def scale(size, limit):
        rows = (0.1 * rng.normal(size=size), rng.uniform(0.5, 2.0, size), np.full(size, -limit), np.full(size, limit))
        return Scale(*(jnp.asarray(row, jnp.float32) for row in rows))

    # codes of an untrained network stay near zero: some of them are out of so narrow a range
    narrow = Normalizers(scale(size, 0.1), scale(count, 1e6))
    inverse = stage1.rest_inverse_hessian(garment, whole.scene, config)
    return whole, reel, kept, predictor, Frozen(garment, narrow, inverse)


@pytest.fixture(scope="module")
def wide(toy):
    """The same, whose codes may be anything."""
    whole, reel, kept, predictor, frozen = toy
    size, count = len(frozen.normalizers.latent.mean), len(frozen.normalizers.pose.mean)
    ranges = (Scale(jnp.zeros(n), jnp.ones(n), jnp.full(n, -1e6), jnp.full(n, 1e6)) for n in (size, count))
    return whole, reel, kept, predictor, frozen._replace(normalizers=Normalizers(*ranges))


def test_psi_in_training_is_psi_in_use(toy):
    whole, _, kept, predictor, frozen = toy
    garment, normalizers, _ = frozen
    config, betas = whole.config, jnp.linspace(-1, 1, 10)
    model = inference.build(
        config, whole.garment, whole.body, whole.names, garment, predictor, normalizers, betas=betas
    )
    clip = experiment.motion(whole, "walk_0")
    pose = [Pose(jnp.asarray(clip.rotations[t]), jnp.asarray(clip.translation[t], jnp.float32)) for t in range(5)]
    state = inference.initial_state(model, pose[0])
    for t in range(3):
        state, _ = inference.step(model, state, pose[t])
    following, vertices = inference.step(model, state, pose[3])
    at_bounds = np.isclose(np.abs(following.latent), 0.1)
    assert at_bounds.any() and not at_bounds.all() and not following.ok

    character = characters.dress(whole.scene, betas, experiment.material(config), config.physics)
    animate = refinement.psi(predictor, frozen, whole.scene, character, kept, config)
    around = motion.poses(jax.tree.map(jnp.asarray, experiment.windows(clip)), 2)
    window = characters.window(whole.scene, character, around)
    code = latent_predictor.denormalise(normalizers.latent, state.latent)
    cloth = ClothState(jnp.zeros_like(vertices), jnp.zeros_like(vertices), jnp.zeros_like(vertices), code)
    new, latent, (before, *_) = jax.jit(lambda c: animate(c, around, window, None, None))(cloth)
    np.testing.assert_allclose(before, state.latent, atol=1e-5)
    np.testing.assert_allclose(latent_predictor.normalise(normalizers.latent, latent), following.latent, atol=1e-5)
    np.testing.assert_allclose(new + pose[2].translation[None], vertices, atol=2e-5)


def played(wide, predictor, seed=5):
    whole, reel, kept, _, frozen = wide
    return sampling.sample(
        refinement.make_rollout(whole.scene, kept, whole.config),
        (predictor, frozen, reel),
        whole.config.refinement.sequences,
        seed,
    )


def test_what_psi_should_have_predicted_costs_less_energy(wide):
    frames = played(wide, wide[3])
    assert frames.codes.shape[:2] == frames.gain.shape == (4, 12)
    assert (frames.codes[:, 0] == 0).all()  # before its first frame
    assert (frames.gain[:, 3:] > 0).all()
    # Psi goes on from what it has predicted, not from what it should have
    decay = wide[0].config.stage2.latent_decay
    each = jax.vmap(jax.vmap(lambda *row: latent_predictor.predict(wide[3], *row, decay)))
    predicted = each(frames.codes, frames.poses, frames.constants)
    np.testing.assert_allclose(predicted[:, :-1], frames.codes[:, 1:], atol=1e-4)
    assert np.abs(frames.better[:, :-1] - frames.codes[:, 1:]).max() > 1e-2


def test_refinement_lowers_the_energy_of_closed_loops(wide, tmp_path):
    whole, reel, kept, predictor, frozen = wide
    update = refinement.make_update(whole.scene, reel, kept, frozen, whole.config, tmp_path, 400)
    state = refinement.init(predictor, whole.config)
    for _ in range(4):
        state, metrics = update(state)
        assert np.isfinite(metrics["loss"]).all() and metrics["loss"].shape == (400,)
    assert int(state.step) == 1600 and sorted(path.name for path in (tmp_path / refinement.ROUNDS).iterdir()) == [
        "000.npz",
        "001.npz",
    ]
    before, after = (np.median(played(wide, params, seed=11).gain) for params in (predictor, state.average))
    assert after < 0.7 * before


def test_an_interrupted_refinement_goes_on_bit_for_bit(wide, tmp_path):
    whole, reel, kept, predictor, frozen = wide

    def updates(directory):
        return refinement.make_update(whole.scene, reel, kept, frozen, whole.config, directory, 400)

    def taken(update, state, calls):
        for _ in range(calls):
            state, _ = update(state)
        return jax.device_get(state)

    at_once = taken(updates(tmp_path / "one"), refinement.init(predictor, whole.config), 4)
    # stopped in the middle of the second round, whose frames are then in its file
    half = taken(updates(tmp_path / "two"), refinement.init(predictor, whole.config), 3)
    assert_same(at_once, taken(updates(tmp_path / "two"), jax.tree.map(jnp.array, half), 1))

    (tmp_path / "two" / refinement.ROUNDS / "000.npz").unlink()
    with pytest.raises(ValueError, match=r"000\.npz is gone"):
        updates(tmp_path / "two")(jax.tree.map(jnp.array, half))
    path = tmp_path / "two" / refinement.ROUNDS / "001.npz"
    (tmp_path / "one" / refinement.ROUNDS / "000.npz").rename(tmp_path / "two" / refinement.ROUNDS / "000.npz")
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"001\.npz is damaged"):
        updates(tmp_path / "two")(jax.tree.map(jnp.array, half))


def test_rounds_follow_each_other_and_the_last_has_the_most_steps():
    turns = refinement.schedule(RefinementConfig(steps=1000, rounds=8), 10)
    assert len(turns) == 100 and turns[0] == 0 and turns[-1] == 7
    assert set(np.diff(turns)) == {0, 1}
    counts = np.bincount(turns)
    assert (np.diff(counts[1:]) >= 0).all() and counts[-1] >= 60
    assert refinement.schedule(RefinementConfig(steps=60, rounds=8), 20) == [0, 1, 2]  # no round is left out


def test_frames_without_a_lesson_are_left_out():
    gain = np.array([[1.0, 2.0, 3.0, np.nan], [-1.0, 1e3, 2.0, 2.0]])
    better = np.arange(8.0).reshape(2, 4, 1)
    better[1, 3] = np.inf
    rows = np.zeros((2, 4, 1))
    left = refinement.worth(Frames(rows, rows, rows, better, gain))
    np.testing.assert_array_equal(left.gain, [1, 2, 3, -1, 2])
    np.testing.assert_array_equal(left.better[:, 0], [0, 1, 2, 4, 6])


def test_an_error_of_the_code_costs_its_energy_and_the_displacement_of_vertices(toy):
    whole, _, _, predictor, frozen = toy
    rng = np.random.default_rng(0)
    latent, count = frozen.normalizers.latent, len(frozen.normalizers.pose.mean)
    size = len(latent.mean)
    root = rng.normal(size=(size, size))
    hessian = root @ root.T + np.eye(size)  # of codes as they are
    frozen = frozen._replace(inverse=np.linalg.inv(hessian))
    rows = (rng.normal(size=(5, n)).astype(np.float32) for n in (size, count, 14, size))
    frames = Frames(*rows, np.ones(5, np.float32))
    decay = whole.config.stage2.latent_decay
    predicted = jax.vmap(lambda *row: latent_predictor.predict(predictor, *row, decay))(*frames[:3])
    # so near that the decoder is linear
    frames = frames._replace(codes=0 * frames.codes, better=0 * frames.better)
    predicted = 1e-3 * predicted
    apart = np.asarray(predicted) * np.asarray(latent.deviation)

    def found(stiffness):
        refined = dataclasses.replace(whole.config.refinement, vertex_stiffness=stiffness)
        cost = np.asarray(refinement.metric(frozen, dataclasses.replace(whole.config, refinement=refined)))
        return 0.5 * np.einsum("bi,ij,bj->b", predicted, cost, predicted)

    energy = 0.5 * np.einsum("bi,ij,bj->b", apart, hessian, apart)
    np.testing.assert_allclose(found(0.0), energy, rtol=1e-4)

    def displacement(code):
        code = latent_predictor.denormalise(latent, code)
        return garment_model.displacement(
            frozen.garment, code, jnp.ones(len(whole.garment.vertices)), whole.config.model
        )

    moved = jax.vmap(lambda code: displacement(code) - displacement(jnp.zeros(size)))(predicted)
    squared = np.mean(np.sum(np.asarray(moved, np.float64) ** 2, axis=-1), axis=-1)
    np.testing.assert_allclose(found(1e6) - found(0.0), 1e6 * squared, rtol=1e-2)


def test_the_loss_is_the_cost_of_what_is_predicted(toy):
    whole, _, _, predictor, frozen = toy
    rng = np.random.default_rng(0)
    size, count = len(frozen.normalizers.latent.mean), len(frozen.normalizers.pose.mean)
    rows = (jnp.asarray(rng.normal(size=(5, n)), jnp.float32) for n in (size, count, 14, size))
    frames, cost = Frames(*rows, jnp.ones(5)), refinement.metric(frozen, whole.config)
    decay = whole.config.stage2.latent_decay
    predicted = jax.vmap(lambda *row: latent_predictor.predict(predictor, *row, decay))(*frames[:3])
    apart = np.asarray(predicted - frames.better, np.float64)
    expected = 0.5 * np.einsum("bi,ij,bj->b", apart, np.asarray(cost, np.float64), apart)
    np.testing.assert_allclose(refinement.excess(predictor, frames, cost, whole.config), expected, rtol=1e-4)
    assert (refinement.excess(predictor, frames._replace(better=predicted), cost, whole.config) == 0).all()


def test_few_large_errors_do_not_outweigh_the_others():
    energies = jnp.array([1.0, 2.0, 3.0, 4.0, 5.0])
    assert refinement.robust(7.0 * energies) == pytest.approx(float(refinement.robust(energies)), rel=1e-5)
    # where all are alike it is their mean over the median, nearly
    assert refinement.robust(jnp.full(5, 0.3)) == pytest.approx(1.0, rel=0.1)
    weight = jax.grad(refinement.robust)(energies.at[4].set(5e4))
    assert (weight > 0).all() and weight[4] < 0.1 * weight[1]
