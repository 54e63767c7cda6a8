"""Neural garments trained by physics alone: the public names."""

from clothjax.folding import specialise
from clothjax.inference import Model, State, animate, crowd, initial_state, load, step, step_crowd
from clothjax.types import Material, Motion, Pose

__all__ = [
    "Material", "Model", "Motion", "Pose", "State",
    "animate", "crowd", "initial_state", "load", "specialise", "step", "step_crowd",
]  # fmt: skip
