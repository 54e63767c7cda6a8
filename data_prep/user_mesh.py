"""A garment from a mesh that somebody modelled around a body: checked, welded, put into metres, pushed out of the body.

What can be decided is done and reported; what would be a guess is refused, with the flag that answers it.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import igl
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from clothjax.files.storage import FACTORS
from clothjax.geometry.topology import boundary_loops, components
from clothjax.render import ray_cast
from clothjax.types import Body, Garment
from data_prep.dressing import FOREARM, WINDING, dress, highest_opening, limbs, push_out
from data_prep.mesh import compact, edge_table
from data_prep.remesh import resample

Unit = Literal["m", "cm", "mm", "in", "ft"]
Up = Literal["y", "z"]
UNITS: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
TURNS = {"y": np.eye(3), "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}  # to +Y up
WELD = 1e-4  # m, vertices closer than this are one
NEAR = 0.25  # m, a garment's mean distance to the body is less ...
INSIDE = 10  # ... and counts so many times more where it is inside
LOOSE = 0.03  # m, the median distance from which a garment counts as loose
DEEP, MANY = 0.03, 0.15  # m inside the body, and the share of vertices so deep that the garment is another body's
FEWEST, MOST = 100, 20_000  # vertices
PINNED = (0.85, 0.1, 0.1)
SAMPLES = 500  # of the diffusion onto loose garments


class Answers(NamedTuple):
    """What only the user knows."""

    units: Unit = "m"
    up: Up = "y"
    pin: str = "none"  # none, highest, red, or object:NAME
    vertices: int | None = None  # wanted; None: the mesh as it is
    loose: bool | None = None  # None: by its distance to the body
    flip: bool = False  # the side that faces the body is the outside
    seed: int = 0
    cloth: tuple[str, ...] = ()  # WHAT=DENSITY,STRETCHING,BENDING; what, as of `pin`: red, or object:NAME


class Mesh(NamedTuple):
    """A mesh as it is in the file."""

    vertices: np.ndarray  # [V, 3] in the file's units
    faces: np.ndarray  # [F, 3]
    red: np.ndarray  # [V] bool, painted red
    objects: dict[str, np.ndarray]  # by name, [V] bool


def bring(path: str | Path, body: Body, names: tuple[str, ...], answers: Answers) -> tuple[Garment, list[str]]:
    """The garment, and lines that say what was done to the mesh; `names` are those of the body's joints.

    Raises:
        ValueError: naming the file, the place in it, and what to do.
    """
    mesh, said = read(path), []
    surface = np.asarray(body.vertices, np.float64), np.asarray(body.faces, np.int64)
    _check_place(path, mesh.vertices, surface, answers)
    points = UNITS[answers.units] * mesh.vertices @ TURNS[answers.up].T
    points, faces, now = _clean(path, points, mesh.faces, said)
    marked = np.isin(np.arange(len(points)), now[_marked(path, mesh, answers.pin, "--pin")])
    cloth = _cloth(path, mesh, answers.cloth, now, len(points), said)
    faces = _oriented(path, points, faces, surface, answers.flip, said)
    if answers.vertices:
        before = points
        points, faces, marked = _resampled(points, faces, marked, answers.vertices, said)
        cloth = None if cloth is None else cloth[cKDTree(before).query(points)[1]]
    if not FEWEST <= len(points) <= MOST:
        raise ValueError(
            f"{path}: {len(points)} vertices; {FEWEST} to {MOST} can be trained: give --vertices for another number"
        )
    points = _pushed_out(path, points, faces, surface, said)
    distance = np.abs(igl.signed_distance(points, *surface, sign_type=WINDING)[0])
    loose = bool(np.median(distance) > LOOSE) if answers.loose is None else answers.loose
    said.append(
        f"{'loose' if loose else 'tight'}: {1e3 * np.median(distance):.0f} mm from the body in the middle, so skin and "
        f"shape are those of the body {'around' if loose else 'nearest to'} each vertex"
    )
    openings = len(boundary_loops(faces))
    if answers.pin == "highest" and not openings:
        raise ValueError(f"{path}: closed, it has no opening to pin: use --pin none, red or object:NAME")
    pinned = highest_opening(points, faces) if answers.pin == "highest" else marked
    parts = 1 + int(components(len(points), faces).max())
    said.append(
        f"{len(points)} vertices, {len(faces)} faces, {parts} part{'s' * (parts > 1)}, {openings} openings, "
        f"{int(pinned.sum())} vertices pinned"
    )
    hidden = _bare(points, body, names)
    garment = dress(points, faces, body, hidden, pinned, SAMPLES if loose else 0, answers.seed)
    return garment._replace(cloth=cloth), said


def read(path: str | Path) -> Mesh:
    """A mesh file (.obj, .ply, .off, .stl, .glb), all of its objects in one.

    Raises:
        ValueError: if it is not one, has no triangles, or a vertex that is not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        scene = trimesh.load_scene(path, process=False, split_objects=True, group_material=False, skip_materials=True)
        parts = []
        for node in scene.graph.nodes_geometry:
            place, name = scene.graph[node]
            if isinstance(scene.geometry[name], trimesh.Trimesh) and len(scene.geometry[name].faces):
                parts.append(({node, name}, scene.geometry[name].copy().apply_transform(place)))
    except Exception as error:  # whatever a reader of a damaged file of some format raises
        raise ValueError(f"{path}: not a mesh that can be read ({_brief(error)}); export it as .obj or .glb") from error
    if not parts:
        raise ValueError(f"{path}: no triangles; export the mesh with its faces")
    starts = np.cumsum([0, *(len(part.vertices) for _, part in parts)])
    vertices = np.concatenate([np.asarray(part.vertices, np.float64) for _, part in parts])
    faces = np.concatenate([np.asarray(part.faces, np.int64) + start for (_, part), start in zip(parts, starts)])
    wrong = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(wrong):
        raise ValueError(f"{path}: vertex {wrong[0] + 1} of {len(vertices)} is not finite: {vertices[wrong[0]]}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{path}: a face names vertex {faces.max() + 1} of {len(vertices)}")
    objects = {name: np.zeros(len(vertices), bool) for names, _ in parts for name in names}
    for (names, part), start in zip(parts, starts):
        for name in names:
            objects[name][np.asarray(part.faces) + start] = True
    return Mesh(vertices, faces, np.concatenate([_red(part) for _, part in parts]), objects)


