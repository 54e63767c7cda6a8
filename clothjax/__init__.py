"""Neural garments trained by physics alone: the public names."""

import importlib

_HOMES = {
    "animate": "runtime.inference",
    "crowd": "runtime.loading",
    "initial_state": "runtime.inference",
    "load": "runtime.loading",
    "load_motion": "files.storage",
    "Material": "types",
    "Model": "runtime.models",
    "Motion": "types",
    "Pose": "types",
    "specialise": "runtime.specialise",
    "State": "runtime.models",
    "step": "runtime.inference",
    "step_crowd": "runtime.inference",
}
__all__ = list(_HOMES)


def __getattr__(name: str):
    # imported when asked for, so that the doctor can look at an installation that lacks a package
    if name not in _HOMES:
        raise AttributeError(f"module 'clothjax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"clothjax.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
