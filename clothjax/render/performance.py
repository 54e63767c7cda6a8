"""A character over time as moving meshes: what `gltf`, `usd` and `point_cache` write."""

from typing import NamedTuple

import numpy as np


class Part(NamedTuple):
    """One moving mesh, such as the garment or the body."""

    name: str
    vertices: np.ndarray  # [T, N, 3] m, relative to the root
    faces: np.ndarray  # [F, 3]
    colour: tuple[float, float, float]  # red, green, blue in [0, 1]


class Performance(NamedTuple):
    """A character over time; its garment is the last of the parts."""

    parts: tuple[Part, ...]
    root: np.ndarray  # [T, 3] m, place of the root in the world
    fps: float

    def placed(self, part: Part) -> np.ndarray:
        """Return the vertices [T, N, 3] m of a part in the world, float32."""
        return (np.asarray(part.vertices) + np.asarray(self.root)[:, None]).astype(np.float32)
