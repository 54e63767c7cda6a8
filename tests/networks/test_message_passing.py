"""Message passing with its blocks recomputed, and in chunks, is the same function."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from clothjax.config import Stack
from clothjax.networks import mlp
from clothjax.networks.message_passing import Processor, World
from clothjax.physics import solver
from clothjax.simulation.scene import edge_set

VERTICES, BODY, WIDTH, LAYERS = 30, 5, 4, 3
STACKS = (Stack(("mesh", "coarse0"), 2), Stack(("coarse0",), 1), Stack(("mesh",), 1))


def problem():
    """A loss of parameters and latents on a random graph beside a random body, and its arguments."""
    random = np.random.default_rng(0)
    level = (np.arange(VERTICES) % 3 == 0).astype(int)
    graph = {}
    for name, among in {"mesh": np.arange(VERTICES), "coarse0": np.flatnonzero(level)}.items():
        graph[name] = edge_set(random.choice(among, (2 * len(among), 2)), VERTICES)

    def latents(count):
        return jnp.asarray(random.normal(size=(count, WIDTH)))

    slots, active = random.integers(0, BODY, VERTICES), random.random(VERTICES) < 0.5
    inputs = {
        "nodes": latents(VERTICES),
        "edges": {name: latents(len(each.senders)) for name, each in graph.items()},
        "body": latents(BODY),
        "pairs": {name: latents(VERTICES) for name in ("to_garment", "to_body")},
    }

    def arguments(inputs):
        world = World(inputs["body"], jnp.asarray(slots), jnp.asarray(active), inputs["pairs"])
        return inputs["nodes"], {n: graph[n]._replace(edges=x) for n, x in inputs["edges"].items()}, world

    def processor(remat):
        return Processor(STACKS, WIDTH, LAYERS, level, remat)

    def loss(inputs, remat):
        done = processor(remat).apply({"params": inputs["params"]}, *arguments(inputs))
        return jnp.mean(jnp.sin(done)), done

    inputs["params"] = processor(False).init(jax.random.key(1), *arguments(inputs))["params"]
    return loss, inputs


@pytest.mark.parametrize("chunk", [7, 1024])
def test_recomputed_blocks_give_the_same_nodes_and_gradients(monkeypatch, chunk):
    monkeypatch.setattr(mlp, "CHUNK", chunk)
    loss, inputs = problem()
    with jax.enable_x64(True):
        inputs = jax.tree.map(solver.to_float64, inputs)
        step = jax.jit(jax.value_and_grad(loss, has_aux=True), static_argnums=1)
        kept, recomputed = (jax.tree.leaves(step(inputs, remat)) for remat in (False, True))
    for one, other in zip(kept, recomputed, strict=True):
        np.testing.assert_allclose(np.asarray(one), np.asarray(other), atol=1e-13)


@pytest.mark.slow
def test_recomputed_blocks_take_less_memory():
    loss, inputs = problem()
    step = jax.jit(jax.grad(loss, has_aux=True), static_argnums=1)
    kept, recomputed = (
        step.lower(inputs, remat).compile().memory_analysis().temp_size_in_bytes for remat in (False, True)
    )
    assert recomputed < kept
