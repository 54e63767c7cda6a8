"""Decoder, blend shapes and skinning, from a latent code to vertices (METHOD.md, Decoder). Phi and Psi share it."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from clothjax.body import skinning
from clothjax.config import ModelConfig
from clothjax.networks import mlp
from clothjax.networks.mlp import MLP, Params
from clothjax.physics import kernels
from clothjax.types import Array


class Decoder(nn.Module):
    """Network from a code [L] to the canonical displacement [V, 3] m of a garment (METHOD.md, Decoder).

    The last layer is near zero at first: a decoder of ordinary size would start the garment metres away, with 4e4 J
    instead of a skinned garment's few. The blend shapes are zero at first: training gives them a basis.
    """

    config: ModelConfig
    latent: int  # L
    vertices: int  # V

    def setup(self):
        config = self.config
        self.decoder = MLP((self.latent, *config.decoder, config.blendshapes), norm=False, last_gain=4e-4)
        self.blendshapes = self.param("blendshapes", nn.initializers.zeros, (config.blendshapes, self.vertices, 3))
        if config.decoder_skip:
            # each weight starts as one entry of the code
            self.skip = self.param("skip", lambda _, *shape: jnp.eye(*shape), self.latent, config.blendshapes)

    def __call__(self, latent: Array, free: Array) -> Array:
        """Return the canonical displacement sum_k w_k D_k [V, 3] m: blend weights w times blend shapes D.

        Args:
            latent: [L], the code.
            free: [V], 1 for a vertex that moves and 0 for a pinned one, whose displacement is zero (`phi.free`).
        """
        weights, shapes = self.blend_weights(latent), self.blendshapes.reshape(len(self.blendshapes), -1)
        if kernels.used(weights):
            flat = kernels.blended(weights, shapes)
        else:
            flat = jnp.matmul(weights, shapes, precision=jax.lax.Precision.HIGHEST)
        return flat.reshape(self.blendshapes.shape[1:]) * free[:, None]

    def blend_weights(self, latent: Array) -> Array:
        """Return the blend weights [K] of a code [L]."""
        weights = self.decoder(latent)
        if self.config.decoder_skip:
            weights = weights + latent @ self.skip
        return nn.relu(weights) if self.config.blendshape_relu else weights


def init(key: Array, latent: int, basis: Array, config: ModelConfig) -> Params:
    """Return initial parameters for codes of size L, with a basis [K, V, 3] m as blend shapes."""
    count = basis.shape[1]
    params = mlp.init(Decoder(config, latent, count), key, jnp.zeros(latent), jnp.ones(count))
    return params | {"blendshapes": jnp.asarray(basis)}


def of(params: Params, config: ModelConfig) -> Decoder:
    """Return the decoder module of given parameters; it reads the sizes L and V from their shapes."""
    return Decoder(config, params["decoder"]["dense_0"]["kernel"].shape[0], params["blendshapes"].shape[1])


def vertices(displaced: Array, template: Array, transforms: Array) -> Array:
    """Return the posed vertices [V, 3] m of a garment, by skinning.

    Args:
        displaced: [V, 3] m, the canonical displacement.
        template: [V, 3] m, the shaped garment in the canonical pose.
        transforms: [V, 3, 4] skinning transforms of its vertices.
    """
    return skinning.apply(transforms, template + displaced)
