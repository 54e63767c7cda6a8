"""Where a mesh lies: in which unit, which way up, and whether that is around the body, or is the body itself."""

from pathlib import Path
from typing import NamedTuple

import igl
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from clothjax.geometry.topology import components
from clothjax.types import Body
from data_prep.dressing import CLEARANCE, WINDING
from data_prep.mesh import edge_table
from data_prep.mesh_file import Mesh
from data_prep.program import METRES, Axis, Unit
from data_prep.rest_pose import AXES, turn_upright

Surface = tuple[np.ndarray, np.ndarray]  # the body's vertices [B, 3] m float64 and faces [F, 3] int64
TO_Y_UP = {axis: turn_upright(direction) for axis, direction in AXES.items()}
MAX_MEAN_DISTANCE = 0.25  # m, from the body, of a garment that is around it
QUARTERS = (0, 90, 180, 270)  # degrees
INSIDE_PENALTY = 10  # weight of the depth inside the body over the distance to it, in comparing units
ALIKE = 2.0  # times the least cost, up to which places fit alike
ON_BODY = 0.003  # m, from the body, of an object that is the body
COVERED = 0.9  # of the body's vertices, that are on an object which is the body
FLAT, WELDED = 1e-3, 1e-4  # of a mesh's size: from its plane, of a part that is flat; between vertices at one place
PANEL, UNBENT = 0.15, 0.99999  # of a mesh's area, of a panel among joined ones; cosine across its edges
MOSTLY = 0.5  # of a mesh's area, that is flat in a pattern before it is draped
BELOW = 0.02  # m, below the soles
AROUND = 0.5  # winding number of a garment about a joint of the body that it goes around
OUTSIDE = 0.002  # m, mean depth inside the body, of what fits it
NEARER = 0.5  # times the distance of what fits, of what fits better elsewhere
POINT_UP = ("y", "z")  # axes that point up in programs
SAMPLE = 500  # vertices that stand for all


class Placement(NamedTuple):
    """How a mesh is put around a body."""

    units: Unit = "m"
    up: Axis = "y"
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    turn: float = 0.0  # degrees about the vertical, before the shift

    def __call__(self, vertices: np.ndarray) -> np.ndarray:
        """Return the vertices [V, 3] of a file in m, +Y up."""
        turn = Rotation.from_euler("y", self.turn, degrees=True).as_matrix()
        return METRES[self.units] * vertices @ TO_Y_UP[self.up].T @ turn.T + np.array(self.shift)


