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
from clothjax.config import Config
from clothjax.networks import decoder, psi
from clothjax.networks.mlp import Params
from clothjax.types import Array, Pose

STATIC = (64, 128, 256)  # NCS's static encoder, before its last layer
LOCAL = 32  # what NCS's dynamic encoder makes of each joint
GRUS = 4  # SNUG's recurrent layers


def memory_size(config: Config) -> int:
    """Numbers that a network carries from frame to frame."""
    if config.peer.network == "direct":
        return config.model.latent
    return config.peer.width * (GRUS if config.peer.network == "snug" else 1)


def network(config: Config, vertices: int) -> nn.Module:
    """The configured network of a garment of V vertices.

    It takes the memory [M] of the frame before and what `inputs` gives. It returns the canonical displacement
    [V, 3] m and the memory that it leaves.
    """
    kinds = {"ncs": NCS, "snug": SNUG, "direct": Direct}
    return kinds[config.peer.network](config, vertices)


def init(key: Array, joints: int, constants: int, shapes: Array, config: Config) -> Params:
    """Parameters for so many joints that are inputs, and constants of a wearer.

    Args:
        shapes: [K, V, 3] m, blend shapes for Psi to start from; of the others, they only give the vertices.
    """
    seen = {
        "ncs": {"static": jnp.zeros(9 * joints + constants), "dynamic": jnp.zeros((joints, 12))},
        "snug": {"inputs": jnp.zeros(6 * joints + 3 + constants)},
        "direct": {"pose": jnp.zeros(6 + 3 * 6 * joints + 3 * 3 * (joints - 1)), "constants": jnp.zeros(constants)},
    }[config.peer.network]
    memory = jnp.zeros(memory_size(config))
    params = network(config, shapes.shape[1]).init(key, memory, **seen)["params"]
    if config.peer.network == "direct":
        params["garment"]["blendshapes"] = 0.1 * shapes
    return params


def inputs(
    poses: Pose, joints: Array, constants: Array, parents: np.ndarray, kept: np.ndarray, config: Config
) -> dict[str, Array]:
    """What a network sees of three poses: NCS `static` [S] and `dynamic` [Jk, 12]; SNUG `inputs` [N]; Psi `pose` [P]
    and `constants` [C].

    Args:
        joints: [J, 3] m, of the shaped body; constants: [C] of the wearer; kept: joint indices, the root first.
    """
    if config.peer.network == "direct":
        return {"pose": psi.window_inputs(poses, joints, parents, kept, config.fps), "constants": constants}
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


class Layers(nn.Module):
    """Dense layers of these sizes, a ReLU behind each, with NCS's own random numbers: N(0, 0.05)."""

    sizes: tuple[int, ...]
    bias: bool = True

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for index, size in enumerate(self.sizes):
            layer = nn.Dense(size, self.bias, kernel_init=nn.initializers.normal(0.05), name=str(index))
            x = nn.relu(layer(x))
        return x


class NCS(nn.Module):
    """The network of NCS, its blend shapes initialised as Glorot and Bengio."""

    config: Config
    vertices: int

    @nn.compact
    def __call__(self, memory: Array, static: Array, dynamic: Array) -> tuple[Array, Array]:
        """Displacements [V, 3] m and the dynamic code [W], which is the memory: zero as long as nothing moves."""
        peer, width = self.config.peer, self.config.peer.width
        static = Layers((*STATIC, width), name="static")(static)
        local = Layers((LOCAL, LOCAL), bias=False, name="local")(dynamic)
        moving = Layers((width, width), bias=False, name="dynamic")(local.reshape(-1))
        memory = GRU(width, bias=False, name="unit")(memory, moving)
        weights = Layers((width, width, peer.blendshapes), name="decoder")(static + memory)
        size = (peer.blendshapes, 3 * self.vertices)
        return (weights @ self.param("blendshapes", nn.initializers.glorot_normal(), size)).reshape(-1, 3), memory


# --- SNUG ---------------------------------------------------------------------------------------------------------


class Units(nn.Module):
    """Gated recurrent units, one after the other."""

    width: int

    @nn.compact
    def __call__(self, memory: Array, x: Array) -> Array:
        """The new states [4 W] from those before and the inputs [N]."""
        states = []
        for index, state in enumerate(jnp.split(memory, GRUS)):
            x = GRU(self.width, name=str(index))(state, x)
            states.append(x)
        return jnp.concatenate(states)


class SNUG(nn.Module):
    """The recurrent network of SNUG."""

    config: Config
    vertices: int

    @nn.compact
    def __call__(self, memory: Array, inputs: Array) -> tuple[Array, Array]:
        """Displacements [V, 3] m and the states [4 W] of its units."""
        width = self.config.peer.width
        memory = Units(width, name="units")(memory, inputs)
        output = nn.Dense(3 * self.vertices, kernel_init=nn.initializers.glorot_normal(), name="output")
        return output(memory[-width:]).reshape(-1, 3), memory


# --- Psi without stage 1 ------------------------------------------------------------------------------------------


class Direct(nn.Module):
    """Psi with codes and inputs as they are: without a teacher there is nothing to normalise codes by."""

    config: Config
    vertices: int

    def setup(self):
        self.predictor = psi.Psi(self.config.stage2)
        self.garment = decoder.Decoder(self.config.model, self.config.model.latent, self.vertices)

    def __call__(self, memory: Array, pose: Array, constants: Array) -> tuple[Array, Array]:
        """Displacements [V, 3] m and the code [L], which is the memory."""
        code = self.predictor(memory, pose, constants)
        return self.garment(code, jnp.ones(self.vertices)), code


# --- gated recurrent units ----------------------------------------------------------------------------------------


class GRU(nn.Module):
    """A gated recurrent unit (Cho et al. 2014), its reset gate after the product, with or without biases."""

    width: int
    bias: bool = True

    @nn.compact
    def __call__(self, state: Array, x: Array) -> Array:
        """The new state [W] from the one before and the inputs [N]."""

        def product(name: str, rows: Array, kernel) -> list[Array]:
            return jnp.split(nn.Dense(3 * self.width, self.bias, kernel_init=kernel, name=name)(rows), 3)

        update, reset, new = product("input", x, nn.initializers.glorot_uniform())
        update_state, reset_state, new_state = product("state", state, nn.initializers.orthogonal())
        update = nn.sigmoid(update + update_state)
        new = jnp.tanh(new + nn.sigmoid(reset + reset_state) * new_state)
        return update * state + (1.0 - update) * new
