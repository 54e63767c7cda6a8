"""Where a mesh lies: in which unit, which way up, and whether that is around the body, or is the body itself."""

from pathlib import Path
from typing import Literal, NamedTuple

import igl
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from data_prep.dressing import CLEARANCE, WINDING
from data_prep.mesh_file import Mesh
from data_prep.program import METRES, Unit

Up = Literal["y", "z"]
Surface = tuple[np.ndarray, np.ndarray]  # the body's vertices [B, 3] m float64 and faces [F, 3] int64
TO_Y_UP = {"y": np.eye(3), "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}
MAX_MEAN_DISTANCE = 0.25  # m, from the body, of a garment that is around it
INSIDE_PENALTY = 10  # weight of the depth inside the body over the distance to it, in comparing units
ON_BODY = 0.003  # m, from the body, of an object that is the body
SAMPLE = 500  # vertices that stand for all


class Placement(NamedTuple):
    """How a mesh is put around a body."""

    units: Unit = "m"
    up: Up = "y"
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    turn: float = 0.0  # degrees about the vertical, before the shift

    def __call__(self, vertices: np.ndarray) -> np.ndarray:
        """Return the vertices [V, 3] of a file in m, +Y up."""
        turn = Rotation.from_euler("y", self.turn, degrees=True).as_matrix()
        return METRES[self.units] * vertices @ TO_Y_UP[self.up].T @ turn.T + np.array(self.shift)


def check_place(path: str | Path, vertices: np.ndarray, surface: Surface, place: Placement) -> None:
    """Refuse a mesh that is not around the body in the user's units and axis, and name those in which it is.

    Raises:
        ValueError: naming the file, and the units and axis in which it would be.
    """
    height = np.ptp(surface[0][:, 1])

    def distances(units: str, up: str) -> tuple[float, float]:
        """Return the mean distance to the body [m], without and with a penalty for the inside.

        Both are infinite for a mesh far larger or smaller than the body.
        """
        points = place._replace(units=units, up=up)(vertices)
        smallest = 0.05 if (units, up) == (place.units, place.up) else 0.15
        if not smallest * height < np.ptp(points, axis=0).max() < 1.5 * height:
            return np.inf, np.inf
        sample = points[:: max(1, len(points) // SAMPLE)]
        signed = igl.signed_distance(sample, *surface, sign_type=WINDING)[0]
        distance = np.mean(np.abs(signed))
        return float(distance), float(distance + INSIDE_PENALTY * np.mean(np.maximum(-signed, 0.0)))

    by_placement = {(units, up): distances(units, up) for units in METRES for up in TO_Y_UP}
    near = {key: penalised for key, (distance, penalised) in by_placement.items() if distance < MAX_MEAN_DISTANCE}
    answered = near.get((place.units, place.up), np.inf)
    if answered < np.inf and answered <= 2 * min(near.values()) + 0.01:
        return
    size = np.ptp(vertices, axis=0)
    size_text = f"{path}: {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} {place.units}, {place.up.upper()} up"
    if near:
        units, up = min(near, key=near.get)
        raise ValueError(f"{size_text}: that is not around the body. Is it meant to be --units {units} --up {up}?")
    raise ValueError(
        f"{size_text}: not around the body in any unit. The body is {height:.2f} m high with its middle at "
        f"{np.round(0.5 * (surface[0].min(axis=0) + surface[0].max(axis=0)), 2)}: move the mesh onto the body in its "
        "canonical pose"
    )


def check_objects(path: str | Path, mesh: Mesh, placed: np.ndarray, surface: Surface) -> None:
    """Refuse a file one of whose objects is the body itself.

    Args:
        path: of the file.
        mesh: as read.
        placed: [V, 3] m, its vertices around the body.
        surface: of the body.

    Raises:
        ValueError: naming that object and the others.
    """
    for name, which in mesh.objects.items():
        if which.all() or which.sum() < len(surface[0]) / 10:
            continue
        own = placed[which]
        apart = np.abs(igl.signed_distance(own[:: max(1, len(own) // SAMPLE)], *surface, sign_type=WINDING)[0])
        covered = cKDTree(own).query(surface[0])[0]  # it is all of the body, not what lies tightly on it
        if np.median(apart) < ON_BODY and np.quantile(covered, 0.9) < 10 * ON_BODY:
            others = [other for other in mesh.objects if not (mesh.objects[other] & which).any()]
            raise ValueError(
                f"{path}: its object {name!r} is the body itself; there are {', '.join(mesh.objects)}: choose the "
                f"garment, as with --object {others[0] if others else 'NAME'}"
            )


def better_place(points: np.ndarray, surface: Surface) -> str:
    """Return a hint at a place of a garment [V, 3] m at which it is pushed less, if there is one."""
    sample = points[:: max(1, len(points) // SAMPLE)]
    middle = points.mean(axis=0)

    def inside(turn: float, shift: tuple[float, float, float]) -> float:
        signed = igl.signed_distance(Placement(turn=turn, shift=shift)(sample), *surface, sign_type=WINDING)[0]
        return float(np.mean(np.maximum(CLEARANCE - signed, 0.0)) + 0.02 * np.mean(np.abs(signed)))

    heights, sides = np.arange(-0.4, 0.41, 0.05), (-0.2, -0.1, 0.0, 0.1, 0.2)
    places = [(0.0, (0.0, float(y), 0.0)) for y in heights]
    places += [(0.0, (x, 0.0, z)) for x in sides for z in sides]
    places += [(turn, (0.0, 0.0, 0.0)) for turn in (90.0, 180.0, 270.0)]
    centred = (-float(middle[0]), 0.0, -float(middle[2]))
    best = min([*places, (0.0, centred)], key=lambda place: inside(*place))
    if inside(*best) > 0.5 * inside(0.0, (0.0, 0.0, 0.0)):
        return "Move the mesh onto the body, or name its body with --body; "
    turn, shift = best
    flag = f"--turn {turn:.0f}" if turn else "--shift " + " ".join(f"{x:.2f}" for x in shift)
    return f"It would be nearer with {flag}; "
