"""Our HOOD against the values of HOOD's own code in float64: graph, features, normalisers, blocks and rollout."""

from pathlib import Path

import hood_oracle as hood
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hood_oracle import Cloth, State

from clothjax.geometry import mesh_hierarchy, topology
from clothjax.networks.message_passing import Block, Latents, reached
from clothjax.networks.mlp import _affine
from clothjax.simulation.scene import edge_set

DATA = Path(__file__).parents[1] / "data" / "hood_rollout.npz"  # of golden_hood_model_small.npz: a grid over a sphere
PREFIX = "_learned_model."


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def golden():
    with np.load(DATA) as file:
        return dict(file)


def closed_form(index: int, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """The golden file's parameters: a formula of the place in the list and in the (output, input) matrix."""
    place = np.arange(np.prod(shape))
    wave = np.sin(0.7 * place + 1.3 * index + 0.37 * (place // 7)).reshape(shape)
    if "embedding" in name:
        return wave
    if len(shape) == 2:
        return wave * np.sqrt(2 / shape[1]) * (0.05 if name == PREFIX + "decoder.layers.4.weight" else 1.0)
    if name.endswith(".1.weight"):
        return 1 + 0.1 * wave
    return 0.1 * wave * (0.05 if name == PREFIX + "decoder.layers.4.bias" else 1.0)


def torch_parameters(golden) -> dict[str, np.ndarray]:
    shapes = [tuple(int(n) for n in row if n) for row in golden["param_shapes"]]
    return {
        str(name): closed_form(index, str(name), shape)
        for index, (name, shape) in enumerate(zip(golden["param_names"], shapes))
    }


def ours(torch: dict[str, np.ndarray]) -> dict:
    """HOOD's parameters in our tree."""

    def layers(prefix):
        names = [f"{prefix}layers.{2 * i}." for i in range(3)]
        return {
            f"dense_{i}": {"kernel": torch[name + "weight"].T, "bias": torch[name + "bias"]}
            for i, name in enumerate(names)
        }

    def mlp(prefix):
        return layers(prefix + "0.") | {"norm": {"scale": torch[prefix + "1.weight"], "bias": torch[prefix + "1.bias"]}}

    def block(level, step, stack):
        prefix = f"{PREFIX}levels.{level}.{step}."
        names = {"world": "world_edge", "mesh": "mesh_edge", "coarse0": "coarse_edge0", "coarse1": "coarse_edge1"}
        edges = {f"edge_{n}": mlp(f"{prefix}edge_processor_dict.{names[n]}.") for n in (*stack.edges, "world")}
        return edges | {"node": mlp(prefix + "node_processor_dict.node.")}

    encoder = {"nodes": mlp(PREFIX + "node_encoder.")}
    encoder |= {n: mlp(f"{PREFIX}edgeset_encoders.{n}.") for n in ("mesh", "coarse0", "coarse1", "world")}
    return {
        "type_embedding": torch["nodetype_embedding.weight"],
        "level_embedding": torch["vertexlevel_embedding.weight"],
        "encoder": encoder,
        "processor": {
            str(level): jax.tree.map(
                lambda *parts: np.stack(parts), *(block(level, i, stack) for i in range(stack.blocks))
            )
            for level, stack in enumerate(hood.SCHEDULE)
        },
        "decoder": layers(PREFIX + "decoder."),
    }


def cloth(golden) -> Cloth:
    faces, count = golden["faces"], len(golden["rest_pos"])
    levels = mesh_hierarchy.coarse_levels(faces, 3, centre=int(golden["center"]))
    graph = {"mesh": edge_set(topology.edges(faces), count)}
    graph |= {f"coarse{i}": edge_set(level, count) for i, level in enumerate(levels)}
    rest = golden["rest_pos"]
    area = 0.5 * np.linalg.norm(
        np.cross(rest[faces[:, 1]] - rest[faces[:, 0]], rest[faces[:, 2]] - rest[faces[:, 0]]), axis=1
    )
    mass = np.zeros(count)
    np.add.at(mass, faces.ravel(), np.repeat(0.20022 * area / 3, 3))
    return Cloth(
        rest=rest,
        faces=faces,
        mass=mass,
        materials=golden["material_inputs"],
        pinned=np.isin(np.arange(count), golden["pinned"]),
        graph=graph,
        level=mesh_hierarchy.vertex_levels(count, levels),
        body_faces=golden["body_faces"],
        omitted=np.isin(np.arange(len(golden["roll0_body"][0])), golden["omit"]),
    )


def test_graph_and_masses_are_hoods(golden):
    garment = cloth(golden)
    np.testing.assert_array_equal(garment.level, golden["vertex_level"])
    for name, edges in garment.graph.items():
        expected = golden[f"{name}_edge_index"]
        assert set(zip(edges.senders.tolist(), edges.receivers.tolist())) == set(zip(*expected.tolist()))
    np.testing.assert_allclose(garment.mass, golden["v_mass"], rtol=1e-6)  # HOOD rounds them to float32


@pytest.mark.slow
def test_three_steps_of_a_rollout_are_hoods(golden):
    """Of training: raw states in, statistics that grow from step to step, positions out."""
    garment = cloth(golden)._replace(mass=golden["v_mass"])
    params = jax.tree.map(jnp.asarray, ours(torch_parameters(golden)))
    statistics = hood.init_statistics()
    rest = golden["roll0_in_cloth_pos"]
    state = State(rest, rest, np.zeros_like(rest))
    for frame in range(3):
        bodies, target = golden[f"roll{frame}_body"], golden[f"roll{frame}_in_cloth_target_pos"]
        timestep = jnp.asarray(1 / 3 if frame == 0 else 1 / 30)
        if frame > 0:
            # its own, to the last bit: the first steps are 1e-8 m long, and their rounding counts after normalisation
            last = golden[f"roll{frame - 1}_pred_pos"]
            velocity = golden[f"roll{frame - 1}_pred_velocity"]
            # HOOD forgets where the first step began
            state = State(last if frame == 1 else golden["roll0_pred_pos"], last, velocity)
        state, statistics, taken = hood.step(
            params, statistics, garment, State(*map(jnp.asarray, state)), jnp.asarray(bodies), jnp.asarray(target),
            timestep, training=True,
        )  # fmt: skip
        pairs = golden[f"roll{frame}_pairs"]
        np.testing.assert_array_equal(np.flatnonzero(taken.active), pairs[0])
        np.testing.assert_array_equal(taken.vertices[taken.slots[taken.active]], pairs[1])
        # in the first step all time steps are equal; HOOD divides what sums of them are rounded by, by 1e-8
        atol = 1e-6 if frame == 0 else 1e-9
        np.testing.assert_allclose(taken.output, golden[f"roll{frame}_core_out"], rtol=0, atol=atol)
        free = ~garment.pinned
        np.testing.assert_allclose(
            taken.acceleration[free], golden[f"roll{frame}_pred_acceleration"][free], rtol=0, atol=1e-12
        )
        np.testing.assert_allclose(state.position, golden[f"roll{frame}_pred_pos"], rtol=0, atol=1e-12)
        np.testing.assert_allclose(state.velocity, golden[f"roll{frame}_pred_velocity"], rtol=0, atol=1e-12)
        for name in ("nodes", "mesh", "world", "output"):
            count, total, squares = golden[f"roll{frame}_{name}_statistics"]
            np.testing.assert_allclose(statistics[name].count, count[0], rtol=0)
            mean = total / count
            np.testing.assert_allclose(statistics[name].mean, mean, rtol=0, atol=1e-12)
            np.testing.assert_allclose(statistics[name].variance, squares / count - mean**2, rtol=0, atol=1e-12)


def test_every_block_is_hoods(golden, shared):
    """Node latents, of garment and body, after each of the 15 blocks of the last step."""
    with np.load(shared / "golden" / "golden_hood_model_small.npz") as file:
        full = dict(file)
    garment = cloth(golden)
    params = jax.tree.map(jnp.asarray, ours(torch_parameters(golden)))
    count = len(garment.rest)
    pairs = full["roll2_ei_c2o"]
    slots = np.zeros(count, np.int32)
    slots[pairs[0]] = pairs[1]  # here a slot for every body vertex
    active = np.zeros(count, bool)
    active[pairs[0]] = True

    def rows(name, on):
        """Latents of HOOD's edges in our order."""
        order = {edge: index for index, edge in enumerate(zip(*full[f"{on}_edge_index"].tolist()))}
        where = [order[edge] for edge in zip(garment.graph[on].senders.tolist(), garment.graph[on].receivers.tolist())]
        return jnp.asarray(full[name][where])

    def world(name):
        latents = np.zeros((count, full[name].shape[1]))
        latents[pairs[0]] = full[name]
        return jnp.asarray(latents)

    body = np.zeros((count, 16))
    body[: len(full["roll2_enc_obst"])] = full["roll2_enc_obst"]
    nodes, body = jnp.asarray(full["roll2_enc_cloth"]), jnp.asarray(body)
    edges = {"mesh": rows("roll2_enc_mesh", "mesh")}
    edges |= {f"coarse{i}": rows(f"roll2_enc_c{i}", f"coarse{i}") for i in (0, 1)}
    pair_latents = {"to_body": world("roll2_enc_c2o"), "to_garment": world("roll2_enc_o2c")}
    done = 0
    for stack, stacked, least in zip(hood.SCHEDULE, params["processor"].values(), (0, 1, 2, 1, 0)):
        rows, graphs = reached(stack, garment.graph, garment.level)
        here = slice(None) if rows is None else rows
        np.testing.assert_array_equal(np.arange(count)[here], np.flatnonzero(garment.level >= least))
        one = Block(16, 3, graphs, rows)
        for index in range(stack.blocks):
            p = jax.tree.map(lambda x, index=index: x[index], stacked)
            near = {name: latents[here] for name, latents in pair_latents.items()}
            latents = Latents(nodes, body, {name: edges[name] for name in stack.edges}, near)
            (nodes, body, updated, near), _ = one.apply(
                {"params": p}, latents, jnp.asarray(slots[here]), jnp.asarray(active[here])
            )
            edges |= updated
            pair_latents = {name: pair_latents[name].at[here].set(latents) for name, latents in near.items()}
            np.testing.assert_allclose(nodes, full[f"roll2_step{done:02d}_cloth"], rtol=0, atol=1e-10)
            touched = np.unique(pairs[1])
            np.testing.assert_allclose(body[touched], full[f"roll2_step{done:02d}_obst"][touched], rtol=0, atol=1e-10)
            done += 1
    assert done == 15


def test_the_gradient_of_scale_and_bias_is_jaxs_own():
    random = np.random.default_rng(0)
    x, weight, scale, bias = (jnp.asarray(random.normal(size=s)) for s in ((7, 5), (7, 5), 5, 5))

    def loss(affine):
        return lambda *args: jnp.sum(weight * affine(*args) ** 3)

    ours = jax.grad(loss(_affine), (0, 1, 2))(x, scale, bias)
    jaxs = jax.grad(loss(lambda x, s, b: x * s[None] + b[None]), (0, 1, 2))(x, scale, bias)
    for one, other in zip(ours, jaxs):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_pinned_vertices_go_where_they_are_told(golden):
    garment = cloth(golden)._replace(mass=golden["v_mass"])
    params = jax.tree.map(jnp.asarray, ours(torch_parameters(golden)))
    rest = jnp.asarray(golden["roll0_in_cloth_pos"])
    target = rest + 0.01
    state, statistics, _ = hood.step(
        params, hood.init_statistics(), garment, State(rest, rest, 0 * rest), jnp.asarray(golden["roll0_body"]), target,
        jnp.asarray(1 / 30), training=False,
    )  # fmt: skip
    np.testing.assert_array_equal(state.position[garment.pinned], target[garment.pinned])
    np.testing.assert_array_equal(state.velocity[garment.pinned], 0.0)
    assert all(entry.count == 0 for entry in statistics.values())  # not training
