"""The latent predictor of Psi (METHOD.md, Psi): the next code from the current one and what a game engine knows."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import rotation, skinning
from clothjax.config import Config, MaterialConfig, Stage2Config
from clothjax.material import material_inputs, scaled
from clothjax.networks import mlp
from clothjax.networks.forces import KINDS
from clothjax.networks.mlp import MLP, Params
from clothjax.networks.normalisation import ForceScales, Whitening, bounded
from clothjax.types import Array, Material, Pose

DIRECTED = 2 + len(KINDS)  # numbers that `ForcePsi` reads of each direction of the code: code, change and forces
DROPPED = (0.2, 0.3)  # shares that training drops of what a gated MLP reads, and of its last hidden layer
BOUND = 5.0  # of scaled inputs of `ForcePsi`, approached softly: deep contact pushes thousands of times harder


def input_joints(names: tuple[str, ...], config: Stage2Config) -> np.ndarray:
    """Return the indices [Jk] of the joints whose pose Psi reads: not those of `stage2.excluded_joints`.

    Hands, fingers and toes move no garment.

    Args:
        names: [J] of the joints.
    """
    excluded = [word.lower() for word in config.excluded_joints]
    indices = [i for i, name in enumerate(names) if not any(word in name.lower() for word in excluded)]
    return np.array(indices, np.int32)


def pose_inputs(rotations: Array, positions: Array, advance: Array, input_joints: np.ndarray, fps: float) -> Array:
    """Compute Psi's inputs from the motion, [6 + 3 * 6 * Jk + 3 * 3 * (Jk - 1)], without place or heading.

    The heading at t is removed from all three frames: the inputs show turning, but not which way a character faces.

    Args:
        rotations: [3, J, 3, 3] local, at t + 1, t, t - 1.
        positions: [3, J, 3] m of the joints in the same frames, from forward kinematics.
        advance: [2, 3] m, the root's steps t -> t + 1 and t - 1 -> t.
        input_joints: indices of the joints that are inputs, the root first.
        fps: frames a second.
    """
    root = int(input_joints[0])
    turn = rotation.heading(rotations[1, root]).T
    velocity = jnp.einsum("ab,nb->na", turn, advance, precision="highest") * fps
    first = jnp.matmul(turn[None], rotations[:, root], precision="highest")
    codes = rotation.to_6d(jnp.concatenate([first[:, None], rotations[:, input_joints[1:]]], axis=1))
    relative = jnp.einsum(
        "ab,tjb->tja", turn, positions[:, input_joints[1:]] - positions[:, None, root], precision="highest"
    )
    return jnp.concatenate([velocity.reshape(-1), codes.reshape(-1), relative.reshape(-1)])


def window_inputs(poses: Pose, joints: Array, parents: Array, input_joints: np.ndarray, fps: float) -> Array:
    """Compute `pose_inputs` of a window of poses, as `motion_clips.poses` gives it.

    Args:
        poses: previous, current and following, leading axis 3.
        joints: [J, 3] m, of the shaped body in the canonical pose.
        parents: [J], of the joints.
        input_joints: [Jk] indices of the joints that are inputs, the root first.
    """
    advance = jnp.stack([poses.translation[2], -poses.translation[0]])
    rotations = poses.rotations[::-1]
    _, positions = jax.vmap(lambda local: skinning.forward_kinematics(local, joints, parents))(rotations)
    return pose_inputs(rotations, positions, advance, input_joints, fps)


def constant_inputs(betas: Array, material: Material, config: MaterialConfig) -> Array:
    """Return the inputs that are constant over a rollout: betas [S] and the material scaled to [0, 1] [4].

    If all garments are of one material, it is not an input.
    """
    if not config.sample:
        return betas
    density = scaled(material.density, config.density_range)
    return jnp.concatenate([betas, density[None], material_inputs(material, config)])


def bounded_constants(constants: Array, config: Config) -> tuple[Array, Array]:
    """Clip the constants [C] of `constant_inputs` to the range of training; also return whether they were inside it."""
    materials = jnp.ones(len(Material._fields) if config.material.sample else 0)
    betas = jnp.full(len(constants) - len(materials), config.stage1.betas)
    return bounded(constants, jnp.concatenate([-betas, 0 * materials]), jnp.concatenate([betas, materials]))


class Psi(nn.Module):
    """The latent predictor, an MLP. Its last layer starts small, so that at first the code only decays."""

    config: Stage2Config

    @nn.compact
    def __call__(self, latent: Array, pose: Array, constants: Array) -> Array:
        """Return the next code [L] from the current one [L], pose inputs [P] and constants [C].

        Codes and pose inputs are in standard deviations. A part `latent_decay` of the code decays unless the network
        restores it, so that no direction of the code drifts.
        """
        inputs = jnp.concatenate([latent, pose, constants])
        layers = MLP((len(inputs), *self.config.hidden, len(latent)), norm=False, last_gain=0.01)
        nn.share_scope(self, layers)  # they are Psi's own, as in older models
        return (1.0 - self.config.latent_decay) * latent + layers(inputs)


def init(key: Array, latent: int, pose: int, constants: int, config: Stage2Config) -> Params:
    """Return initial parameters of the latent predictor.

    Args:
        latent, pose, constants: sizes L, P and C of its inputs.
    """
    return mlp.init(Psi(config), key, jnp.zeros(latent), jnp.zeros(pose), jnp.zeros(constants))


def force_inputs(code: Array, change: Array, forces: Array, constants: Array, whitening: Whitening) -> Array:
    """Return the inputs [(2 + kinds) L + C] of `ForcePsi`, not yet scaled.

    Args:
        code: [L], held.
        change: [L], of the code in the last frame.
        forces: [kinds, L] in J, of `forces.reduced` at the held code.
        constants: [C], of `constant_inputs`.
    """
    pulls = jnp.matmul(forces, whitening.back, precision="highest").reshape(-1)
    return jnp.concatenate([code, jnp.matmul(change, whitening.to, precision="highest"), pulls, constants])


def scaled_inputs(scales: ForceScales, inputs: Array) -> Array:
    """Return inputs [N] of `force_inputs`, or the last n of them, scaled and softly bounded to +-`BOUND`."""
    middle, spread = (row[-len(inputs) :] for row in (scales.middle, scales.spread))
    return BOUND * jnp.tanh((inputs - middle) / (BOUND * spread))


class ForcePsi(nn.Module):
    """The latent predictor of a Psi with forces: a linear map, which starts as that of all labels, beside an MLP.

    What a force does depends on the frame: where cloth touches, how it is bent, how stiff it is. If `gated`, the MLP
    gives gates: how much more each direction's own code, change and forces count, by which they are multiplied.

    Else the MLP gives a change, and the character scales inputs and layers: feature-wise modulation (FiLM, Perez et al.
    2018). The network of one character, which `of_character` returns, has no scales.

    With a key for `dropout`, a gated network drops a share of what the MLP reads, and of its last hidden layer
    (Srivastava et al. 2014).
    """

    config: Stage2Config
    latent: int  # L
    constants: int = 0  # C last inputs that scale; 0 in the network of one character

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        """Return the change [..., L] of the whitened code, over `ForceScales.output`, from `scaled_inputs` [..., N]."""
        linear = mlp.Dense(inputs.shape[-1], self.latent, name="linear")
        outputs = self.latent * (DIRECTED if self.config.gated else 1)
        layers = MLP((inputs.shape[-1], *self.config.hidden, outputs), False, 1e-3, name="mlp")
        if self.config.gated:
            x, (*hidden, last) = self._dropped(inputs, DROPPED[0]), layers.dense
            for layer in hidden:
                x = nn.relu(layer(x))
            gates = last(self._dropped(x, DROPPED[1]))
            products = gates * inputs[..., : gates.shape[-1]]
            return linear(inputs) + jnp.sum(products.reshape(*products.shape[:-1], DIRECTED, self.latent), axis=-2)
        if self.constants == 0:
            return linear(inputs) + layers(inputs)
        felt, constants = inputs[..., : -self.constants], inputs[..., -self.constants :]
        sizes = {"inputs": felt.shape[-1], "linear": self.latent} | {
            f"dense_{i}": size for i, size in enumerate(self.config.hidden)
        }
        zeros = {name: jnp.zeros((self.constants, size)) for name, size in sizes.items()}
        scales = {name: 1.0 + constants @ kernel for name, kernel in self.param("character", lambda _: zeros).items()}
        seen = jnp.concatenate([felt * scales["inputs"], constants], axis=-1)
        x, (*hidden, last) = seen, layers.dense
        for number, layer in enumerate(hidden):
            x = nn.relu(layer.biased(layer.product(x) * scales[f"dense_{number}"]))
        return linear.biased(linear.product(seen) * scales["linear"]) + last(x)

    @nn.nowrap
    def _dropped(self, x: Array, share: float) -> Array:
        return nn.Dropout(share, deterministic=not self.has_rng("dropout"))(x)


def of_character(params: Params, constants: Array) -> Params:
    """Return the parameters of `ForcePsi` for one character: its scales are in the kernels.

    Args:
        params: of all characters, or of one, which are returned as they are.
        constants: [C], the last of `scaled_inputs`.
    """
    if "character" not in params:
        return params
    scales = {name: 1.0 + constants @ kernel for name, kernel in params["character"].items()}
    rows = jnp.concatenate([scales["inputs"], jnp.ones(len(constants))])[:, None]

    def scaled(name: str, layer: dict) -> dict:
        return layer | {"kernel": layer["kernel"] * scales[name][None] if name in scales else layer["kernel"]}

    layers = {name: scaled(name, layer) for name, layer in params["mlp"].items()}
    layers["dense_0"] |= {"kernel": rows * layers["dense_0"]["kernel"]}
    linear = scaled("linear", params["linear"])
    return {"mlp": layers, "linear": linear | {"kernel": rows * linear["kernel"]}}


def next_code(
    params: Params,
    scales: ForceScales,
    code: Array,
    change: Array,
    forces: Array,
    constants: Array,
    config: Stage2Config,
    share: Array | float = 1.0,
) -> Array:
    """Return the next code [L] of a Psi with forces, not yet clipped to its range; arguments as of `force_inputs`.

    Args:
        params: of all characters, or `of_character`.
        share: of the code's change, which is taken.
    """
    inputs = scaled_inputs(scales, force_inputs(code, change, forces, constants, scales.whitening))
    network = ForcePsi(config, len(code), len(constants) if "character" in params else 0)
    moved = scales.output * mlp.apply(network, params, inputs)
    return code + share * jnp.matmul(moved, scales.whitening.back, precision="highest")
