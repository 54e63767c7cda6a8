"""Networks that the method is compared with, trained by the same losses in the place of Phi and Psi.

NCS (Bertiche et al. 2022) and the recurrent network of SNUG (Santesteban et al. 2022) go from the pose to the garment
without its state; gated recurrent units remember the past. Both have Psi's inputs: the pose of Psi's joints without
its heading, and the character's betas and material. SNUG's pose is in the 6D representation, not in axis-angle
vectors. NCS's motion augmentation is left out, as in its published settings.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import rotation, skinning
from clothjax.config import Config
from clothjax.networks import decoder, mlp, psi
from clothjax.networks.mlp import Params
from clothjax.types import Array, Pose

STATIC = (64, 128, 256)  # NCS's static encoder, before its last layer
LOCAL = 32  # channels of each joint in NCS's dynamic encoder
GRUS = 4  # SNUG's recurrent layers


def memory_size(config: Config) -> int:
    """Return how many numbers the configured network carries from frame to frame."""
    if config.peer.network == "direct":
        return config.model.latent
    return config.peer.width * (GRUS if config.peer.network == "snug" else 1)


def network(config: Config, vertices: int) -> nn.Module:
    """Build the configured network of a garment of V vertices.

    It takes the memory [M] of the frame before and what `inputs` gives. It returns the canonical displacement
    [V, 3] m and the memory that it leaves.
    """
    kinds = {"ncs": NCS, "snug": SNUG, "direct": Direct}
    return kinds[config.peer.network](config, vertices)


def init(key: Array, joints: int, constants: int, shapes: Array, config: Config) -> Params:
    """Return initial parameters of the configured network.

    Args:
        joints: number of joints that are inputs.
        constants: number of constants of a character.
        shapes: [K, V, 3] m, blend shapes for Psi to start from; the others only count the vertices in them.
    """
    example = {
        "ncs": {"static": jnp.zeros(9 * joints + constants), "dynamic": jnp.zeros((joints, 12))},
        "snug": {"inputs": jnp.zeros(6 * joints + 3 + constants)},
        "direct": {"pose": jnp.zeros(6 + 3 * 6 * joints + 3 * 3 * (joints - 1)), "constants": jnp.zeros(constants)},
    }[config.peer.network]
    memory = jnp.zeros(memory_size(config))
    params = mlp.init(network(config, shapes.shape[1]), key, memory, **example)
    if config.peer.network == "direct":
        params["garment"]["blendshapes"] = 0.1 * shapes
    return params


def inputs(
    poses: Pose, joints: Array, constants: Array, parents: Array, input_joints: np.ndarray, config: Config
) -> dict[str, Array]:
    """Compute a network's inputs from three poses.

    NCS has `static` [9 Jk + C] and `dynamic` [Jk, 12], SNUG `inputs` [6 Jk + 3 + C], Psi `pose` [P] and `constants`
    [C]. Jk joints are inputs.

    Args:
        poses: window of previous, current and following pose, leading axis 3.
        joints: [J, 3] m, of the shaped body.
        constants: [C] of the character.
        input_joints: indices of the joints that are inputs, the root first.
    """
    if config.peer.network == "direct":
        return {"pose": psi.window_inputs(poses, joints, parents, input_joints, config.fps), "constants": constants}
    poses = _facing(poses, int(input_joints[0]))
    if config.peer.network == "snug":
        codes = rotation.to_6d(poses.rotations[2, input_joints]).reshape(-1)
        return {"inputs": jnp.concatenate([codes, config.fps * poses.translation[2], constants])}
    static, dynamic = joint_inputs(poses, joints, parents, input_joints, config.fps)
    return {"static": jnp.concatenate([static.reshape(-1), constants]), "dynamic": dynamic}


def _facing(poses: Pose, root: int) -> Pose:
    """Turn a window of three poses about the vertical so that the last one faces ahead."""
    turn = rotation.heading(poses.rotations[2, root]).T
    turned = jnp.matmul(turn[None], poses.rotations[:, root], precision="highest")
    advance = jnp.einsum("ab,nb->na", turn, poses.translation, precision="highest")
    return Pose(jnp.asarray(poses.rotations).at[:, root].set(turned), advance)


# --- NCS ----------------------------------------------------------------------------------------------------------


def joint_inputs(
    poses: Pose, joints: Array, parents: Array, input_joints: np.ndarray, fps: float
) -> tuple[Array, Array]:
    """Compute NCS's inputs of every joint, in the joint's own frame.

    Returns:
        Static inputs [Jk, 9]: its 6D rotation and the direction down. Dynamic inputs [Jk, 12]: their rate of change,
        and its acceleration in m/s^2.
    """

    def one(rotations, translation):
        turns, positions = skinning.forward_kinematics(rotations, joints, parents)
        down = -turns[:, 1, :]  # R^T (0, -1, 0)
        codes = jnp.concatenate([rotation.to_6d(rotations), down], axis=-1)
        return codes[input_joints], positions[input_joints] + translation[None], turns[input_joints]

    codes, positions, turns = jax.vmap(one)(poses.rotations, poses.translation)
    acceleration = fps**2 * (positions[2] - 2.0 * positions[1] + positions[0])
    local = jnp.einsum("jba,jb->ja", turns[2], acceleration, precision="highest")
    return codes[2], jnp.concatenate([fps * (codes[2] - codes[1]), local], axis=-1)


class Layers(nn.Module):
    """Dense layers of these sizes with a ReLU behind each; kernels start as in NCS, with N(0, 0.05)."""

    sizes: tuple[int, ...]
    bias: bool = True

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Return [..., last size] of x [..., inputs]."""
        for index, size in enumerate(self.sizes):
            layer = nn.Dense(size, self.bias, kernel_init=nn.initializers.normal(0.05), name=str(index))
            x = nn.relu(layer(x))
        return x


