"""From a latent code to vertices (METHOD.md, Decoder): decoder, blend shapes, skinning. Shared by Phi and Psi."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from clothjax.body import skinning
from clothjax.config import ModelConfig
from clothjax.networks.mlp import Params, apply_mlp, init_mlp
from clothjax.types import Array


def init(key: Array, latent: int, basis: Array, config: ModelConfig) -> Params:
    """Parameters: a decoder whose last layer is near zero, and blend shapes [K, V, 3] m starting from `basis`.

    A decoder of ordinary size would start the garment metres away: 4e4 J instead of a skinned garment's few.
    """
    sizes = (latent, *config.decoder, basis.shape[0])
    params = {
        "decoder": init_mlp(key, sizes, norm=False, last_gain=4e-4),
        "blendshapes": jnp.asarray(basis),
    }
    if config.decoder_skip:
        # each weight starts as one entry of the code
        params["skip"] = jnp.eye(latent, basis.shape[0])
    return params


def blend_weights(params: Params, latent: Array, config: ModelConfig) -> Array:
    """Blend-shape weights [K] of a latent code [L]."""
    weights = apply_mlp(params["decoder"], latent)
    if config.decoder_skip:
        weights = weights + latent @ params["skip"]
    return nn.relu(weights) if config.blendshape_relu else weights


def displacement(params: Params, latent: Array, free: Array, config: ModelConfig) -> Array:
    """Canonical displacement sum_k w_k D_k [V, 3] m of a latent code [L]; zero where `free` [V] is zero (pins)."""
    weights = blend_weights(params, latent, config)
    shapes = params["blendshapes"]
    flat = jnp.matmul(weights, shapes.reshape(shapes.shape[0], -1), precision=jax.lax.Precision.HIGHEST)
    return flat.reshape(shapes.shape[1:]) * free[:, None]


def vertices(displaced: Array, template: Array, transforms: Array) -> Array:
    """Garment vertices [V, 3] m: the displaced template [V, 3], skinned by transforms [V, 3, 4]."""
    return skinning.apply(transforms, template + displaced)
