"""Neural garments trained by physics alone: the public names."""

import importlib

_HOMES = {
    "animate": "inference",
    "crowd": "inference",
    "initial_state": "inference",
    "load": "inference",
    "Material": "types",
    "Model": "inference",
    "Motion": "types",
    "Pose": "types",
    "specialise": "folding",
    "State": "inference",
    "step": "inference",
    "step_crowd": "inference",
}
__all__ = list(_HOMES)


def __getattr__(name: str):
    # imported when asked for, so that the doctor can look at an installation that lacks a package
    if name not in _HOMES:
        raise AttributeError(f"module 'clothjax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"clothjax.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