def _brief(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _red(part: trimesh.Trimesh) -> np.ndarray:
    if part.visual.kind != "vertex":
        return np.zeros(len(part.vertices), bool)
    red, green, blue = np.asarray(part.visual.vertex_colors)[:, :3].astype(int).T
    return (red > 150) & (green < 100) & (blue < 100)


def _check_place(path, vertices: np.ndarray, surface, answers: Answers) -> None:
    """Refuses a mesh that is not around the body as the user says it is, and says how it would be."""

    def away(units: str, up: str) -> tuple[float, float]:
        """Mean distance to the body in m, and the same with more for what is inside; infinite where the mesh is far
        larger or smaller."""
        points = UNITS[units] * vertices @ TURNS[up].T
        height = np.ptp(surface[0][:, 1])
        smallest = 0.05 if (units, up) == (answers.units, answers.up) else 0.15
        if not smallest * height < np.ptp(points, axis=0).max() < 1.5 * height:
            return np.inf, np.inf
        few = points[:: max(1, len(points) // 500)]
        signed = igl.signed_distance(few, *surface, sign_type=WINDING)[0]
        distance = np.mean(np.abs(signed))
        return float(distance), float(distance + INSIDE * np.mean(np.maximum(-signed, 0.0)))

    found = {(units, up): away(units, up) for units in UNITS for up in TURNS}
    near = {how: worn for how, (distance, worn) in found.items() if distance < NEAR}
    told = near.get((answers.units, answers.up), np.inf)
    if told < np.inf and told <= 2 * min(near.values()) + 0.01:
        return
    size = np.ptp(vertices, axis=0)
    shown = f"{path}: {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} {answers.units}, {answers.up.upper()} up"
    if near:
        units, up = min(near, key=near.get)
        raise ValueError(f"{shown}: that is not around the body. Is it meant to be --units {units} --up {up}?")
    raise ValueError(
        f"{shown}: in no unit around the body, which is {np.ptp(surface[0][:, 1]):.2f} m high with its middle at "
        f"{np.round(0.5 * (surface[0].min(axis=0) + surface[0].max(axis=0)), 2)}: move the mesh onto the body in its "
        "canonical pose"
    )


def _clean(path, points: np.ndarray, faces: np.ndarray, said: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mesh without double vertices and faces without area, and for each vertex of the file which one it is now, -1
    for none."""
    near = cKDTree(points).query_pairs(WELD, output_type="ndarray")
    _, first, index = np.unique(components(len(points), near), return_index=True, return_inverse=True)
    if len(first) < len(points):
        said.append(f"welded: {len(points) - len(first)} vertices lay on others")
    points, faces = points[first], index[faces]
    corners = points[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    _, unlike = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    kept = (area > 1e-10) & np.isin(np.arange(len(faces)), unlike)
    if not kept.all():
        said.append(f"left out: {int((~kept).sum())} faces without area, or twice there")
    if not kept.any():
        raise ValueError(f"{path}: no face has any area")
    used = np.unique(faces[kept])
    if len(used) < len(points):
        said.append(f"left out: {len(points) - len(used)} vertices without a face")
    points, faces = compact(points, faces[kept])
    now = np.full(len(first), -1)
    now[used] = np.arange(len(used))
    edges, _, sharing = edge_table(faces)
    crowded = np.flatnonzero(sharing > 2)
    if len(crowded):
        middle = np.round(points[edges[crowded[0]]].mean(axis=0), 3)
        raise ValueError(
            f"{path}: {len(crowded)} edges have more than two faces, the first at {middle} m: a cloth has two sides; "
            "separate the layers there, or delete the inner faces"
        )
    return points, faces, now[index]


def _marked(path, mesh: Mesh, what: str, flag: str) -> np.ndarray:
    """Vertices [V] that the file itself marks: by a colour, or as an object."""
    if what in ("none", "highest") and flag == "--pin":
        return np.zeros(len(mesh.vertices), bool)
    if what == "red":
        if not mesh.red.any():
            raise ValueError(
                f"{path}: {flag} red, but no vertex is painted red (.ply and .glb keep colours of vertices)"
            )
        return mesh.red
    if what.startswith("object:"):
        name = what.removeprefix("object:")
        if name not in mesh.objects:
            raise ValueError(f"{path}: has no object {name!r} for {flag}; there are: {', '.join(mesh.objects)}")
        return mesh.objects[name]
    known = "none, highest, red or object:NAME" if flag == "--pin" else "red=... or object:NAME=..."
    raise ValueError(f"{flag} {what}: choose {known}")


def _cloth(path, mesh: Mesh, regions: tuple[str, ...], now: np.ndarray, count: int, said: list[str]):
    """Factors [V, 3] of the cloth of each vertex; None where all is the same. A later region covers an earlier one.

    Args:
        now: which of the `count` vertices each of the file's is, -1 for none.
    """
    if not regions:
        return None
    factors, (low, high) = np.ones((count, 3)), FACTORS
    for region in regions:
        what, _, given = region.rpartition("=")
        try:
            wanted = np.array([float(x) for x in given.split(",")])
        except ValueError:
            wanted = np.zeros(0)
        if len(wanted) != 3 or not ((wanted >= low) & (wanted <= high)).all():
            raise ValueError(
                f"--cloth {region}: give WHAT=DENSITY,STRETCHING,BENDING, each how many times as much as elsewhere, "
                f"from {low} to {high}, as red=1,4,10"
            )
        there = np.setdiff1d(now[_marked(path, mesh, what, "--cloth")], [-1])
        factors[there] = wanted
        said.append(
            f"{what}: {len(there)} vertices with {wanted[0]:g} times the weight, {wanted[1]:g} times the stiffness, "
            f"{wanted[2]:g} times that of bending"
        )
    return factors


def _oriented(path, points, faces, surface, flip: bool, said: list[str]) -> np.ndarray:
    """Faces of each part turned one way, with the outside away from the body."""
    turned, part = igl.bfs_orient(faces)
    halves, times = np.unique(turned[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=0, return_counts=True)
    if times.max() > 1:
        middle = np.round(points[halves[times.argmax()]].mean(axis=0), 3)
        raise ValueError(f"{path}: has only one side (a Moebius strip): cut it open, as along the edge at {middle} m")
    foot = igl.signed_distance(points, *surface, sign_type=WINDING)[2]
    corners = points[turned]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.bincount(part, ((points - foot)[turned].mean(axis=1) * normal).sum(axis=1))
    wrong = (outward < 0) != flip
    turned = np.where(wrong[part][:, None], turned[:, ::-1], turned)
    changed = int((_winding(turned) != _winding(faces)).sum())
    if changed:
        said.append(f"turned: {changed} of {len(faces)} faces, so that all look away from the body")
    return turned


def _winding(faces: np.ndarray) -> np.ndarray:
    """Whether each face [F, 3] goes through its vertices in ascending order, but for where it starts."""
    start = faces.argmin(axis=1)
    rows = np.arange(len(faces))
    return faces[rows, (start + 1) % 3] < faces[rows, (start + 2) % 3]


def _resampled(points, faces, marked, wanted: int, said: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface with about so many vertices, each of them pinned if the nearest before was."""
    shape, triangles, length = resample(points, faces, wanted)
    said.append(f"remeshed: {len(points)} vertices to {len(shape)}, edges of {1e3 * length:.0f} mm")
    if not marked.any():
        return shape, triangles, np.zeros(len(shape), bool)
    return shape, triangles, cKDTree(points[marked]).query(shape)[0] < 0.5 * length


def _bare(points: np.ndarray, body: Body, names: tuple[str, ...]) -> np.ndarray:
    """Whether each vertex of the body [B] is of a forearm or a hand that the garment does not cover: a skirt must not
    follow the hands beside it."""
    hidden = limbs(body, names, FOREARM)
    distance, nearest = cKDTree(body.vertices).query(points)
    covered = (hidden[nearest] & (distance < LOOSE)).mean() > 0.01
    return hidden & ~covered


def _pushed_out(path, points: np.ndarray, faces: np.ndarray, surface, said: list[str]) -> np.ndarray:
    """The mesh out of the body."""
    signed = igl.signed_distance(points, *surface, sign_type=WINDING)[0]
    deep, deepest = float((signed < -DEEP).mean()), np.round(points[signed.argmin()], 2)
    if deep > MANY:
        raise ValueError(
            f"{path}: {100 * deep:.0f} % of its vertices are more than {1e3 * DEEP:.0f} mm inside the body, at most "
            f"{-1e3 * signed.min():.0f}, at {deepest} m: it was made for another body or another pose; --body names "
            "the body"
        )
    cleared = push_out(points, faces, *surface)
    signed = igl.signed_distance(cleared, *surface, sign_type=WINDING)[0]
    if signed.min() < 0:
        place = np.round(points[signed.argmin()], 2)
        raise ValueError(
            f"{path}: {int((signed < 0).sum())} vertices cannot be pushed out of the body, the first at {place} m: "
            "move them out of it"
        )
    moved = np.linalg.norm(cleared - points, axis=1)
    if moved.any():
        said.append(
            f"pushed out of the body: {int((moved > 0).sum())} vertices, by {1e3 * moved.max():.0f} mm at the most"
        )
    return cleared


def draw(path: str | Path, garment: Garment, body: Body) -> None:
    """A picture of the garment on the body from four sides, with pinned vertices as red dots; without the extra
    `render`, none."""
    surfaces = [
        ray_cast.Surface(np.asarray(body.vertices), np.asarray(body.faces), ray_cast.SKIN),
        ray_cast.Surface(garment.vertices, garment.faces),
    ]
    dot = trimesh.creation.icosphere(1, 0.006)
    places = garment.vertices[garment.pinned]
    if len(places):
        dots = (places[:, None] + np.asarray(dot.vertices)[None]).reshape(-1, 3)
        faces = (len(dot.vertices) * np.arange(len(places))[:, None, None] + np.asarray(dot.faces)[None]).reshape(-1, 3)
        surfaces.append(ray_cast.Surface(dots, faces, PINNED))
    views = ("front", "three-quarter", "side", "back")
    try:
        size = np.ptp(garment.vertices, axis=0)
        margin = 1.2 * max(1.0, 4 / 3 * size[[0, 2]].max() / size[1])
        pictures = [ray_cast.render(surfaces, ray_cast.camera_for(garment.vertices, view, margin)) for view in views]
        ray_cast.comparison(path, {"": pictures}, views)
    except ImportError as error:
        print(f"{path}: not drawn ({error})")
