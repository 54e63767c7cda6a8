"""Garments for a body, from a template or from a mesh that was modelled around it.

    python -m data_prep.garment --template tshirt --vertices 1000 --body body.h5 out.h5
    python -m data_prep.garment --mesh shirt.obj --units cm --pin highest --body body.h5 out.h5

The body's skinning weights and shape directions are diffused onto the garment. A mesh is checked and repaired (see
`data_prep/user_mesh.py`); each change is printed, and the result is drawn beside the file.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
import tyro

from clothjax.files.storage import load_rig, save_garment
from clothjax.render import ray_cast
from clothjax.types import Body, Garment
from data_prep.placement import Placement
from data_prep.program import Axis, Unit, draw, run
from data_prep.templates import build
from data_prep.user_mesh import MAX_VERTICES, MIN_VERTICES, Answers, bring

OF_MESH = ("units", "up", "pin", "object", "shift", "turn", "sew", "outer", "allow", "loose", "flip", "cloth")
MOST_SEWN = 50.0  # mm
PIN_COLOUR = (0.85, 0.1, 0.1)


@dataclass(frozen=True)
class Arguments:
    """Make a garment for a body, from a template or from a mesh that was modelled around it."""

    output: tyro.conf.Positional[Path]
    template: Literal["tshirt", "long_sleeve", "tank", "pants", "skirt", "dress"] | None = None
    """Kind of garment to build; give either this or --mesh."""
    vertices: int | None = None
    """Approximate number of vertices; default: 1000 for a template, the mesh's own for a mesh."""
    mesh: Path | None = None
    """A mesh (.obj, .ply, .off, .stl, .glb, .gltf) around the body in its canonical pose."""
    units: Unit = "m"
    """Unit of length of the mesh."""
    up: Axis = "y"
    """Axis of the mesh that points up."""
    pin: str = "none"
    """Part of the mesh that is pinned to the body: `none`, its `highest` opening, borders `above:HEIGHT` in m, vertices
    painted `red`, or `object:NAME`."""
    object: tuple[str, ...] = ()
    """Objects, groups or materials of the file that are the garment; default: all."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres by which the mesh is moved onto the body: to the left, up and forward."""
    turn: float = 0.0
    """Degrees by which the mesh is turned about the vertical before."""
    sew: float = 0.1
    """Millimetres between borders that are one seam."""
    outer: bool = False
    """Keep only what is outermost: the outer side of a mesh with thickness, a garment without its lining."""
    allow: bool = False
    """Take a mesh that must be pushed far out of the body, has open seams, or has layers close to each other."""
    loose: bool | None = None
    """Treat the mesh as hanging loosely, as skirts do; default: by its distance to the body."""
    flip: bool = False
    """Make the side of the mesh that faces the body its outside."""
    cloth: tuple[str, ...] = ()
    """Parts of the mesh made of another cloth: WHAT=DENSITY,STRETCHING,BENDING, each as a multiple of the value
    elsewhere. Examples: `object:collar=1.5,4,20`, `red=1,4,20`."""
    body: str = "body"
    """File of the body, or the name of the embedded one."""
    licence: str = "CC0-1.0"
    seed: int = 0
    """Seed of the diffusion's samples."""


def main(args: Arguments) -> None:
    """Write the garment file, and for a mesh print its changes and draw it.

    Raises:
        ValueError: for arguments that do not go together, or a garment that cannot be made.
    """
    if (args.mesh is None) == (args.template is None):
        raise ValueError("give either --template or --mesh")
    if args.vertices is not None and not MIN_VERTICES <= args.vertices <= MAX_VERTICES:
        raise ValueError(f"--vertices {args.vertices}: {MIN_VERTICES} to {MAX_VERTICES} can be trained")
    if not 0.0 <= args.sew <= MOST_SEWN:
        raise ValueError(f"--sew {args.sew:g}: 0 to {MOST_SEWN:g} mm")
    answers = Answers(
        placement=Placement(args.units, args.up, args.shift, args.turn),
        pin=args.pin,
        vertices=args.vertices,
        loose=args.loose,
        flip=args.flip,
        seed=args.seed,
        cloth=args.cloth,
        objects=args.object,
        sew=args.sew,
        allow=args.allow,
        outer=args.outer,
    )
    plain = Arguments(args.output)
    of_mesh = [name for name in OF_MESH if getattr(args, name) != getattr(plain, name)]
    if args.mesh is None and of_mesh:
        raise ValueError(f"--{of_mesh[0]} is an option of --mesh: give --mesh")
    body, names = load_rig(args.body)
    if args.mesh is None:
        count = args.vertices or 1000
        garment = build(args.template, count, body, names, args.seed)
        source = f"python -m data_prep.garment --template {args.template} --vertices {count}"
    else:
        garment, log = bring(args.mesh, body, names, answers)
        print("\n".join(f"{args.mesh}: {line}" for line in log))
        source = args.mesh.name
    save_garment(
        args.output,
        garment,
        names,
        name=args.output.stem,
        body=Path(args.body).stem,
        source=source,
        licence=args.licence,
    )
    if args.mesh is not None:
        picture(args.output.with_suffix(".garment.png"), garment, body)
    print(f"{args.output}: {len(garment.vertices)} vertices, {int(garment.pinned.sum())} pinned")


def picture(path: str | Path, garment: Garment, body: Body) -> None:
    """Draw the garment on the body from four sides, pinned vertices as red dots; needs the extra `render`."""
    surfaces = [
        ray_cast.Surface(np.asarray(body.vertices), np.asarray(body.faces), ray_cast.SKIN),
        ray_cast.Surface(garment.vertices, garment.faces),
    ]
    dot = trimesh.creation.icosphere(1, 0.006)
    places = garment.vertices[garment.pinned]
    if len(places):
        dots = (places[:, None] + np.asarray(dot.vertices)[None]).reshape(-1, 3)
        faces = (len(dot.vertices) * np.arange(len(places))[:, None, None] + np.asarray(dot.faces)[None]).reshape(-1, 3)
        surfaces.append(ray_cast.Surface(dots, faces, PIN_COLOUR))
    size = np.ptp(garment.vertices, axis=0)
    margin = 1.2 * max(1.0, 4 / 3 * size[[0, 2]].max() / size[1])
    draw(Path(path), surfaces, garment.vertices, margin)


if __name__ == "__main__":
    run(main, Arguments, __doc__)