class NCS(nn.Module):
    """The network of NCS (Bertiche et al. 2022): static and dynamic encoder, decoder, learned blend shapes."""

    config: Config
    vertices: int

    @nn.compact
    def __call__(self, memory: Array, static: Array, dynamic: Array) -> tuple[Array, Array]:
        """Return the canonical displacement [V, 3] m of the next frame, and the next memory.

        Args:
            memory: [W], the state of a gated recurrent unit without biases: it stays zero while nothing moves.
            static, dynamic: [9 Jk + C] and [Jk, 12], as `inputs` gives them.
        """
        settings, width = self.config.peer, self.config.peer.width
        static = Layers((*STATIC, width), name="static")(static)
        local = Layers((LOCAL, LOCAL), bias=False, name="local")(dynamic)
        moving = Layers((width, width), bias=False, name="dynamic")(local.reshape(-1))
        memory = GRU(width, bias=False, name="unit")(memory, moving)
        weights = Layers((width, width, settings.blendshapes), name="decoder")(static + memory)
        size = (settings.blendshapes, 3 * self.vertices)
        return (weights @ self.param("blendshapes", nn.initializers.glorot_normal(), size)).reshape(-1, 3), memory


# --- SNUG ---------------------------------------------------------------------------------------------------------


class Units(nn.Module):
    """Four gated recurrent units, one after the other."""

    width: int

    @nn.compact
    def __call__(self, memory: Array, x: Array) -> Array:
        """Return the next states [4 W] of all units, from their states [4 W] and the inputs [N] of the first."""
        states = []
        for index, state in enumerate(jnp.split(memory, GRUS)):
            x = GRU(self.width, name=str(index))(state, x)
            states.append(x)
        return jnp.concatenate(states)


class SNUG(nn.Module):
    """The recurrent network of SNUG (Santesteban et al. 2022)."""

    config: Config
    vertices: int

    @nn.compact
    def __call__(self, memory: Array, inputs: Array) -> tuple[Array, Array]:
        """Return the canonical displacement [V, 3] m of the next frame, and the next memory [4 W].

        Args:
            memory: [4 W], the current states of the units.
            inputs: [N], as `inputs` gives them.
        """
        width = self.config.peer.width
        memory = Units(width, name="units")(memory, inputs)
        output = nn.Dense(3 * self.vertices, kernel_init=nn.initializers.glorot_normal(), name="output")
        return output(memory[-width:]).reshape(-1, 3), memory


# --- Psi without stage 1 ------------------------------------------------------------------------------------------


class Direct(nn.Module):
    """Psi trained on the physics alone: the latent predictor and a decoder in one network (`peer.network: direct`).

    Nothing is normalised, because there is no teacher whose codes could be measured.
    """

    config: Config
    vertices: int

    def setup(self):
        self.predictor = psi.Psi(self.config.stage2)
        self.garment = decoder.Decoder(self.config.model, self.config.model.latent, self.vertices)

    def __call__(self, memory: Array, pose: Array, constants: Array) -> tuple[Array, Array]:
        """Return the canonical displacement [V, 3] m of the next frame, and the next code [L].

        Args:
            memory: [L], the current code.
            pose, constants: [P] and [C], as `inputs` gives them.
        """
        code = self.predictor(memory, pose, constants)
        return self.garment(code, jnp.ones(self.vertices)), code


# --- gated recurrent units ----------------------------------------------------------------------------------------


class GRU(nn.Module):
    """A gated recurrent unit (Cho et al. 2014) of W = `width` numbers, with or without biases.

    The reset gate multiplies the product of the state with its kernel, not the state itself.
    """

    width: int
    bias: bool = True

    @nn.compact
    def __call__(self, state: Array, x: Array) -> Array:
        """Return the next state [W] from the current one [W] and inputs [N]."""

        def product(name: str, rows: Array, kernel) -> list[jax.Array]:
            return jnp.split(nn.Dense(3 * self.width, self.bias, kernel_init=kernel, name=name)(rows), 3)

        update, reset, new = product("input", x, nn.initializers.glorot_uniform())
        update_state, reset_state, new_state = product("state", state, nn.initializers.orthogonal())
        update = nn.sigmoid(update + update_state)
        new = jnp.tanh(new + nn.sigmoid(reset + reset_state) * new_state)
        return update * state + (1.0 - update) * new
