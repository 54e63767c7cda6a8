"""The JSON beside an exported model, from which an engine programmer learns to drive it."""

import json
from pathlib import Path
from typing import Literal

import numpy as np

from clothjax.runtime.inference import SETTLING
from clothjax.runtime.models import Model

Output = Literal["world", "canonical", "none"]
VERTICES = {
    "world": "in the world, m",
    "canonical": "in the canonical pose, m, as are joint_positions: skin them with skin_weights [V, skin_joints]",
    "none": "none: the state goes on unseen",
}
STATE = {
    "state": "feed next_latent and next_history back",
    "first_state": "latent is first_latent. Run once with the first pose and any finite history; the first row of "
    "next_history, twice, is the history of a character that has been standing in that pose",
}
STATE_WITH_FORCES = {
    "state": "feed what is called next_NAME back as NAME",
    "external": "an acceleration of the cloth beside gravity, m/s^2, such as wind; zeros for none",
    "first_state": f"{STATE['first_state']}; all else of the state is zeros in that run. Then garment and position are "
    "its next_garment and next_position; change, velocity, still and external are zeros. Run `settling` times with "
    "that pose, feeding the state back: the garment settles",
    "settling": SETTLING,
}


def beside(path: Path) -> Path:
    """Return the JSON's path: skirt.json of skirt.onnx, else such as skirt.psi.json, so that no two share it."""
    return path.with_suffix(".json") if path.suffix == ".onnx" else path.with_name(f"{path.name}.json")


def write(model: Model, path: Path, output: Output, about: dict) -> None:
    """Write the JSON beside the file of an exported model.

    Args:
        output: what vertices the file computes.
        about: more entries, which go before those of the same name.
    """
    entries = {
        "garment": model.config.garment,
        "units": "m",
        "up": "+Y",
        "fps": model.config.fps,
        "joints": list(model.names),
        "parents": list(model.parents),
        "rotations": "3 x 3 matrices, row-major, local to the parent joint; the identity is the body's canonical pose",
        "translation": "of the root joint from its canonical place, m",
        "normalisation": "inside the model: give poses as they are",
        "ok": "false where the wearer, the code or, without forces, the pose was outside of what training has seen",
        "vertices": VERTICES[output],
        "first_latent": np.asarray(model.network.first).tolist(),
        "faces": np.asarray(model.faces).tolist(),
    } | about
    if output == "canonical":
        entries["skin_joints"] = list(model.moving)
        entries["skin_weights"] = np.round(np.asarray(model.network.weights).T, 5).tolist()
        entries["joint_positions"] = np.asarray(model.wearer.joints).tolist()
    beside(path).write_text(json.dumps(entries))
