"""Blend shapes from freely simulated cloth."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax.config import ShapesConfig
from clothjax.physics import compilers, kernels
from clothjax.simulation import assembly
from clothjax.training import laplacian_shapes, pipeline, principal_shapes, sampling


@pytest.fixture(scope="module")
def skirt():
    config = dataclasses.replace(small(), garment="skirt_1000", motions=("walk_0",))
    config = dataclasses.replace(config, shapes=ShapesConfig(sequences=2, frames=5, descent_steps=6))
    experiment = assembly.assemble(config)
    return experiment, assembly.training_clips(experiment)[0]


def of(experiment, **changed):
    return dataclasses.replace(experiment.config, model=dataclasses.replace(experiment.config.model, **changed))


@pytest.mark.parametrize("built", [True, False])
def test_cloth_hangs_from_its_pins(skirt, monkeypatch, built):
    """With kernels, where they can be built, and without."""
    if not built:
        monkeypatch.setattr(kernels, "built", lambda: False)
    experiment, reel = skirt
    done = []
    frames = principal_shapes.simulate(experiment.scene, reel, experiment.config, done.append)
    assert frames.shape == (2, 5, len(experiment.garment.vertices), 3) and done[-1] == 2
    pinned = np.asarray(experiment.garment.pinned)
    assert np.abs(frames[:, :, pinned]).max() < 1e-4
    low = experiment.garment.vertices[:, 1] < np.quantile(experiment.garment.vertices[:, 1], 0.3)
    moved = np.linalg.norm(frames[:, :, low], axis=-1)
    assert 1e-3 < moved.mean() < 0.1


def test_the_components_span_what_was_simulated(skirt):
    experiment, _ = skirt
    random = np.random.default_rng(0)
    count = len(experiment.garment.vertices)
    true = random.normal(size=(3, 3 * count))
    frames = (random.normal(size=(8, 3)) * [5.0, 2.0, 1.0] @ true).reshape(2, 4, count, 3)
    shapes = principal_shapes.principal(frames, experiment.scene, of(experiment, blendshapes=12))
    assert shapes.shape == (12, count, 3)
    first = shapes[:3].reshape(3, -1).astype(np.float64)
    weights = np.linalg.lstsq(first.T, frames.reshape(8, -1).T, rcond=None)[0]
    np.testing.assert_allclose(first.T @ weights, frames.reshape(8, -1).T, atol=1e-3)
    np.testing.assert_array_equal(shapes[8:], 0.0)  # of eight frames
    # as large as smooth shapes: each costs 1 J
    network = laplacian_shapes.springs(experiment.scene, experiment.config)
    for shape in first.reshape(3, count, 3)[:, network.free]:
        assert np.trace(shape.T @ (network.matrix @ shape)) == pytest.approx(1.0, rel=1e-5)
    # the largest comes first
    assert np.linalg.norm(weights[0]) > np.linalg.norm(weights[2])


@pytest.mark.skipif(None in map(compilers.compiler, compilers.PROGRAMS), reason="needs a C and a C++ compiler")
def test_a_solve_in_kernels_is_that_of_the_dense_inverse(skirt):
    """For one gradient, for more than are solved for together, and for batches of batches."""
    assert kernels.built()
    experiment, _ = skirt
    springs = laplacian_shapes.springs(experiment.scene, experiment.config)
    vertices = len(experiment.garment.vertices)
    assert 0 < len(springs.free) < vertices
    factor = springs.factor()
    right = np.random.default_rng(0).normal(size=(3, 4, vertices, 3)).astype(np.float32)
    expected = np.zeros(right.shape)
    dense = springs.matrix.toarray()
    expected[:, :, springs.free] = np.linalg.solve(dense, right[:, :, springs.free].astype(np.float64))
    np.testing.assert_allclose(springs.inverse(vertices) @ right, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    for batch in ((0, 0), (slice(None), 1), (slice(None), slice(None))):
        solve = functools.partial(kernels.solve, factor)
        for _ in right[batch].shape[2:]:
            solve = jax.vmap(solve)
        found = jax.jit(solve)(right[batch])
        np.testing.assert_allclose(found, expected[batch], rtol=0, atol=1e-5 * np.abs(expected).max())


def test_what_blew_up_is_left_out(skirt, monkeypatch):
    experiment, reel = skirt
    found = np.zeros((2, 5, len(experiment.garment.vertices), 3), np.float32)
    found[1, 3, 7, 0] = np.nan
    monkeypatch.setattr(sampling, "make_sampler", lambda *_: lambda *_: found)
    assert len(principal_shapes.simulate(experiment.scene, reel, experiment.config)) == 1
    found[0, 0, 0, 0] = 9.0
    with pytest.raises(ValueError, match="look at the garment on the body"):
        principal_shapes.simulate(experiment.scene, reel, experiment.config)
    monkeypatch.setattr(kernels, "built", lambda: False)
    monkeypatch.setattr(principal_shapes, "MAX_VERTICES", 1000)
    with pytest.raises(ValueError, match=r"shapes\.sequences: 0"):
        principal_shapes.simulate(experiment.scene, reel, experiment.config)


def test_sampling_gives_each_key_its_own_and_all_of_them():
    done = []
    sample = sampling.make_sampler(lambda key, scale: scale * jax.random.uniform(key, (2,)))
    found = sample(sampling.keys(3, 11), (jnp.float32(2.0),), done.append)
    expected = 2 * np.stack([jax.random.uniform(key, (2,)) for key in jax.random.split(jax.random.key(3), 11)])
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    assert done[-1] == 11 and done == sorted(done)


def test_what_is_sampled_is_kept_and_only_what_is_missing_is_computed(tmp_path, monkeypatch):
    monkeypatch.setattr(sampling.os, "cpu_count", lambda: 3)  # which share the sequences
    sample = sampling.make_sampler(lambda key, scale: scale * jax.random.uniform(key, (2,)))
    keys = sampling.keys(3, 11)
    first, second = (sample(keys, (jnp.float32(scale),), folder=tmp_path) for scale in (2.0, 3.0))
    np.testing.assert_array_equal(first, second)
    files = sorted(tmp_path.iterdir())
    assert len(files) == 3
    files[1].unlink()
    mixed = sample(keys, (jnp.float32(3.0),), folder=tmp_path)
    expected = np.array(first)
    expected[4:8] *= 1.5
    np.testing.assert_allclose(mixed, expected, rtol=1e-6)
    files[1].write_bytes(files[1].read_bytes()[:100])
    with pytest.raises(ValueError, match=r"00004_4\.npy: not readable .*; remove it to compute it again"):
        sample(keys, (jnp.float32(3.0),), folder=tmp_path)


def test_a_run_that_is_ended_before_stage_1_simulates_no_cloth_again(skirt, tmp_path, monkeypatch):
    config = dataclasses.replace(
        skirt[0].config, model=dataclasses.replace(skirt[0].config.model, descent_samples=2), directory=str(tmp_path)
    )

    def begin(config):
        return pipeline.train_phi(pipeline.prepare(config, tmp_path))

    def ended(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline.preconditioner, "measure", ended)
    with pytest.raises(KeyboardInterrupt):
        begin(config)
    (kept,) = tmp_path.glob("simulated_*")
    assert len(list((kept / "shapes").iterdir())) >= 1
    folders, shapes = [], []
    monkeypatch.setattr(principal_shapes.descent, "descend", ended)
    monkeypatch.setattr(
        pipeline.preconditioner, "measure", lambda *given: (folders.append(given[-1]), np.eye(len(state(given))))[1]
    )

    def state(given):
        return given[0]["params"]["inverse_hessian"]

    monkeypatch.setattr(
        pipeline, "_fit", lambda run, stage, update, state, *_: shapes.append(state.params["garment"]["blendshapes"])
    )
    with pytest.raises(KeyboardInterrupt):  # other settings simulate anew
        begin(dataclasses.replace(config, shapes=dataclasses.replace(config.shapes, seed=1)))
    begin(config)
    assert folders == [kept / "hessians"] and np.abs(shapes[0]).max() > 0
    assert not list(tmp_path.glob("simulated_*"))
