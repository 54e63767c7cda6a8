"""Garments built on a body, from templates.

A template is an implicit solid around the body that is meshed, cut by planes, remeshed and pushed out of the body. The
solid is an offset of the body's distance field, closed over armpits and crotch. Hanging parts are the convex hulls of
the body's slices.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import igl
import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import ConvexHull

from clothjax.geometry.topology import boundary_loops, boundary_mask, components
from clothjax.types import Body, Garment
from data_prep.dressing import WINDING, clear_vertices, dress, highest_opening, limbs, push_out
from data_prep.mesh import clip, component, zero_set
from data_prep.remesh import flip, relax, resample
from data_prep.skeleton import landmarks

OFFSET = 0.012  # m, from the body to the solid
CELL = 0.008  # m, spacing of the distance field's grid


@dataclass(frozen=True)
class Template:
    """A kind of garment. A height is the name of a level (see `Landmarks.level`) and the metres above it."""

    hem: tuple[str, float]
    loops: int  # openings
    closing: float = 0.05  # m, radius of the hollows that are bridged
    blur: float = 1.2  # grid cells
    hull: tuple[str, float, float] | None = None  # of the hanging part: level, m above it, flare in m per m
    only_hull: bool = False
    sleeve: float | None = None  # share of the upper arm that it covers; above 1, 1 + share of the forearm
    neck: float | None = None  # m the neckline is lowered
    scoop: float | None = None  # m, depth of a neckline with bare shoulders
    waist: bool = False  # ends at the waist and is pinned there
    samples: int = 0  # of the diffusion; 0 for tight garments


TEMPLATES = {
    "tshirt": Template(("crotch", -0.01), 4, hull=("chest", 0.0, 0.03), sleeve=0.55, neck=0.015),
    "long_sleeve": Template(("crotch", -0.01), 4, hull=("chest", 0.0, 0.03), sleeve=1.8, neck=0.015),
    "tank": Template(("crotch", 0.02), 4, closing=0.03, scoop=0.10),
    "pants": Template(("ankle", 0.06), 3, closing=0.02, blur=1.0, waist=True),
    "skirt": Template(
        ("thigh", -0.05),
        2,
        closing=0,
        blur=2.0,
        hull=("waist", 0.06, 0.18),
        only_hull=True,
        waist=True,
        samples=500,
    ),
    "dress": Template(("knee", 0.05), 4, blur=1.5, hull=("waist", 0.0, 0.22), sleeve=0.35, neck=0.02, samples=500),
}


class Landmarks(NamedTuple):
    """The body's surface and the places on it that templates refer to."""

    vertices: np.ndarray  # [B, 3] m, float64
    faces: np.ndarray  # [F, 3] int64
    arms: np.ndarray  # [B] bool, on an arm
    joint: dict[str, np.ndarray]  # position [3] m by CMU name
    level: dict[str, float]  # height in m: chest, waist, crotch, thigh, knee, ankle


class Grid(NamedTuple):
    """A regular grid of cubic cells."""

    origin: np.ndarray  # [3] m
    shape: tuple[int, int, int]

    def axis(self, k: int) -> np.ndarray:
        """Return the coordinates along one axis, m."""
        return self.origin[k] + CELL * np.arange(self.shape[k])


