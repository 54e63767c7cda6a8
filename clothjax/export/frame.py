"""One frame of a model as a function of plain arrays, for runtimes that import a program traced by jax."""

from collections.abc import Callable

import jax.numpy as jnp

from clothjax.runtime import inference
from clothjax.runtime.models import Model, State
from clothjax.types import Pose

ARGUMENTS = (
    "latent", "previous_rotations", "previous_positions", "previous_translations", "rotations", "translation",
)  # fmt: skip
RESULTS = ("next_latent", "next_rotations", "next_positions", "next_translations", "ok", "vertices")


def function(model: Model) -> Callable:
    """Return one frame of a model as a function of plain arrays: from `ARGUMENTS` to a tuple of `RESULTS`.

    The first four of each are the state, as in `inference.State`; vertices are [V, 3] m in the world.
    """

    def frame(latent, previous_rotations, previous_positions, previous_translations, rotations, translation):
        state = State(latent, previous_rotations, previous_positions, previous_translations, jnp.asarray(True))
        following, vertices = inference.step(model, state, Pose(rotations, translation))
        return *following, vertices

    return frame


def shapes(model: Model) -> dict[str, tuple[int, ...]]:
    """Return the shapes of `ARGUMENTS` by name; all are float32."""
    joints = len(model.parents)
    sizes = (model.network.first.shape, (2, joints, 3, 3), (2, joints, 3), (2, 3), (joints, 3, 3), (3,))
    return dict(zip(ARGUMENTS, sizes, strict=True))


def describe(model: Model) -> dict:
    """Return what the JSON beside a file says of `function`: names, shapes, and how the state goes on."""
    return {
        "arguments": {name: list(shape) for name, shape in shapes(model).items()},
        "results": list(RESULTS),
        "state": "feed the first four results back; of previous_*, entry 0 is the newest frame",
        "first_state": "latent is first_latent. Run once with the first pose, which is also both entries of "
        "previous_rotations and previous_translations; entry 0 of the positions that come back, twice, is "
        "previous_positions",
    }
