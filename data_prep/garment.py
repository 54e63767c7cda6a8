"""Garments built on a body, or brought as a mesh, with the body's skinning and shape diffused onto them.

    python -m data_prep.garment --template tshirt --vertices 1000 --body body.h5 out.h5
    python -m data_prep.garment --mesh shirt.obj --units cm --pin highest --body body.h5 out.h5

A mesh is checked and put right as `data_prep/user_mesh.py` says; what was done is printed, and drawn beside the file.
A template is an implicit solid around the body that is meshed, cut by planes, remeshed and pushed out of the
body: an offset of the body's distance field, closed over armpits and crotch, and for what hangs the convex
hulls of the body's slices.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import igl
import numpy as np
import tyro
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import ConvexHull

from clothjax.config import HANDS
from clothjax.files.storage import load_rig, save_garment
from clothjax.geometry.topology import boundary_loops, boundary_mask, components
from clothjax.types import Body, Garment
from data_prep.dressing import ARM, FOREARM, WINDING, clear_vertices, dress, highest_opening, limbs, push_out
from data_prep.mesh import clip, component
from data_prep.program import run
from data_prep.remesh import flip, relax, resample
from data_prep.retarget import cmu_names
from data_prep.user_mesh import MAX_VERTICES, MIN_VERTICES, Answers, Unit, Up, bring, draw

OFFSET = 0.012  # m, of the solid from the body
CELL = 0.008  # m, of the distance field's grid


@dataclass(frozen=True)
class Template:
    """A kind of garment. Heights are named places on the body (see `_landmarks`) and metres above them."""

    hem: tuple[str, float]
    loops: int  # openings
    closing: float = 0.05  # m, radius of the hollows that are bridged
    blur: float = 1.2  # grid cells
    hull: tuple[str, float, float] | None = None  # what hangs: from where, how far above, flare in m per m
    only_hull: bool = False
    sleeve: float | None = None  # share of the upper arm; from 1 on, of the forearm too
    neck: float | None = None  # m the neckline is lowered
    scoop: float | None = None  # m, depth of a neckline with bare shoulders
    waist: bool = False  # ends at the waist and is pinned there
    samples: int = 0  # for the diffusion: 0 for tight garments


TEMPLATES = {
    "tshirt": Template(("crotch", -0.01), 4, hull=("chest", 0.0, 0.03), sleeve=0.55, neck=0.015),
    "longsleeve": Template(("crotch", -0.01), 4, hull=("chest", 0.0, 0.03), sleeve=1.8, neck=0.015),
    "tank": Template(("crotch", 0.02), 4, scoop=0.10),
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


class Wearer(NamedTuple):
    """What a template needs of a body."""

    vertices: np.ndarray  # [B, 3] m, float64
    faces: np.ndarray  # [F, 3] int64
    arms: np.ndarray  # [B] bool, whether of the arms
    joint: dict[str, np.ndarray]  # CMU's name: place [3]
    level: dict[str, float]  # name: height in m


class Grid(NamedTuple):
    """A regular grid of cubic cells."""

    origin: np.ndarray  # [3] m
    shape: tuple[int, int, int]

    def axis(self, k: int) -> np.ndarray:
        """Coordinates along one axis."""
        return self.origin[k] + CELL * np.arange(self.shape[k])


def build(template: str, vertices: int, body: Body, names: tuple[str, ...], seed: int = 0) -> Garment:
    """A garment of a template on a body, with about so many vertices (3 %).

    Args:
        template: one of TEMPLATES.
        vertices: wanted.
        body: watertight, in an A- or T-pose.
        names: of its joints, CMU's or SMPL's.
        seed: of the samples in the diffusion.

    Raises:
        ValueError: for an unknown template, joints that are missing, or a body on which the template fails.
    """
    if template not in TEMPLATES:
        raise ValueError(f"there is no template {template!r}: choose one of {', '.join(TEMPLATES)}")
    kind, wearer = TEMPLATES[template], _wearer(body, names)
    solid, triangles = _solid(kind, wearer)
    for distance in _cuts(kind, wearer):
        solid, triangles = clip(solid, triangles, distance(solid))
    solid, triangles = component(solid, triangles)
    nearest = igl.signed_distance(solid, wearer.vertices, wearer.faces, sign_type=WINDING)[2]
    if ((solid - nearest) * igl.per_vertex_normals(solid, triangles)).sum() < 0:
        triangles = triangles[:, ::-1]

    shape, faces, _ = resample(solid, triangles, vertices)
    shape, faces = _fit(shape, faces, wearer.vertices, wearer.faces)
    if len(boundary_loops(faces)) != kind.loops or components(len(shape), faces).max() > 0:
        raise ValueError(
            f"template {template!r} came out with {len(boundary_loops(faces))} openings, not {kind.loops}, "
            "on this body: try another pose, or bring a mesh (--mesh)"
        )
    long = kind.sleeve is not None and kind.sleeve > 1
    hidden = limbs(body, names, ARM if kind.waist else HANDS if long else FOREARM)
    pinned = highest_opening(shape, faces) if kind.waist else np.zeros(len(shape), bool)
    return dress(shape, faces, body, hidden, pinned, kind.samples, seed)


def _fit(
    vertices: np.ndarray, faces: np.ndarray, body: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The garment smoothed and pushed out of the body."""
    for _ in range(4):
        faces, _ = flip(vertices, faces)
        border = boundary_mask(faces, len(vertices))[:, None]
        vertices = np.where(border, vertices, 0.6 * vertices + 0.4 * relax(vertices, faces, 1))
        vertices = clear_vertices(vertices, body, triangles, 6)
    return push_out(vertices, faces, body, triangles), faces