def build(template: str, vertices: int, body: Body, names: tuple[str, ...], seed: int = 0) -> Garment:
    """Build the garment of a template on a body.

    Args:
        template: one of TEMPLATES.
        vertices: wanted; the garment has as many within 3 %.
        body: watertight, in an A- or T-pose.
        names: of its joints, of a scheme that `skeleton` knows.
        seed: of the diffusion's samples.

    Raises:
        ValueError: for an unknown template, joints that are missing, or a body on which the template fails.
    """
    if template not in TEMPLATES:
        raise ValueError(f"there is no template {template!r}: choose one of {', '.join(TEMPLATES)}")
    kind, marks = TEMPLATES[template], _landmarks(body, names)
    solid, triangles = _solid(kind, marks)
    for distance in _cuts(kind, marks):
        solid, triangles = clip(solid, triangles, distance(solid))
    solid, triangles = component(solid, triangles)
    nearest = igl.signed_distance(solid, marks.vertices, marks.faces, sign_type=WINDING)[2]
    if ((solid - nearest) * igl.per_vertex_normals(solid, triangles)).sum() < 0:
        triangles = triangles[:, ::-1]

    shape, faces, _ = resample(solid, triangles, vertices)
    shape, faces = _fit(shape, faces, marks.vertices, marks.faces)
    if len(boundary_loops(faces)) != kind.loops or components(len(shape), faces).max() > 0:
        raise ValueError(
            f"template {template!r} came out with {len(boundary_loops(faces))} openings, not {kind.loops}, "
            "on this body: try another pose, or bring a mesh (--mesh)"
        )
    long = kind.sleeve is not None and kind.sleeve > 1
    hidden = limbs(body, names, "Arm" if kind.waist else "Hand" if long else "ForeArm")
    pinned = highest_opening(shape, faces) if kind.waist else np.zeros(len(shape), bool)
    return dress(shape, faces, body, hidden, pinned, kind.samples, seed)


