"""Message passing with its blocks recomputed, and in chunks, is the same function."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from clothjax.config import Stack
from clothjax.networks import message_passing, mlp
from clothjax.physics import solver
from clothjax.types import EdgeSet

VERTICES, BODY, WIDTH, LAYERS = 30, 5, 4, 3
STACKS = (Stack(("mesh", "coarse0"), 2), Stack(("coarse0",), 1), Stack(("mesh",), 1))


def problem():
    """A loss of parameters and latents on a random graph beside a random body, and its arguments."""
    random = np.random.default_rng(0)
    level = (np.arange(VERTICES) % 3 == 0).astype(int)
    graph = {}
    for name, among in {"mesh": np.arange(VERTICES), "coarse0": np.flatnonzero(level)}.items():
        graph[name] = EdgeSet(random.choice(among, 4 * len(among)), np.repeat(among, 4))

    def latents(count):
        return jnp.asarray(random.normal(size=(count, WIDTH)))

    inputs = {
        "params": message_passing.init_processor(jax.random.key(1), STACKS, WIDTH, LAYERS),
        "nodes": latents(VERTICES),
        "edges": {name: latents(len(each.senders)) for name, each in graph.items()},
        "body": latents(BODY),
        "pairs": {name: latents(VERTICES) for name in ("to_garment", "to_body")},
    }
    slots, active = random.integers(0, BODY, VERTICES), random.random(VERTICES) < 0.5

    def loss(inputs, remat):
        world = message_passing.World(inputs["body"], jnp.asarray(slots), jnp.asarray(active), inputs["pairs"])
        nodes, edges = inputs["nodes"], inputs["edges"]
        done = message_passing.process(inputs["params"], STACKS, nodes, edges, world, graph, level, remat=remat)
        return jnp.mean(jnp.sin(done)), done

    return loss, inputs


@pytest.mark.parametrize("chunk", [7, 1024])
def test_recomputed_blocks_give_the_same_nodes_and_gradients(monkeypatch, chunk):
    monkeypatch.setattr(message_passing, "CHUNK", chunk)
    loss, inputs = problem()
    with jax.enable_x64(True):
        inputs = jax.tree.map(solver.to_float64, inputs)
        step = jax.jit(jax.value_and_grad(loss, has_aux=True), static_argnums=1)
        kept, recomputed = (jax.tree.leaves(step(inputs, remat)) for remat in (False, True))
    for one, other in zip(kept, recomputed, strict=True):
        np.testing.assert_allclose(np.asarray(one), np.asarray(other), atol=1e-13)


@pytest.mark.parametrize("remat", [False, True])
def test_in_bfloat16_every_product_is_and_nothing_that_is_kept(remat):
    loss, inputs = problem()
    inputs = jax.tree.map(lambda x: x.astype(jnp.float32), inputs)

    def rounded(inputs):
        return loss(inputs | {"params": mlp.in_bfloat16(inputs["params"])}, remat)

    step = jax.grad(rounded, has_aux=True)
    program = str(jax.make_jaxpr(step)(inputs))
    products = re.findall(r"(\w+)\[([\d,]*)\] = dot_general", program)
    sums_of_rows = f"1,{WIDTH}"  # of a LayerNorm, backward
    assert {kind for kind, shape in products if shape != sums_of_rows} == {"bf16"}
    others = set(re.findall(r"bf16\[[\d,]*\] = (\w+)", program))
    assert not others & {"add", "sub", "mul", "div", "max", "reduce_sum", "scatter-add"}, others


def test_a_product_in_bfloat16_is_that_of_rounded_numbers():
    params = mlp.init_dense(jax.random.key(0), 40, 6) | {"bias": jnp.arange(6.0)}
    x = jax.random.normal(jax.random.key(1), (50, 40))
    low = np.asarray(mlp.dense(mlp.in_bfloat16({"dense": params})["dense"], x))
    a, b = (np.asarray(each.astype(jnp.bfloat16), np.float64) for each in (x, params["kernel"]))
    np.testing.assert_allclose(low, a @ b + np.asarray(params["bias"]), rtol=2**-7, atol=2**-7)
    assert np.abs(low - np.asarray(mlp.dense(params, x))).max() > 1e-4
    many = jnp.ones((12_001, 40))

    def total(params):
        return jnp.sum(mlp.dense(mlp.in_bfloat16({"dense": params})["dense"], many))

    np.testing.assert_allclose(jax.grad(total)(params)["bias"], 12_001)  # a sum in bfloat16 would be coarser


def test_recomputed_blocks_take_less_memory():
    loss, inputs = problem()
    step = jax.jit(jax.grad(loss, has_aux=True), static_argnums=1)
    kept, recomputed = (
        step.lower(inputs, remat).compile().memory_analysis().temp_size_in_bytes for remat in (False, True)
    )
    assert recomputed < kept
