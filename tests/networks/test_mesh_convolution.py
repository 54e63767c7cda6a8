"""The block against Zhou et al.'s own layers, in values and gradients; its padding and its initial values."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from clothjax.geometry import mesh_hierarchy
from clothjax.networks import mesh_convolution
from clothjax.networks.mesh_convolution import MeshConvolution
from clothjax.simulation.scene import Table

DATA = Path(__file__).parents[1] / "data" / "mesh_convolution.npz"  # layers 2, 3 and 4 of the golden chain
GOLDEN = Path(__file__).parents[3] / "shared" / "golden" / "golden_meshconv.npz"
NAMES = {"basis": "basis", "coefficients": "coeff", "bias": "bias", "density": "density", "skip": "skip"}


@pytest.fixture(autouse=True)
def strict():
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


def sheet(rows: int, columns: int) -> np.ndarray:
    """Faces of a rows x columns grid of vertices."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def table(stride=2, rows=9, columns=8):
    return mesh_hierarchy.hierarchy(sheet(rows, columns), rows * columns, [stride], [stride])[0]


def normal(*shape: int) -> np.ndarray:
    return np.random.default_rng(shape).standard_normal(shape).astype(np.float32)


def golden_layer(layer: int) -> dict:
    path = DATA if layer in (2, 3, 4) else GOLDEN
    if not path.exists():
        pytest.skip("../shared/golden/golden_meshconv.npz is not here")
    with np.load(path) as file:
        prefix = f"L{layer}_"
        values = {k.removeprefix(prefix): file[k] for k in file.files if k.startswith(prefix)}
        values["input"] = file["x" if layer == 0 else f"L{layer - 1}_out"]
        values["grad_input"] = file["grad_x" if layer == 0 else f"L{layer - 1}_grad_out"]
    return {k: v.astype(np.float64) if v.dtype == np.float32 else v for k, v in values.items()}


@pytest.mark.parametrize("basis_first", [False, True])
@pytest.mark.parametrize("layer", range(7))
def test_values_and_gradients_equal_the_golden_layers(layer, basis_first, monkeypatch):
    monkeypatch.setattr(mesh_convolution, "_basis_first", lambda *shape: basis_first)
    golden = golden_layer(layer)
    ids = golden["ids"]
    with jax.enable_x64(True):
        params = {ours: jnp.asarray(golden[theirs]) for ours, theirs in NAMES.items() if theirs in golden}
        if "basis" in params:
            params["basis"] = params["basis"].transpose(1, 0, 2)

        def block(params, x):
            rate, activation = float(golden["rate"]), jax.nn.elu if layer < 6 else lambda y: y
            bases = params["basis"].shape[1] if "basis" in params else 0
            one = MeshConvolution(golden["out"].shape[-1], bases, rate, activation)
            return one.apply({"params": params}, x, Table(ids, ids < golden["meta"][2]))

        @jax.jit
        def evaluate(params, x, cotangent):
            out, pull = jax.vjp(jax.vmap(block, (None, 0)), params, x)
            return out, *pull(cotangent)

        out, grads, grad_x = evaluate(params, golden["input"], golden["grad_out"])
    np.testing.assert_allclose(out, golden["out"], rtol=0, atol=1e-12)
    np.testing.assert_allclose(grad_x, golden["grad_input"], rtol=0, atol=1e-10)
    if "basis" in grads:
        grads["basis"] = grads["basis"].transpose(1, 0, 2)
    for ours, theirs in NAMES.items():
        assert (ours in grads) == (f"grad_{theirs}" in golden)
        if ours in grads:
            np.testing.assert_allclose(grads[ours], golden[f"grad_{theirs}"], rtol=0, atol=1e-10, err_msg=ours)


