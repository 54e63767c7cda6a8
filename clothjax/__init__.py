"""Neural garments trained by physics alone: the public names."""

from clothjax.inference import Model, State, animate, initial_state, load, step
from clothjax.types import Material, Motion, Pose

__all__ = ["Material", "Model", "Motion", "Pose", "State", "animate", "initial_state", "load", "step"]
