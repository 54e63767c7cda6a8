"""Any experiment at a size that takes seconds."""

import dataclasses

import numpy as np

from clothjax.config import Config, Level


def shrink(config: Config) -> Config:
    """The same experiment, its networks and counts a few units each."""
    model = config.model
    convolution = tuple(
        dataclasses.replace(level, features=None if level.features is None else 6) for level in model.convolution
    )
    stacks = tuple(dataclasses.replace(stack, blocks=1) for stack in model.processor)
    return dataclasses.replace(
        config,
        model=dataclasses.replace(
            model,
            width=6,
            processor=stacks,
            convolution=convolution,
            convolution_bases=2,
            latent=32,
            decoder=(8,),
            blendshapes=9,
            descent_steps=2,
            descent_samples=0,
        ),
        shapes=dataclasses.replace(config.shapes, sequences=0),
        stage1=dataclasses.replace(config.stage1, steps=40, pool=3, rollout_every=1000, blendshape_rate=0.1),
        stage2=dataclasses.replace(config.stage2, steps=40, batch=4, rollout=2, hidden=(16,), sequences=2, frames=6),
        evaluation=dataclasses.replace(config.evaluation, gap_frames=1, solver_frames=12, long_frames=40),
    )


def small() -> Config:
    """The default experiment without forces, shrunk, with two convolution blocks and one coarse level."""
    default = Config()
    model = dataclasses.replace(default.model, convolution=(Level(6), Level(6)))
    return shrink(dataclasses.replace(default, model=model, stage2=dataclasses.replace(default.stage2, forces=False)))


def assert_same(one, other) -> None:
    """Two pytrees are equal bit for bit."""
    import jax

    first, second = jax.tree.leaves(one), jax.tree.leaves(other)
    assert len(first) == len(second)
    for a, b in zip(first, second):
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def untrained_psi(config: Config):
    """An untrained Psi with nine code channels on one clip, and all it is made of: the experiment, the reel, the joints
    that are inputs, the decoder with blend shapes, the predictor, and normalizers."""
    import jax
    import jax.numpy as jnp

    from clothjax.material import configured_material
    from clothjax.networks import decoder, phi, psi
    from clothjax.networks.normalisation import Normalizers, Scale
    from clothjax.simulation import assembly
    from clothjax.training import laplacian_shapes

    config = dataclasses.replace(config, motions=("walk_0",), model=dataclasses.replace(config.model, latent=9))
    experiment = assembly.assemble(config)
    reel = jax.tree.map(jnp.asarray, assembly.training_clips(experiment)[0])
    left, channels = phi.latent_size(experiment.scene, config.model)
    size = left * channels
    kept = psi.input_joints(experiment.names, config.stage2)
    count = 6 + 3 * 6 * len(kept) + 9 * (len(kept) - 1)
    constants = psi.constant_inputs(jnp.zeros(10), configured_material(config), config.material)
    shapes = 0.1 * laplacian_shapes.laplacian(experiment.scene, config)
    garment = decoder.init(jax.random.key(0), size, shapes, config.model)
    predictor = psi.init(jax.random.key(1), size, count, len(constants), config.stage2)
    rng = np.random.default_rng(0)

    def scale(size, limit):
        rows = (0.1 * rng.normal(size=size), rng.uniform(0.5, 2.0, size), np.full(size, -limit), np.full(size, limit))
        return Scale(*(jnp.asarray(row, jnp.float32) for row in rows))

    # codes of an untrained network stay near zero: some of them are out of so narrow a range
    return experiment, reel, kept, garment, predictor, Normalizers(scale(size, 0.1), scale(count, 1e6))