def _wearer(body: Body, names: tuple[str, ...]) -> Wearer:
    known = cmu_names(names)
    joint = {name: np.asarray(place, np.float64) for name, place in zip(known, body.joints, strict=True)}
    needed = {"Neck", "Hips", "LowerBack"} | {
        side + bone for side in ("Left", "Right") for bone in ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
    }
    if needed - set(joint):
        raise ValueError(f"the body lacks the joints {sorted(needed - set(joint))}: name them as CMU or SMPL do")
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
    return Wearer(vertices, np.asarray(body.faces, np.int64), limbs(body, names, ARM), joint, level)


def _solid(kind: Template, wearer: Wearer) -> tuple[np.ndarray, np.ndarray]:
    """Closed surface of the implicit garment, before it is cut."""
    hem = wearer.level[kind.hem[0]] + kind.hem[1]
    top = wearer.level["waist"] + 0.02 if kind.waist else wearer.joint["Neck"][1] + 0.12
    end = "Hand" if kind.sleeve is not None and kind.sleeve > 1 else "ForeArm"
    reach = max(abs(wearer.joint[f"{side}{end}"][0]) for side in ("Left", "Right")) + 0.05
    width = max(0.45 if kind.hull else 0.4, 0 if kind.waist else reach)
    deep = 0.27 if kind.hull else 0.12
    low = np.array([-width, hem - 0.05, wearer.vertices[:, 2].min() - deep])
    high = np.array([width, top + 0.05, wearer.vertices[:, 2].max() + deep])
    grid = Grid(low, tuple(int(n) + 1 for n in np.ceil((high - low) / CELL)))
    points = np.stack(np.meshgrid(*(grid.axis(k) for k in range(3)), indexing="ij"), axis=-1)
    if kind.only_hull:
        field = _hang(kind, wearer, grid, hem)
    else:
        flat = points.reshape(-1, 3)
        field = igl.signed_distance(flat, wearer.vertices, wearer.faces, sign_type=WINDING)[0]
        field = _closed(field.reshape(grid.shape) - OFFSET, kind.closing)
        if kind.hull:
            field = np.minimum(field, _hang(kind, wearer, grid, hem))
    field = gaussian_filter(np.clip(field, -0.05, 0.05), kind.blur)
    values = np.ascontiguousarray(field.transpose(2, 1, 0)).reshape(-1)  # x runs fastest, as igl wants it
    places = np.ascontiguousarray(points.transpose(2, 1, 0, 3)).reshape(-1, 3)
    vertices, faces = igl.marching_cubes(values, places, *grid.shape, 0.0)[:2]
    return component(vertices, faces, wearer.joint["Hips" if kind.waist else "LowerBack"])


def _closed(field: np.ndarray, radius: float) -> np.ndarray:
    """The solid `field` < 0 grown by a radius and shrunk again: bridges armpits, cleavage, crotch."""
    if radius == 0:
        return field
    inward = distance_transform_edt(field <= radius) * CELL
    outward = distance_transform_edt(field > radius) * CELL
    grown = np.where(field <= radius, -(inward - CELL / 2), outward - CELL / 2)
    return np.minimum(field, grown + radius)


