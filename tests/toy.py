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
    """The default experiment, shrunk, with two convolution blocks and one coarse level."""
    return shrink(
        dataclasses.replace(Config(), model=dataclasses.replace(Config().model, convolution=(Level(6), Level(6))))
    )


def assert_same(one, other) -> None:
    """Two pytrees are equal bit for bit."""
    import jax

    first, second = jax.tree.leaves(one), jax.tree.leaves(other)
    assert len(first) == len(second)
    for a, b in zip(first, second):
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
