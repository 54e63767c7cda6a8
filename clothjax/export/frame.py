"""One frame of a model as a function of plain arrays, for runtimes that import a program traced by jax."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from clothjax.runtime import inference
from clothjax.runtime.models import CAUSES, Drape, Model, PosePredictor, State
from clothjax.types import Array, Pose

HISTORY = ("latent", "rotations", "positions", "translations")  # of a state, and ...
DRAPE = ("change", "garment", "position", "velocity", "still")  # ... with forces


def _with_forces(model: Model) -> bool:
    return not isinstance(model.network.predictor, PosePredictor)


def arguments(model: Model) -> tuple[str, ...]:
    """Return the names of the arguments of `function`: the state, the pose to come and, with forces, `external`."""
    state = ("latent", *(f"previous_{name}" for name in HISTORY[1:]))
    if not _with_forces(model):
        return (*state, "rotations", "translation")
    return (*state, *(f"previous_{name}" for name in DRAPE), "rotations", "translation", "external")


def results(model: Model) -> tuple[str, ...]:
    """Return the names of the results of `function`: the next state, `ok` and the vertices."""
    names = (*HISTORY, *DRAPE) if _with_forces(model) else HISTORY
    return (*(f"next_{name}" for name in names), "ok", "vertices")


def state_arrays(state: State) -> list[np.ndarray]:
    """Return the arrays of a state in the order of `arguments`."""
    return [np.asarray(x) for x in (*state[:4], *(state.drape or ()))]


def function(model: Model) -> Callable:
    """Return one frame of a model as a function of plain arrays: from `arguments` to a tuple of `results`.

    Vertices are [V, 3] m in the world.
    """

    def frame(*given: Array) -> tuple:
        drape = Drape(*given[4:9]) if _with_forces(model) else None
        rotations, translation, *external = given[4 if drape is None else 9 :]
        latent, before, places, translations = given[:4]
        state = State(latent, before, places, translations, jnp.zeros(len(CAUSES), bool), drape)
        following, vertices = inference.step(model, state, Pose(rotations, translation), True, *external)
        return *following[:4], *(following.drape or ()), following.ok, vertices

    return frame


def shapes(model: Model) -> dict[str, tuple[int, ...]]:
    """Return the shapes of `arguments` by name; all are float32."""
    joints, code = len(model.parents), model.network.first.shape
    sizes: list[tuple[int, ...]] = [code, (2, joints, 3, 3), (2, joints, 3), (2, 3)]
    if (cloth := model.wearer.cloth) is not None:
        vertices = len(cloth.mass)
        sizes += [code, (3, vertices), (vertices, 3), (vertices, 3), ()]
    sizes += [(joints, 3, 3), (3,), (3,)]
    return dict(zip(arguments(model), sizes, strict=False))  # `external` is of forces alone


def describe(model: Model) -> dict:
    """Return what the JSON beside a file says of `function`: names, shapes, and how the state goes on."""
    about: dict[str, Any] = {
        "arguments": {name: list(shape) for name, shape in shapes(model).items()},
        "results": list(results(model)),
    }
    if _with_forces(model):
        return about | {
            "state": f"feed the first {len(HISTORY) + len(DRAPE)} results back; of the previous rotations, positions "
            "and translations, entry 0 is the newest frame",
            "external": "an acceleration of the cloth beside gravity, m/s^2; zeros for none",
            "first_state": "all zeros but previous_rotations and previous_translations, both entries of which are the "
            "first pose. Run once with that pose; its next_garment and next_position are previous_garment and "
            f"previous_position, all else stays. Run {inference.SETTLING} times, feeding the state back: the garment "
            "has settled",
        }
    return about | {
        "state": "feed the first four results back; of previous_*, entry 0 is the newest frame",
        "first_state": "latent is first_latent. Run once with the first pose, which is also both entries of "
        "previous_rotations and previous_translations; entry 0 of the positions that come back, twice, is "
        "previous_positions",
    }