def _fit(
    vertices: np.ndarray, faces: np.ndarray, body: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Smooth a garment and push it out of the body."""
    for _ in range(4):
        faces, _ = flip(vertices, faces)
        border = boundary_mask(faces, len(vertices))[:, None]
        vertices = np.where(border, vertices, 0.6 * vertices + 0.4 * relax(vertices, faces, 1))
        vertices = clear_vertices(vertices, body, triangles, 6)
    return push_out(vertices, faces, body, triangles), faces


def _landmarks(body: Body, names: tuple[str, ...]) -> Landmarks:
    """Find the landmarks of a body by the names of its joints."""
    places = np.asarray(body.joints, np.float64)
    joint = {name: places[number] for name, number in landmarks(names, body.parents).items()}
    needed = {"Neck", "Hips", "LowerBack"} | {
        side + bone for side in ("Left", "Right") for bone in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
    }
    if needed - set(joint):
        raise ValueError(f"the body lacks the joints {sorted(needed - set(joint))}: name them as Mixamo or SMPL do")
    vertices = np.asarray(body.vertices, np.float64)
    tall = np.ptp(vertices[:, 1])
    height = {name: place[1] for name, place in joint.items()}
    level = {
        "chest": height["Neck"] - 0.13 * tall,
        "waist": height["Hips"] + 0.06 * tall,
        "crotch": height["LeftUpLeg"] - 0.03 * tall,
        "thigh": (height["LeftUpLeg"] + height["LeftLeg"]) / 2,
        "knee": height["LeftLeg"],
        "ankle": height["LeftFoot"],
    }
    return Landmarks(vertices, np.asarray(body.faces, np.int64), limbs(body, names, "Arm"), joint, level)


def _solid(kind: Template, marks: Landmarks) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the closed surface of the implicit garment, before it is cut."""
    hem = marks.level[kind.hem[0]] + kind.hem[1]
    top = marks.level["waist"] + 0.02 if kind.waist else marks.joint["Neck"][1] + 0.12
    end = "Hand" if kind.sleeve is not None and kind.sleeve > 1 else "ForeArm"
    reach = max(abs(marks.joint[f"{side}{end}"][0]) for side in ("Left", "Right")) + 0.05
    width = max(0.45 if kind.hull else 0.4, 0 if kind.waist else reach)
    deep = 0.27 if kind.hull else 0.12
    low = np.array([-width, hem - 0.05, marks.vertices[:, 2].min() - deep])
    high = np.array([width, top + 0.05, marks.vertices[:, 2].max() + deep])
    grid = Grid(low, tuple(int(n) + 1 for n in np.ceil((high - low) / CELL)))
    points = np.stack(np.meshgrid(*(grid.axis(k) for k in range(3)), indexing="ij"), axis=-1)
    if kind.only_hull:
        field = _hanging(kind, marks, grid, hem)
    else:
        flat = points.reshape(-1, 3)
        field = igl.signed_distance(flat, marks.vertices, marks.faces, sign_type=WINDING)[0]
        field = _closed(field.reshape(grid.shape) - OFFSET, kind.closing)
        if kind.hull:
            field = np.minimum(field, _hanging(kind, marks, grid, hem))
    field = gaussian_filter(np.clip(field, -0.05, 0.05), kind.blur)
    return component(*zero_set(points, field), marks.joint["Hips" if kind.waist else "LowerBack"])


def _closed(field: np.ndarray, radius: float) -> np.ndarray:
    """Grow the solid `field` < 0 by a radius and shrink it again, which bridges armpits, cleavage and crotch."""
    if radius == 0:
        return field
    inward = distance_transform_edt(field <= radius) * CELL
    outward = distance_transform_edt(field > radius) * CELL
    grown = np.where(field <= radius, -(inward - CELL / 2), outward - CELL / 2)
    return np.minimum(field, grown + radius)


def _hanging(kind: Template, marks: Landmarks, grid: Grid, hem: float) -> np.ndarray:
    """Return the distance field of the hanging part: each slice is the hull of the body down to it, with a flare."""
    place, above, flare = kind.hull
    top = marks.level[place] + above
    trunk = marks.vertices[~marks.arms]
    x, z = np.meshgrid(grid.axis(0), grid.axis(2), indexing="ij")
    field, outline = np.full(grid.shape, 1.0), np.zeros((0, 2))
    for i, y in reversed(list(enumerate(grid.axis(1)))):
        if not hem - 0.03 - 3 * CELL <= y <= top:
            continue
        outline = np.concatenate([outline, trunk[np.abs(trunk[:, 1] - y) < 1.5 * CELL][:, [0, 2]]])
        if len(outline) < 3:
            continue
        hull = ConvexHull(outline)
        outline = outline[hull.vertices]
        distance = np.max([a * x + b * z + c for a, b, c in hull.equations], axis=0)
        field[:, i] = distance - OFFSET - flare * (top - y)
    return field


def _cuts(kind: Template, marks: Landmarks) -> list[Callable[[np.ndarray], np.ndarray]]:
    """Return functions of points [V, 3] that are > 0 where the solid is cut away."""
    hem, waist = marks.level[kind.hem[0]] + kind.hem[1], marks.level["waist"]
    neck, joint = marks.joint["Neck"], marks.joint
    broad = abs(joint["LeftArm"][0] - joint["RightArm"][0])
    cuts = [lambda x: hem - x[:, 1]]
    if kind.waist:
        cuts.append(lambda x: x[:, 1] - waist)
    if kind.sleeve is not None:
        for side in ("Left", "Right"):
            upper, fore, hand = (joint[side + bone] for bone in ("Arm", "ForeArm", "Hand"))
            start, along = (upper, fore - upper) if kind.sleeve <= 1 else (fore, hand - fore)
            share = kind.sleeve if kind.sleeve <= 1 else kind.sleeve - 1
            cuts.append(_beyond_plane(start + share * along, along / np.linalg.norm(along), within=0.16))
    if kind.neck is not None:
        base, up = neck + np.array([0, 0.02 - kind.neck, 0]), np.array([0, 1, 0.35]) / np.hypot(1, 0.35)
        radius = 0.42 * broad
        cuts.append(lambda x: np.minimum((x - base) @ up, radius - np.hypot(x[:, 0] - base[0], x[:, 2] - base[2])))
    if kind.scoop is not None:
        for side, sign in (("Left", 1), ("Right", -1)):
            edge = joint[f"{side}Arm"] - [sign * 0.02, 0, 0]
            cuts.append(_beyond_plane(edge, np.array([sign, 0.0, 0.0]), within=0.25))
        middle, wide = neck + np.array([0, 0.01, 0]), 0.34 * broad
        cuts.append(
            lambda x: (
                0.05 - 0.05 * ((x[:, 0] - middle[0]) / wide) ** 2 - 0.05 * ((x[:, 1] - middle[1]) / kind.scoop) ** 2
            )
        )
    return cuts


def _beyond_plane(point: np.ndarray, normal: np.ndarray, within: float = np.inf) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of points [V, 3]: their distance beyond a plane, -1 farther than `within` from `point`."""
    return lambda x: np.where(np.linalg.norm(x - point, axis=1) < within, (x - point) @ normal, -1.0)