def test_padding_has_no_effect_and_no_gradient():
    level = table()
    padding = ~level.mask
    assert padding.any()
    x = normal(72, 5)
    params = {
        "basis": normal(5, 3, 7),
        "coefficients": normal(*level.ids.shape, 3),
        "bias": normal(7),
        "density": normal(*level.ids.shape),
        "skip": normal(5, 7),
    }

    @jax.jit
    def loss(params):
        return (MeshConvolution(7, 3).apply({"params": params}, x, level) ** 2).sum()

    quiet = loss(params)
    params["coefficients"][padding] = params["density"][padding] = 1e6
    np.testing.assert_allclose(loss(params), quiet, rtol=1e-6)
    grads = jax.device_get(jax.jit(jax.grad(loss))(params))
    for name in ("density", "coefficients"):
        assert (grads[name][padding] == 0).all()
        assert (grads[name][~padding] != 0).mean() > 0.5


def test_pooling_is_a_weighted_mean_whatever_the_sign_of_the_density():
    level = table()
    density, x = normal(*level.ids.shape), normal(72, 4)

    @jax.jit
    def pool(x):
        return MeshConvolution(4, 3, 1.0).apply({"params": {"density": density}}, x, level)

    np.testing.assert_allclose(pool(np.full_like(x, 2.5)), 2.5, rtol=1e-5)
    weights = [np.abs(row[mask]) for row, mask in zip(density, level.mask)]
    rows = [ids[mask] for ids, mask in zip(level.ids, level.mask)]
    expected = np.stack([w @ x[row] / w.sum() for w, row in zip(weights, rows)])
    np.testing.assert_allclose(pool(x), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "stride, out, rate, expected",
    [
        (2, 6, 0.5, {"basis", "coefficients", "bias", "density", "skip"}),
        (2, 4, 0.5, {"basis", "coefficients", "bias", "density"}),
        (1, 6, 0.5, {"basis", "coefficients", "bias", "skip"}),
        (1, 4, 0.5, {"basis", "coefficients", "bias"}),
        (2, 6, 0.0, {"basis", "coefficients", "bias"}),
        (2, 4, 1.0, {"density"}),
        (1, 4, 1.0, set()),
    ],
)
def test_parameters_are_only_those_that_rate_and_shapes_call_for(stride, out, rate, expected):
    level, x = table(stride), normal(72, 4)

    @jax.jit
    def born(key):
        block = MeshConvolution(out, 3, rate)
        params = block.init(key, x, level).get("params", {})

        def loss(params):
            y = block.apply({"params": params}, x, level)
            return (y**2).sum(), y

        return jax.grad(loss, has_aux=True)(params)

    grads, y = born(jax.random.key(0))
    assert set(grads) == expected
    assert y.shape == (len(level.ids), out) and y.dtype == jnp.float32 and np.isfinite(y).all()
    assert all(np.abs(grad).max() > 0 for grad in grads.values())


def test_rates_outside_zero_to_one_are_refused():
    with pytest.raises(ValueError, match=r"residual_rate is 1\.5"):
        MeshConvolution(4, 3, 1.5).init(jax.random.key(0), normal(72, 4), table())


def test_a_new_stack_keeps_the_size_of_smooth_features():
    levels = mesh_hierarchy.hierarchy(sheet(40, 40), 1600, [2, 2, 1], [2, 2, 1])
    place = np.stack(np.meshgrid(np.arange(40), np.arange(40), indexing="ij"), -1).reshape(-1, 2) / 20
    x = np.sqrt(2) * np.cos(place @ normal(2, 48) + 6 * normal(48)).astype(np.float32)

    @jax.jit
    def sizes(key, x):
        measured = []
        for index, (level, out) in enumerate(zip(levels, (96, 128, 64))):
            key = jax.random.fold_in(key, index)
            x, _ = MeshConvolution(out, 8).init_with_output(key, x, level)
            measured.append((x**2).mean())
        return jnp.stack(measured)

    measured = sizes(jax.random.key(2), x)
    assert ((measured > 0.5) & (measured < 2)).all(), measured


def test_the_cost_chooses_the_cheaper_order():
    narrow, wide, small = (
        (249, 249, 23, 1024, 8, 32),
        (4424, 1207, 27, 128, 256, 32),
        (1016, 290, 27, 48, 64, 8),
    )
    assert mesh_convolution._basis_first(*narrow)
    assert not mesh_convolution._basis_first(*wide)
    assert not mesh_convolution._basis_first(*small)
