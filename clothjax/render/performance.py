"""A character over time: as moving meshes, which `gltf`, `usd` and `point_cache` write, or as meshes on a skeleton."""

from typing import NamedTuple

import numpy as np

from clothjax.types import Motion


class Part(NamedTuple):
    """One moving mesh, such as the garment or the body."""

    name: str
    vertices: np.ndarray  # [T, N, 3] m, relative to the root
    faces: np.ndarray  # [F, 3]
    colour: tuple[float, float, float]  # red, green, blue in [0, 1]
    checked: np.ndarray | None = None  # [N, 3] m, places of the vertices in the cloth at rest: pictures draw a check


class Performance(NamedTuple):
    """A character over time; its garment is the last of the parts."""

    parts: tuple[Part, ...]
    root: np.ndarray  # [T, 3] m, place of the root in the world
    fps: float

    def placed(self, part: Part) -> np.ndarray:
        """Return the vertices [T, N, 3] m of a part in the world, float32."""
        return (np.asarray(part.vertices) + np.asarray(self.root)[:, None]).astype(np.float32)


class SkinnedPart(NamedTuple):
    """One mesh on a skeleton, before skinning."""

    name: str
    vertices: np.ndarray  # [T, N, 3] m in the canonical pose, or [1, N, 3] if only skinning moves it
    faces: np.ndarray  # [F, 3]
    weights: np.ndarray  # [N, J] skinning weights, rows sum to 1
    colour: tuple[float, float, float]  # red, green, blue in [0, 1]


class SkinnedPerformance(NamedTuple):
    """A character as meshes on a skeleton; its garment is the last of the parts."""

    parts: tuple[SkinnedPart, ...]
    names: tuple[str, ...]  # [J] of the joints
    parents: np.ndarray  # [J] integers, root -1
    joints: np.ndarray  # [J, 3] m in the canonical pose
    bones: dict[str, str]  # of VRM's humanoid, by the names of joints
    motion: Motion | None  # of T frames; None: the canonical pose alone
