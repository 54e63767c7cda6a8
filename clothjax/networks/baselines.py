"""Networks of peers, trained in the place of Phi and Psi by the same losses: what the method is compared with.

NCS (Bertiche et al. 2022) and the recurrent network of SNUG (Santesteban et al. 2022) go from the pose to the garment
without its state; what they know of the past is in gated recurrent units. Both are given what Psi is given too: the
pose without its heading, of the joints that are Psi's inputs, and the wearer's betas and material. SNUG's pose is in
6-D codes, not in axis-angle vectors. NCS's motion augmentation is left out, as in its published settings.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import rotation, skinning
from clothjax.config import Config, PeerConfig
from clothjax.networks import decoder, psi
from clothjax.networks.mlp import Params, dense
from clothjax.types import Array, Pose

STATIC = (64, 128, 256)  # NCS's static encoder, before its last layer
LOCAL = 32  # what NCS's dynamic encoder makes of each joint
GRUS = 4  # SNUG's recurrent layers


def memory_size(config: Config) -> int:
    """Numbers that a network carries from frame to frame."""
    if config.peer.network == "direct":
        return config.model.latent
    return config.peer.width * (GRUS if config.peer.network == "snug" else 1)


def init(key: Array, joints: int, constants: int, shapes: Array, config: Config) -> Params:
    """Parameters for so many joints that are inputs, and constants of a wearer.

    Args:
        shapes: [K, V, 3] m, blend shapes for Psi to start from; of the others, they only give the vertices.
    """
    peer, vertices = config.peer, shapes.shape[1]
    if peer.network == "direct":
        return _init_direct(key, joints, constants, shapes, config)
    make = {"ncs": _init_ncs, "snug": _init_snug}[peer.network]
    return make(key, joints, constants, vertices, peer)


def displacement(
    params: Params,
    memory: Array,
    poses: Pose,
    joints: Array,
    constants: Array,
    parents: np.ndarray,
    kept: np.ndarray,
    config: Config,
) -> tuple[Array, Array]:
    """Canonical displacement [V, 3] m at the last of three poses, and the memory [M] that it leaves.

    Args:
        memory: [M] of the frame before; joints: [J, 3] m, of the shaped body; constants: [C] of the wearer.
        kept: joint indices, the root first.
    """
    if config.peer.network == "direct":
        return _direct(params, memory, poses, joints, constants, parents, kept, config)
    seen = inputs(poses, joints, constants, parents, kept, config)
    run = _snug if config.peer.network == "snug" else _ncs
    shapes, memory = run(params, memory, **seen)
    return shapes.reshape(-1, 3), memory


def inputs(
    poses: Pose, joints: Array, constants: Array, parents: np.ndarray, kept: np.ndarray, config: Config
) -> dict[str, Array]:
    """What NCS or SNUG sees of three poses: `static` [S] and `dynamic` [Jk, 12], or `inputs` [N]."""
    poses = _facing(poses, int(kept[0]))
    if config.peer.network == "snug":
        codes = rotation.to_6d(poses.rotations[2, kept]).reshape(-1)
        return {"inputs": jnp.concatenate([codes, config.fps * poses.translation[2], constants])}
    static, dynamic = joint_inputs(poses, joints, parents, kept, config.fps)
    return {"static": jnp.concatenate([static.reshape(-1), constants]), "dynamic": dynamic}


def _facing(poses: Pose, root: int) -> Pose:
    """A window of three poses, turned about the vertical so that the last one faces ahead."""
    turn = rotation.heading(poses.rotations[2, root]).T
    turned = jnp.matmul(turn[None], poses.rotations[:, root], precision="highest")
    advance = jnp.einsum("ab,nb->na", turn, poses.translation, precision="highest")
    return Pose(poses.rotations.at[:, root].set(turned), advance)


# --- NCS ----------------------------------------------------------------------------------------------------------


def joint_inputs(poses: Pose, joints: Array, parents: np.ndarray, kept: np.ndarray, fps: float) -> tuple[Array, Array]:
    """NCS's inputs of every joint: static [Jk, 9], its 6-D rotation and where down is; dynamic [Jk, 12], their rate of
    change, and its acceleration in m/s^2, both in its own frame."""

    def one(rotations, translation):
        turns, positions = skinning.forward_kinematics(rotations, joints, parents)
        down = -turns[:, 1, :]  # R^T (0, -1, 0)
        codes = jnp.concatenate([rotation.to_6d(rotations), down], axis=-1)
        return codes[kept], positions[kept] + translation[None], turns[kept]

    codes, positions, turns = jax.vmap(one)(poses.rotations, poses.translation)
    acceleration = fps**2 * (positions[2] - 2.0 * positions[1] + positions[0])
    local = jnp.einsum("jba,jb->ja", turns[2], acceleration, precision="highest")
    return codes[2], jnp.concatenate([fps * (codes[2] - codes[1]), local], axis=-1)


def _init_ncs(key: Array, joints: int, constants: int, vertices: int, config: PeerConfig) -> Params:
    """With NCS's own random numbers: N(0, 0.05) for its layers, blend shapes as Glorot and Bengio."""
    normal, width = nn.initializers.normal(0.05), config.width
    keys = iter(jax.random.split(key, 16))

    def layers(sizes, bias):
        return [
            {"kernel": normal(next(keys), pair)} | ({"bias": jnp.zeros(pair[1])} if bias else {})
            for pair in zip(sizes[:-1], sizes[1:])
        ]

    return {
        "static": layers((9 * joints + constants, *STATIC, width), True),
        "local": layers((12, LOCAL, LOCAL), False),
        "dynamic": layers((LOCAL * joints, width, width), False),
        "unit": _init_gru(next(keys), width, width, bias=False),
        "decoder": layers((width, width, width, config.blendshapes), True),
        "blendshapes": nn.initializers.glorot_normal()(next(keys), (config.blendshapes, 3 * vertices)),
    }