def check_place(path: str | Path, mesh: Mesh, body: Body, surface: Surface, place: Placement) -> None:
    """Refuse a mesh that is not around the body in the user's units and axis, and name those in which it is.

    Args:
        path: of the mesh.
        mesh: as read.
        body: that it is worn on.
        surface: of the body.
        place: of the user.

    Raises:
        ValueError: naming the file, and the units and axis in which it would be.
    """
    vertices, height = mesh.vertices, np.ptp(surface[0][:, 1])
    sample = vertices[:: max(1, len(vertices) // SAMPLE)]
    soles = (0.0, float(surface[0][:, 1].min()), 0.0)
    places = [place]
    for units, scale in METRES.items():
        if 0.15 * height < scale * np.ptp(vertices, axis=0).max() < 1.5 * height:
            others = [up for up in TO_Y_UP if (units, up) != (place.units, place.up)]
            turns = [(place.turn + turn) % 360 for turn in QUARTERS]
            places += [place._replace(units=units, up=up, turn=turn) for up in others for turn in turns]
    if place.shift == Placement().shift:  # many programs have the soles at zero
        standing = [it for it in places if it.up in (place.up, *POINT_UP) and it(sample)[:, 1].min() > -BELOW]
        places += [it._replace(shift=soles) for it in standing]
    distance, depth = _fit(sample, surface, places)
    cost = np.where(distance < MAX_MEAN_DISTANCE, distance + INSIDE_PENALTY * depth, np.inf)
    large = 0.05 * height < METRES[place.units] * np.ptp(vertices, axis=0).max() < 1.5 * height
    fits = depth < OUTSIDE
    wide = large and fits[0] and goes_around(place(vertices), mesh.faces, body)  # such as a gown
    if wide and not (distance[fits] < NEARER * distance[0]).any():
        return
    if not large:
        cost[[it.units == place.units for it in places]] = np.inf
    if cost[0] < np.inf and cost[0] <= 2 * cost.min() + 0.01:
        return
    size = np.ptp(vertices, axis=0)
    size_text = f"{path}: {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} {place.units}, {place.up.upper()} up"
    if cost.min() < np.inf:
        meant = _likeliest(places, cost, place)
        flags = f"--units {meant.units} --up {meant.up}" + f" --turn {meant.turn:.0f}" * (meant.turn != place.turn)
        flags += _shifted(meant, place)
        raise ValueError(f"{size_text}: that is not around the body. Is it meant to be {flags}?")
    raise ValueError(
        f"{size_text}: not around the body in any unit. The body is {height:.2f} m high with its middle at "
        f"{np.round(0.5 * (surface[0].min(axis=0) + surface[0].max(axis=0)), 2)}: move the mesh onto the body in its "
        "canonical pose, as by --shift"
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
    whole = {"": np.ones(len(placed), bool)}
    for name, which in (mesh.objects | whole).items():
        own = placed[which]
        if len(own) < len(surface[0]) / 10:
            continue
        apart = np.abs(igl.signed_distance(own, *surface, sign_type=WINDING)[0])
        on_body = own[apart < ON_BODY]
        if not len(on_body) or (name and len(on_body) < 0.5 * len(own)):
            continue
        covered = cKDTree(on_body).query(surface[0])[0]  # it is all of the body, not what lies tightly on it
        if np.quantile(covered, COVERED) < 10 * ON_BODY:
            others = [other for other in mesh.objects if not (mesh.objects[other] & which).any()]
            what = f"its object {name!r} is the body itself" if name and not which.all() else "it holds the body itself"
            remedy = f"choose the garment, as with --object {others[0]}" if others else "delete it from the file"
            raise ValueError(f"{path}: {what}; there are {', '.join(mesh.objects) or 'no objects'}: {remedy}")


def check_draped(path: str | Path, mesh: Mesh, allow: bool) -> None:
    """Refuse a sewing pattern: panels that are flat, before they were sewn and draped, also if walls join them.

    Raises:
        ValueError: naming the file, and what to give in its place.
    """
    size = max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-9)
    places, welded = np.unique(np.round(mesh.vertices / (WELDED * size)), axis=0, return_inverse=True)
    faces = welded[mesh.faces]
    part, area = components(len(places), faces)[faces[:, 0]], igl.doublearea(mesh.vertices, mesh.faces)
    flat = np.isin(
        part, [number for number in np.unique(part) if _flat(mesh.vertices[mesh.faces[part == number]], size)]
    )
    panel = _smooth(mesh.vertices, mesh.faces, edge_table(faces)[1])
    flat |= (np.bincount(panel, area) > PANEL * area.sum())[panel]
    share = area[flat].sum() / max(area.sum(), 1e-30)
    several = len(np.unique(panel[flat])) > 1  # one may be a cape
    if share > MOSTLY and several and not allow:
        raise ValueError(
            f"{path}: {100 * share:.0f} % of it lies in flat parts, as a sewing pattern does before it is sewn and "
            "draped: give the draped mesh (of GarmentCode NAME_sim.obj); --allow takes it as it is"
        )


def _flat(corners: np.ndarray, size: float) -> bool:
    """Return whether more than one face, of corners [F, 3, 3], lies in a plane, of a mesh of that size."""
    points = corners.reshape(-1, 3) - corners.mean(axis=(0, 1))
    return len(corners) > 1 and np.abs(points @ np.linalg.svd(points, full_matrices=False)[2][2]).max() < FLAT * size


def _smooth(vertices: np.ndarray, faces: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return for each face [F] the number of its panel: what hangs together across edges [F, 3] without a bend."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    order = np.argsort(edges.reshape(-1), kind="stable")
    same = np.flatnonzero(np.diff(edges.reshape(-1)[order]) == 0)
    pairs = np.stack([order[same], order[same + 1]], axis=1) // 3
    return components(len(faces), pairs[np.abs((normal[pairs[:, 0]] * normal[pairs[:, 1]]).sum(axis=1)) > UNBENT])


def better_place(vertices: np.ndarray, surface: Surface, place: Placement) -> str:
    """Return a hint at a place at which a garment is less inside the body than where the user has it, or nothing.

    Args:
        vertices: [V, 3] in the file's units.
        surface: of the body.
        place: of the user.
    """
    sample = vertices[:: max(1, len(vertices) // SAMPLE)]
    middle = place(vertices).mean(axis=0)

    heights, sides = np.arange(-0.5, 0.51, 0.05), (-0.2, -0.1, -0.05, 0.0, 0.05, 0.1, 0.2)
    shifts = [(0.0, float(y), 0.0) for y in heights] + [(x, 0.0, z) for x in sides for z in sides]
    shifts.append((-float(middle[0]), 0.0, -float(middle[2])))
    places = [place._replace(shift=tuple(np.add(place.shift, shift).tolist())) for shift in shifts]
    places += [place._replace(up=up, turn=(place.turn + turn) % 360) for up in TO_Y_UP for turn in QUARTERS]
    distance, depth = _fit(sample, surface, [place, *places], CLEARANCE)
    better = (depth < 0.5 * depth[0]) & (distance < 1.5 * distance[0])
    if not better.any():
        return ""
    best = [place, *places][int(np.where(better, depth + 0.02 * distance, np.inf).argmin())]
    flags = [f"--up {best.up}"] * (best.up != place.up) + [f"--turn {best.turn:.0f}"] * (best.turn != place.turn)
    return f"It would be nearer with {' '.join(flags)}{_shifted(best, place)}; ".replace("with  ", "with ")


def _shifted(meant: Placement, place: Placement) -> str:
    """Return the flag that shifts a mesh as one place does, if another does not."""
    return " --shift " + " ".join(f"{x + 0.0:.2f}" for x in meant.shift) if meant.shift != place.shift else ""


def _likeliest(places: list[Placement], cost: np.ndarray, place: Placement) -> Placement:
    """Return, of places that cost [P] alike, the one with the user's axes, or the one that costs least."""

    def key(number: int) -> tuple[bool, float]:
        it = places[number]
        return (it.up, it.turn) != (place.up, place.turn), cost[number]

    return places[min(np.flatnonzero(cost <= ALIKE * cost.min()), key=key)]


def _fit(
    sample: np.ndarray, surface: Surface, places: list[Placement], clearance: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return distance to the body and depth below its clearance, means in m of points [S, 3] at each of P places."""
    points = np.concatenate([place(sample) for place in places])
    signed = igl.signed_distance(points, *surface, sign_type=WINDING)[0].reshape(len(places), -1)
    return np.abs(signed).mean(axis=1), np.maximum(clearance - signed, 0.0).mean(axis=1)


def goes_around(vertices: np.ndarray, faces: np.ndarray, body: Body) -> bool:
    """Return whether a mesh [V, 3] m goes around a joint of the body."""
    around = igl.fast_winding_number(vertices, faces, np.asarray(body.joints, np.float64))
    return bool(np.abs(around).max() > AROUND)


def worn(vertices: np.ndarray, faces: np.ndarray, body: Body) -> str:
    """Say where a garment [V, 3] m is worn, and whether it goes around any part of the body."""
    low, high = vertices[:, 1].min(), vertices[:, 1].max()
    soles = np.asarray(body.vertices)[:, 1].min()
    doubts = ["it goes around no part of the body"] * (not goes_around(vertices, faces, body))
    doubts += ["it reaches below the soles"] * bool(low < soles - BELOW)
    said = f"worn from {low - soles:.2f} to {high - soles:.2f} m above the soles, at {low:.2f} to {high:.2f} m"
    return f"{said}, but {' and '.join(doubts)}: is it worn elsewhere?" if doubts else said
