"""Psi refined: its closed loops cost less energy, and an interruption changes nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import assert_same, small, untrained_psi

from clothjax import (
    garment_model,
    latent_predictor,
    refinement,
    sampling,
    stage1,
)
from clothjax.config import RefinementConfig
from clothjax.latent_predictor import Normalizers, Scale
from clothjax.refinement import Frames, Frozen


@pytest.fixture(scope="module")
def toy():
    """An untrained Psi, and all it is made of."""
    config = small()
    config = dataclasses.replace(
        config,
        stage1=dataclasses.replace(config.stage1, betas=0.0),  # one wearer: four loops of several differ too much
        refinement=RefinementConfig(
            steps=1600, rounds=2, sequences=4, frames=12, batch=16, learning_rate=3e-3, ema=0.9
        ),
    )
    whole, reel, kept, garment, predictor, normalizers = untrained_psi(config)
    inverse = stage1.rest_inverse_hessian(garment, whole.scene, whole.config)
    return whole, reel, kept, predictor, Frozen(garment, normalizers, inverse)


@pytest.fixture(scope="module")
def wide(toy):
    """The same, whose codes may be anything."""
    whole, reel, kept, predictor, frozen = toy
    size, count = len(frozen.normalizers.latent.mean), len(frozen.normalizers.pose.mean)
    ranges = (Scale(jnp.zeros(n), jnp.ones(n), jnp.full(n, -1e6), jnp.full(n, 1e6)) for n in (size, count))
    return whole, reel, kept, predictor, frozen._replace(normalizers=Normalizers(*ranges))


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

    # what a training left that came to nothing is not learnt from
    strange = jax.tree.map(lambda x: 2 * x, refinement._read(tmp_path / "one" / refinement.ROUNDS / "000.npz"))
    refinement._write(tmp_path / "three" / refinement.ROUNDS / "000.npz", strange)
    first = [taken(updates(tmp_path / name), refinement.init(predictor, whole.config), 1) for name in ("three", "four")]
    assert_same(*first)

    (tmp_path / "two" / refinement.ROUNDS / "000.npz").unlink()
    with pytest.raises(ValueError, match=r"000\.npz is gone"):
        updates(tmp_path / "two")(jax.tree.map(jnp.array, half))
    path = tmp_path / "two" / refinement.ROUNDS / "001.npz"
    (tmp_path / "one" / refinement.ROUNDS / "000.npz").rename(tmp_path / "two" / refinement.ROUNDS / "000.npz")
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"001\.npz is damaged"):
        updates(tmp_path / "two")(jax.tree.map(jnp.array, half))


def test_codes_are_read_with_noise(wide, tmp_path):
    whole, reel, kept, predictor, frozen = wide

    def taken(noise):
        settings = dataclasses.replace(whole.config.refinement, noise=noise)
        config = dataclasses.replace(whole.config, refinement=settings)
        update = refinement.make_update(whole.scene, reel, kept, frozen, config, tmp_path, 400)
        return update(refinement.init(predictor, config))[1]["loss"]

    quiet, noisy = taken(0.0), taken(0.5)
    assert quiet[0] != noisy[0] and np.isfinite(noisy).all()


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