def _hang(kind: Template, wearer: Wearer, grid: Grid, hem: float) -> np.ndarray:
    """Implicit solid of what hangs: hulls of the body's slices and all above them, with a flare."""
    place, above, flare = kind.hull
    top = wearer.level[place] + above
    trunk = wearer.vertices[~wearer.arms]
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


def _cuts(kind: Template, wearer: Wearer) -> list[Callable[[np.ndarray], np.ndarray]]:
    """Functions of points [V, 3] that are > 0 where the solid is cut away."""
    hem, waist = wearer.level[kind.hem[0]] + kind.hem[1], wearer.level["waist"]
    neck, joint = wearer.joint["Neck"], wearer.joint
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
            away = np.array([sign, 0.25, 0]) / np.hypot(1, 0.25)
            cuts.append(_beyond_plane(joint[f"{side}Arm"] - [sign * 0.015, 0, 0], away))
        middle, wide = neck + np.array([0, 0.01, 0]), 0.34 * broad
        cuts.append(
            lambda x: (
                0.05 - 0.05 * ((x[:, 0] - middle[0]) / wide) ** 2 - 0.05 * ((x[:, 1] - middle[1]) / kind.scoop) ** 2
            )
        )
    return cuts


def _beyond_plane(point: np.ndarray, normal: np.ndarray, within: float = np.inf) -> Callable[[np.ndarray], np.ndarray]:
    return lambda x: np.where(np.linalg.norm(x - point, axis=1) < within, (x - point) @ normal, -1.0)


@dataclass(frozen=True)
class Arguments:
    """Makes a garment for a body, from a template or from a mesh that was modelled around it."""

    output: tyro.conf.Positional[Path]
    template: Literal["tshirt", "longsleeve", "tank", "pants", "skirt", "dress"] | None = None
    """This, or a mesh."""
    vertices: int | None = None
    """About so many; default: 1 000 of a template, a mesh as it is."""
    mesh: Path | None = None
    """A mesh (.obj, .ply, .off, .stl, .glb) around the body in its canonical pose. What follows is of it."""
    units: Unit = "m"
    up: Up = "y"
    """The axis that points up."""
    pin: str = "none"
    """What of it follows the body: none, its `highest` opening, vertices painted `red`, or `object:NAME`."""
    loose: bool | None = None
    """Whether it hangs, as skirts do; default: by its distance to the body."""
    flip: bool = False
    """The side that faces the body is its outside."""
    cloth: tuple[str, ...] = ()
    """Parts of other cloth: WHAT=DENSITY,STRETCHING,BENDING, each how many times as much as elsewhere, as
    `object:collar=1.5,4,20` or `red=1,4,20`."""
    body: str = "body"
    """File of the body, or the name of the embedded one."""
    licence: str = "CC0-1.0"
    seed: int = 0


def main(args: Arguments) -> None:
    """Writes the file the arguments ask for.

    Raises:
        ValueError: for arguments that do not go together, and what cannot be made.
    """
    if (args.mesh is None) == (args.template is None):
        raise ValueError("give either --template or --mesh")
    if args.vertices is not None and not MIN_VERTICES <= args.vertices <= MAX_VERTICES:
        raise ValueError(f"--vertices {args.vertices}: {MIN_VERTICES} to {MAX_VERTICES} can be trained")
    answers = Answers(args.units, args.up, args.pin, args.vertices, args.loose, args.flip, args.seed, args.cloth)
    of_mesh = Answers(vertices=args.vertices, seed=args.seed)
    unread = [name for name in Answers._fields if getattr(answers, name) != getattr(of_mesh, name)]
    if args.mesh is None and unread:
        raise ValueError(f"--{unread[0]} says something of a mesh: give --mesh")
    body, names = load_rig(args.body)
    if args.mesh is None:
        count = args.vertices or 1000
        garment = build(args.template, count, body, names, args.seed)
        source = f"python -m data_prep.garment --template {args.template} --vertices {count}"
    else:
        garment, said = bring(args.mesh, body, names, answers)
        print("\n".join(f"{args.mesh}: {line}" for line in said))
        source = args.mesh.name
    save_garment(
        args.output,
        garment,
        name=args.output.stem,
        body=Path(args.body).stem,
        source=source,
        licence=args.licence,
    )
    if args.mesh is not None:
        draw(args.output.with_suffix(".garment.png"), garment, body)
    print(f"{args.output}: {len(garment.vertices)} vertices, {int(garment.pinned.sum())} pinned")


if __name__ == "__main__":
    run(main, Arguments, __doc__)