def _ncs(params: Params, memory: Array, static: Array, dynamic: Array) -> tuple[Array, Array]:
    """Displacements [3 V] m and the dynamic code [W], which is the memory: zero as long as nothing moves."""
    for layer in params["static"]:
        static = nn.relu(dense(layer, static))
    for layer in params["local"]:
        dynamic = nn.relu(dynamic @ layer["kernel"])
    dynamic = dynamic.reshape(-1)
    for layer in params["dynamic"]:
        dynamic = nn.relu(dynamic @ layer["kernel"])
    memory = _gru(params["unit"], memory, dynamic)
    code = static + memory
    for layer in params["decoder"]:
        code = nn.relu(dense(layer, code))
    return code @ params["blendshapes"], memory


# --- SNUG ---------------------------------------------------------------------------------------------------------


def _init_snug(key: Array, joints: int, constants: int, vertices: int, config: PeerConfig) -> Params:
    *keys, last = jax.random.split(key, GRUS + 1)
    width = config.width
    sizes = (6 * joints + 3 + constants, *(width,) * (GRUS - 1))
    return {
        "units": [_init_gru(k, size, width, bias=True) for k, size in zip(keys, sizes)],
        "output": {
            "kernel": nn.initializers.glorot_normal()(last, (width, 3 * vertices)),
            "bias": jnp.zeros(3 * vertices),
        },
    }


def _snug(params: Params, memory: Array, inputs: Array) -> tuple[Array, Array]:
    """Displacements [3 V] m and the states [4 W] of its units."""
    states = []
    for unit, state in zip(params["units"], jnp.split(memory, GRUS)):
        inputs = _gru(unit, state, inputs)
        states.append(inputs)
    return dense(params["output"], inputs), jnp.concatenate(states)


# --- Psi without stage 1 ------------------------------------------------------------------------------------------


def _init_direct(key: Array, joints: int, constants: int, shapes: Array, config: Config) -> Params:
    keys, code = jax.random.split(key), config.model.latent
    inputs = 6 + 3 * 6 * joints + 3 * 3 * (joints - 1)
    return {
        "predictor": psi.init(keys[0], code, inputs, constants, config.stage2),
        "garment": decoder.init(keys[1], code, 0.1 * shapes, config.model),
    }


def _direct(params, memory, poses, joints, constants, parents, kept, config: Config) -> tuple[Array, Array]:
    """Psi with codes and inputs as they are: without a teacher there is nothing to normalise codes by."""
    inputs = psi.window_inputs(poses, joints, parents, kept, config.fps)
    code = psi.predict(params["predictor"], memory, inputs, constants, config.stage2.latent_decay)
    free = jnp.ones(params["garment"]["blendshapes"].shape[1])
    return decoder.displacement(params["garment"], code, free, config.model), code


# --- gated recurrent units ----------------------------------------------------------------------------------------


def _init_gru(key: Array, inputs: int, width: int, *, bias: bool) -> Params:
    first, second = jax.random.split(key)
    kernels = {
        "input": {"kernel": nn.initializers.glorot_uniform()(first, (inputs, 3 * width))},
        "state": {"kernel": nn.initializers.orthogonal()(second, (width, 3 * width))},
    }
    return {name: each | ({"bias": jnp.zeros(3 * width)} if bias else {}) for name, each in kernels.items()}


def _gru(params: Params, state: Array, inputs: Array) -> Array:
    """A gated recurrent unit (Cho et al. 2014), its reset gate after the product, with or without biases."""

    def product(name: str, x: Array) -> list[Array]:
        layer = params[name]
        return jnp.split(dense(layer, x) if "bias" in layer else x @ layer["kernel"], 3)

    (update, reset, new), (update_state, reset_state, new_state) = product("input", inputs), product("state", state)
    update = nn.sigmoid(update + update_state)
    new = jnp.tanh(new + nn.sigmoid(reset + reset_state) * new_state)
    return update * state + (1.0 - update) * new
