"""A garment from a mesh that was modelled around a body: checked, welded, put into metres, pushed out of the body.

Repairs that have one right answer are made and logged. A mesh that would need a guess is refused, and the message
names the option that answers it.
"""

from pathlib import Path
from typing import Literal, NamedTuple

import igl
import numpy as np
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from clothjax.files.storage import FACTORS
from clothjax.geometry.topology import boundary_loops, boundary_mask, components
from clothjax.render import ray_cast
from clothjax.types import Body, Garment
from data_prep import mesh_file
from data_prep.dressing import CLEARANCE, FOREARM, WINDING, dress, limbs, push_out
from data_prep.mesh import compact, edge_table
from data_prep.mesh_file import Mesh
from data_prep.remesh import resample

Unit = Literal["m", "cm", "mm", "in", "ft"]
Up = Literal["y", "z"]
Surface = tuple[np.ndarray, np.ndarray]  # the body's vertices [B, 3] m float64 and faces [F, 3] int64
UNITS: dict[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
TO_Y_UP = {"y": np.eye(3), "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}
WELD_DISTANCE = 1e-4  # m; closer vertices become one
MAX_MEAN_DISTANCE = 0.25  # m, from the body, of a garment that is around it
INSIDE_PENALTY = 10  # weight of the depth inside the body over the distance to it, in comparing units
LOOSE_DISTANCE = 0.03  # m; a garment with a larger median distance to the body counts as loose
DEEP, MAX_DEEP_SHARE = 0.03, 0.15  # m inside the body; a larger share of such vertices means another body
MIN_VERTICES, MAX_VERTICES = 100, 20_000
DIFFUSION_SAMPLES = 500  # for each vertex of a loose garment
FARTHEST_PUSH = 0.03  # m, by which a garment that is worn is pushed out of the body at most
ON_BODY = 0.003  # m, from the body, of an object that is the body
MOST_OF_HEIGHT = 0.4  # of the garment's, that an opening to pin may take up
BESIDE, LEAST_BESIDE = 0.002, 0.2  # m between borders that are not sewn, and the share of a border that runs so
PIN_COLOUR = (0.85, 0.1, 0.1)


class Answers(NamedTuple):
    """Answers that only the user knows."""

    units: Unit = "m"
    up: Up = "y"
    pin: str = "none"  # none, highest, above:HEIGHT, red, or object:NAME
    vertices: int | None = None  # wanted; None: the mesh as it is
    loose: bool | None = None  # None: by its distance to the body
    flip: bool = False  # the side that faces the body is the outside
    seed: int = 0
    cloth: tuple[str, ...] = ()  # WHAT=DENSITY,STRETCHING,BENDING with WHAT red or object:NAME
    objects: tuple[str, ...] = ()  # of the file, that are the garment; none for all
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, by which the mesh is moved onto the body
    turn: float = 0.0  # degrees, by which it is turned about the vertical before
    sew: float = 0.1  # mm, between borders that are one seam
    allow: bool = False  # take a mesh that is pushed far


class Working(NamedTuple):
    """The garment between two steps of `bring`."""

    vertices: np.ndarray  # [V, 3] m, +Y up
    faces: np.ndarray  # [F, 3]
    pinned: np.ndarray  # [V] bool
    cloth: np.ndarray | None = None  # [V, 3] factors of density, stretching and bending
    log: tuple[str, ...] = ()  # a line for each change

    def logged(self, line: str) -> "Working":
        """Return the same garment with one more line in its log."""
        return self._replace(log=(*self.log, line))


def bring(path: str | Path, body: Body, names: tuple[str, ...], answers: Answers) -> tuple[Garment, tuple[str, ...]]:
    """Make a garment from a mesh file.

    Args:
        path: of the mesh.
        body: that the mesh was modelled around.
        names: of the body's joints.
        answers: of the user.

    Returns:
        The garment, and a log of the changes, one line each.

    Raises:
        ValueError: naming the file, the place in it, and what to do.
    """
    mesh = _chosen(path, mesh_file.read(path), answers.objects)
    surface = np.asarray(body.vertices, np.float64), np.asarray(body.faces, np.int64)
    _check_place(path, mesh.vertices, surface, answers)
    placed = _placed(mesh.vertices, answers)
    _check_objects(path, mesh, placed, surface)
    working, index = _clean(path, placed, mesh.faces)
    working = _sewn(working, 1e-3 * answers.sew)
    if not answers.allow:
        _check_seams(path, working)
    working = _pin_marked(path, working, mesh, index, answers.pin)
    working = _assign_cloth(path, working, mesh, index, answers.cloth)
    working = _orient(path, working, surface, answers.flip)
    if answers.vertices:
        working = _resample(working, answers.vertices)
    if not MIN_VERTICES <= len(working.vertices) <= MAX_VERTICES:
        raise ValueError(
            f"{path}: {len(working.vertices)} vertices; {MIN_VERTICES} to {MAX_VERTICES} can be trained: "
            "give --vertices for another number"
        )
    working = _push_out(path, working, surface, answers)
    distance = float(np.median(np.abs(igl.signed_distance(working.vertices, *surface, sign_type=WINDING)[0])))
    loose = distance > LOOSE_DISTANCE if answers.loose is None else answers.loose
    working = working.logged(
        f"{'loose' if loose else 'tight'}: {1e3 * distance:.0f} mm from the body in the middle, so skin and "
        f"shape are those of the body {'around' if loose else 'nearest to'} each vertex"
    )
    if answers.pin == "highest":
        working = _pin_highest_opening(path, working)
    elif answers.pin.startswith("above:"):
        working = _pin_above(path, working, answers.pin.removeprefix("above:"))
    working = _log_counts(working)
    vertices, faces, pinned, cloth, log = working
    hidden = _uncovered_arms(vertices, body, names)
    samples = DIFFUSION_SAMPLES if loose else 0
    return dress(vertices, faces, body, hidden, pinned, samples, answers.seed)._replace(cloth=cloth), log


def _placed(vertices: np.ndarray, answers: Answers) -> np.ndarray:
    """Return the vertices [V, 3] of a file in m, +Y up, where the user wants them."""
    turn = Rotation.from_euler("y", answers.turn, degrees=True).as_matrix()
    return UNITS[answers.units] * vertices @ TO_Y_UP[answers.up].T @ turn.T + np.array(answers.shift)


def _chosen(path: str | Path, mesh: Mesh, objects: tuple[str, ...]) -> Mesh:
    """Return the mesh of some objects of a file, or of all."""
    if not objects:
        return mesh
    absent = [name for name in objects if name not in mesh.objects]
    if absent:
        raise ValueError(f"{path}: has no object {absent[0]!r}; there are: {', '.join(mesh.objects)}")
    kept = np.any([mesh.objects[name] for name in objects], axis=0)
    faces = mesh.faces[kept[mesh.faces].all(axis=1)]
    used = np.unique(faces)
    vertices, faces = compact(mesh.vertices, faces)
    return Mesh(vertices, faces, mesh.red[used], {name: which[used] for name, which in mesh.objects.items()})


def _check_objects(path: str | Path, mesh: Mesh, placed: np.ndarray, surface: Surface) -> None:
    """Refuse a file one of whose objects is the body itself."""
    if len(mesh.objects) < 2:
        return
    tree = cKDTree(placed)
    for name, which in mesh.objects.items():
        if which.all() or which.sum() < len(surface[0]) / 10:
            continue
        sample = placed[which][:: max(1, int(which.sum()) // 500)]
        apart = np.abs(igl.signed_distance(sample, *surface, sign_type=WINDING)[0])
        covered = tree.query(surface[0][::20])[0]
        if np.median(apart) < ON_BODY and np.median(covered) < LOOSE_DISTANCE:
            others = [other for other in mesh.objects if not (mesh.objects[other] & which).any()]
            raise ValueError(
                f"{path}: its object {name!r} is the body itself; there are {', '.join(mesh.objects)}: choose the "
                f"garment, as with --object {others[0] if others else 'NAME'}"
            )


def _check_place(path: str | Path, vertices: np.ndarray, surface: Surface, answers: Answers) -> None:
    """Refuse a mesh that is not around the body in the user's units and axis, and name those in which it is."""
    height = np.ptp(surface[0][:, 1])

    def distances(units: str, up: str) -> tuple[float, float]:
        """Return the mean distance to the body [m], without and with a penalty for the inside.

        Both are infinite for a mesh far larger or smaller than the body.
        """
        points = _placed(vertices, answers._replace(units=units, up=up))
        smallest = 0.05 if (units, up) == (answers.units, answers.up) else 0.15
        if not smallest * height < np.ptp(points, axis=0).max() < 1.5 * height:
            return np.inf, np.inf
        sample = points[:: max(1, len(points) // 500)]
        signed = igl.signed_distance(sample, *surface, sign_type=WINDING)[0]
        distance = np.mean(np.abs(signed))
        return float(distance), float(distance + INSIDE_PENALTY * np.mean(np.maximum(-signed, 0.0)))

    by_placement = {(units, up): distances(units, up) for units in UNITS for up in TO_Y_UP}
    near = {key: penalised for key, (distance, penalised) in by_placement.items() if distance < MAX_MEAN_DISTANCE}
    answered = near.get((answers.units, answers.up), np.inf)
    if answered < np.inf and answered <= 2 * min(near.values()) + 0.01:
        return
    size = np.ptp(vertices, axis=0)
    size_text = f"{path}: {size[0]:.3g} x {size[1]:.3g} x {size[2]:.3g} {answers.units}, {answers.up.upper()} up"
    if near:
        units, up = min(near, key=near.get)
        raise ValueError(f"{size_text}: that is not around the body. Is it meant to be --units {units} --up {up}?")
    raise ValueError(
        f"{size_text}: not around the body in any unit. The body is {height:.2f} m high with its middle at "
        f"{np.round(0.5 * (surface[0].min(axis=0) + surface[0].max(axis=0)), 2)}: move the mesh onto the body in its "
        "canonical pose"
    )


def _clean(path: str | Path, points: np.ndarray, faces: np.ndarray) -> tuple[Working, np.ndarray]:
    """Weld vertices [V, 3] m at one place, and remove faces without area and vertices without a face.

    Return the garment, nothing pinned, and for each of the file's vertices [V] its index in it, -1 for none.
    """
    near = cKDTree(points).query_pairs(WELD_DISTANCE, output_type="ndarray")
    _, first, welded = np.unique(components(len(points), near), return_index=True, return_inverse=True)
    log = []
    if len(first) < len(points):
        log.append(f"welded: {len(points) - len(first)} vertices lay on others")
    points, faces = points[first], welded[faces]
    area = igl.doublearea(points, faces) / 2
    _, distinct = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    valid = (area > 1e-10) & np.isin(np.arange(len(faces)), distinct)
    if not valid.all():
        log.append(f"left out: {int((~valid).sum())} faces without area, or twice there")
    if not valid.any():
        raise ValueError(f"{path}: no face has any area")
    used = np.unique(faces[valid])
    if len(used) < len(points):
        log.append(f"left out: {len(points) - len(used)} vertices without a face")
    points, faces = compact(points, faces[valid])
    index = np.full(len(first), -1)
    index[used] = np.arange(len(used))
    edges, _, face_count = edge_table(faces)
    crowded = np.flatnonzero(face_count > 2)
    if len(crowded):
        middle = np.round(points[edges[crowded[0]]].mean(axis=0), 3)
        raise ValueError(
            f"{path}: {len(crowded)} edges have more than two faces, the first at {middle} m: a cloth has two sides; "
            "separate the layers there, or delete the inner faces"
        )
    return Working(points, faces, np.zeros(len(points), bool), log=tuple(log)), index[welded]


def _marked(path: str | Path, mesh: Mesh, what: str, flag: str) -> np.ndarray:
    """Return which of the file's vertices [V] bool are marked there, by a colour or as an object."""
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
    known = "none, highest, above:HEIGHT, red or object:NAME" if flag == "--pin" else "red=... or object:NAME=..."
    raise ValueError(f"{flag} {what}: choose {known}")


def _pin_marked(path: str | Path, working: Working, mesh: Mesh, index: np.ndarray, pin: str) -> Working:
    """Pin the vertices that the file marks; none for what is a place. `index` is that of `_clean`."""
    if pin in ("none", "highest") or pin.startswith("above:"):
        return working
    marked = index[_marked(path, mesh, pin, "--pin")]
    return working._replace(pinned=np.isin(np.arange(len(working.vertices)), marked))


def _assign_cloth(
    path: str | Path, working: Working, mesh: Mesh, index: np.ndarray, regions: tuple[str, ...]
) -> Working:
    """Set the cloth's factors in regions WHAT=DENSITY,STRETCHING,BENDING; a later one covers an earlier one."""
    if not regions:
        return working
    factors, (low, high) = np.ones((len(working.vertices), 3)), FACTORS
    for region in regions:
        what, _, numbers = region.rpartition("=")
        try:
            values = np.array([float(x) for x in numbers.split(",")])
        except ValueError:
            values = np.zeros(0)
        if len(values) != 3 or not ((values >= low) & (values <= high)).all():
            raise ValueError(
                f"--cloth {region}: give WHAT=DENSITY,STRETCHING,BENDING, each how many times as much as elsewhere, "
                f"from {low} to {high}, as red=1,4,10"
            )
        members = np.setdiff1d(index[_marked(path, mesh, what, "--cloth")], [-1])
        factors[members] = values
        working = working.logged(
            f"{what}: {len(members)} vertices with {values[0]:g} times the weight, {values[1]:g} times the stiffness, "
            f"{values[2]:g} times that of bending"
        )
    return working._replace(cloth=factors)


def _orient(path: str | Path, working: Working, surface: Surface, flip: bool) -> Working:
    """Turn the faces of each part one way, with the outside away from the body, or towards it for `flip`."""
    points, faces = working.vertices, working.faces
    turned, part = igl.bfs_orient(faces)
    half_edges, times = np.unique(turned[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=0, return_counts=True)
    if times.max() > 1:
        middle = np.round(points[half_edges[times.argmax()]].mean(axis=0), 3)
        raise ValueError(f"{path}: has only one side (a Moebius strip): cut it open, as along the edge at {middle} m")
    nearest = igl.signed_distance(points, *surface, sign_type=WINDING)[2]
    corners = points[turned]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = np.bincount(part, ((points - nearest)[turned].mean(axis=1) * normal).sum(axis=1))
    reverse = (outward < 0) != flip
    turned = np.where(reverse[part][:, None], turned[:, ::-1], turned)
    changed = int((_winding(turned) != _winding(faces)).sum())
    working = working._replace(faces=turned)
    if not changed:
        return working
    return working.logged(f"turned: {changed} of {len(faces)} faces, so that all look away from the body")


def _winding(faces: np.ndarray) -> np.ndarray:
    """Return for each face [F, 3] whether the vertex after its lowest is the lower of the other two."""
    start = faces.argmin(axis=1)
    rows = np.arange(len(faces))
    return faces[rows, (start + 1) % 3] < faces[rows, (start + 2) % 3]


def _resample(working: Working, count: int) -> Working:
    """Remesh to about `count` vertices; pins and cloth are those of the nearest vertices before."""
    vertices, faces, length = resample(working.vertices, working.faces, count)
    pinned, cloth = np.zeros(len(vertices), bool), working.cloth
    if working.pinned.any():
        pinned = cKDTree(working.vertices[working.pinned]).query(vertices)[0] < 0.5 * length
    if cloth is not None:
        cloth = cloth[cKDTree(working.vertices).query(vertices)[1]]
    line = f"remeshed: {len(working.vertices)} vertices to {len(vertices)}, edges of {1e3 * length:.0f} mm"
    return Working(vertices, faces, pinned, cloth, working.log).logged(line)


def _push_out(path: str | Path, working: Working, surface: Surface, answers: Answers) -> Working:
    """Push the garment out of the body; refuse one that is deep inside it or cannot be pushed out."""
    points = working.vertices
    signed = igl.signed_distance(points, *surface, sign_type=WINDING)[0]
    deep_share, deepest = float((signed < -DEEP).mean()), np.round(points[signed.argmin()], 2)
    if deep_share > MAX_DEEP_SHARE and not answers.allow:
        raise ValueError(
            f"{path}: {100 * deep_share:.0f} % of its vertices are more than {1e3 * DEEP:.0f} mm inside the body, "
            f"at most {-1e3 * signed.min():.0f}, at {deepest} m: it was made for another body or another pose, or is "
            f"worn elsewhere. {_better_place(points, surface)}--allow takes it as it is"
        )
    cleared = push_out(points, working.faces, *surface)
    signed = igl.signed_distance(cleared, *surface, sign_type=WINDING)[0]
    if signed.min() < 0:
        place = np.round(points[signed.argmin()], 2)
        raise ValueError(
            f"{path}: {int((signed < 0).sum())} vertices cannot be pushed out of the body, the first at {place} m: "
            "move them out of it"
        )
    moved = np.linalg.norm(cleared - points, axis=1)
    if moved.max() > FARTHEST_PUSH and not answers.allow:
        place = np.round(points[moved.argmax()], 2)
        raise ValueError(
            f"{path}: {int((moved > FARTHEST_PUSH).sum())} vertices would be pushed out of the body by more than "
            f"{1e3 * FARTHEST_PUSH:.0f} mm, the farthest by {1e3 * moved.max():.0f} mm, at {place} m: it is not worn "
            f"like that. {_better_place(points, surface)}--allow takes it as it is"
        )
    working = working._replace(vertices=cleared)
    if not moved.any():
        return working
    return working.logged(
        f"pushed out of the body: {int((moved > 0).sum())} vertices, by {1e3 * moved.max():.0f} mm at the most"
    )


def _better_place(points: np.ndarray, surface: Surface) -> str:
    """Return a hint at a place of a garment [V, 3] m at which it is pushed less, if there is one."""
    sample = points[:: max(1, len(points) // 300)]
    middle = points.mean(axis=0)

    def inside(turn: float, shift: tuple[float, float, float]) -> float:
        turned = Rotation.from_euler("y", turn, degrees=True).as_matrix()
        signed = igl.signed_distance(sample @ turned.T + np.array(shift), *surface, sign_type=WINDING)[0]
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


def _sewn(working: Working, distance: float) -> Working:
    """Join borders that lie on each other within `distance` m, also where one has vertices that the other lacks."""
    vertices, faces = working.vertices, working.faces
    border = np.flatnonzero(boundary_mask(faces, len(vertices)))
    near = border[cKDTree(vertices[border]).query_pairs(distance, output_type="ndarray")] if len(border) else border
    edges = edge_table(faces)[0]
    joined = {tuple(edge) for edge in edges.tolist()}
    near = np.array([pair for pair in near.tolist() if tuple(sorted(pair)) not in joined], np.int64).reshape(-1, 2)
    if len(near):
        _, first, group = np.unique(components(len(vertices), near), return_index=True, return_inverse=True)
        faces = group[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        used = np.unique(faces)
        vertices, pinned = vertices[first][used], working.pinned[first][used]
        faces = np.searchsorted(used, faces)
        working = working._replace(vertices=vertices, pinned=pinned)
    faces, split = _split_at_borders(vertices, faces, max(distance, WELD_DISTANCE))
    working = working._replace(faces=faces)
    if len(near):
        working = working.logged(
            f"sewn: {len(near)} vertices of borders within {1e3 * distance:g} mm of another border"
        )
    if split:
        working = working.logged(f"sewn: {split} vertices that lay on the edge of another border")
    return working


def _check_seams(path: str | Path, working: Working) -> None:
    """Refuse a mesh with two borders that run closely beside each other, as along a seam that is not sewn."""
    vertices, loops = working.vertices, boundary_loops(working.faces)
    for number, loop in enumerate(loops):
        others = np.concatenate([other for k, other in enumerate(loops) if k != number] or [loop[:0]])
        if not len(others):
            continue
        apart = cKDTree(vertices[others]).query(vertices[loop])[0]
        beside = apart < BESIDE
        if beside.mean() > LEAST_BESIDE:
            place, widest = np.round(vertices[loop][beside][0], 2), 1e3 * apart[beside].max()
            raise ValueError(
                f"{path}: two borders run {1e3 * np.median(apart[beside]):.1f} mm beside each other, as at {place} m: "
                f"a seam that is not sewn? --sew {np.ceil(widest):.0f} sews it, --allow leaves it open"
            )


def _split_at_borders(vertices: np.ndarray, faces: np.ndarray, distance: float) -> tuple[np.ndarray, int]:
    """Split border edges at the border vertices that lie on them; return faces and the number of splits."""
    splits = 0
    for _ in range(20):
        edges, _, count = edge_table(faces)
        open_edges = edges[count == 1]
        border = np.unique(open_edges)
        tree = cKDTree(vertices[border])
        changed = {}
        for a, b in open_edges.tolist():
            along = vertices[b] - vertices[a]
            length = np.linalg.norm(along)
            middle = 0.5 * (vertices[a] + vertices[b])
            for v in border[tree.query_ball_point(middle, 0.5 * length)].tolist():
                share = (vertices[v] - vertices[a]) @ along / max(length, 1e-12) ** 2
                off = np.linalg.norm(vertices[v] - vertices[a] - share * along)
                if v not in (a, b) and distance < share * length < length - distance and off < distance:
                    changed[a, b] = v
                    break
        if not changed:
            break
        result = []
        for face in faces.tolist():
            for k in range(3):
                a, b, c = face[k], face[(k + 1) % 3], face[(k + 2) % 3]
                v = changed.get((min(a, b), max(a, b)))
                if v is not None and v != c:
                    result += [[a, v, c], [v, b, c]]
                    splits += 1
                    break
            else:
                result.append(face)
        faces = np.array(result)
    return faces, splits


def _pin_highest_opening(path: str | Path, working: Working) -> Working:
    """Pin the highest boundary loop; refuse one that also runs far down, as along an open front."""
    vertices = working.vertices
    if not boundary_loops(working.faces):
        raise ValueError(f"{path}: closed, it has no opening to pin: use --pin none, red or object:NAME")
    pinned = np.zeros(len(vertices), bool)
    pinned[max(boundary_loops(working.faces), key=lambda loop: vertices[loop, 1].max())] = True
    heights, whole = vertices[pinned, 1], np.ptp(vertices[:, 1])
    if np.ptp(heights) > MOST_OF_HEIGHT * whole:
        raise ValueError(
            f"{path}: its highest border runs from {heights.max():.2f} down to {heights.min():.2f} m, as of an open "
            "front or a seam that is not sewn: pin it above a height, as with --pin "
            f"above:{heights.max() - 0.1 * whole:.2f}, paint it red (--pin red), or sew the seam (--sew MM)"
        )
    return working._replace(pinned=pinned)


def _pin_above(path: str | Path, working: Working, text: str) -> Working:
    """Pin the vertices of borders above a height in m."""
    try:
        height = float(text)
    except ValueError:
        raise ValueError(f"--pin above:{text}: give a height in m, such as above:0.45") from None
    vertices = working.vertices
    pinned = boundary_mask(working.faces, len(vertices)) & (vertices[:, 1] > height)
    if not pinned.any():
        raise ValueError(f"{path}: no border is above {height} m; the highest is at {vertices[:, 1].max():.2f} m")
    return working._replace(pinned=pinned)


def _log_counts(working: Working) -> Working:
    """Log the number of vertices, faces, parts, openings and pins."""
    vertices, faces, pinned = working.vertices, working.faces, working.pinned
    parts = 1 + int(components(len(vertices), faces).max())
    return working.logged(
        f"{len(vertices)} vertices, {len(faces)} faces, {parts} part{'s' * (parts > 1)}, "
        f"{len(boundary_loops(faces))} openings, {int(pinned.sum())} vertices pinned"
    )


def _uncovered_arms(points: np.ndarray, body: Body, names: tuple[str, ...]) -> np.ndarray:
    """Return the body's vertices [B] bool of forearms and hands, none if the garment covers those.

    A skirt must not follow the hands beside it.
    """
    arms = limbs(body, names, FOREARM)
    distance, nearest = cKDTree(body.vertices).query(points)
    covered = (arms[nearest] & (distance < LOOSE_DISTANCE)).mean() > 0.01
    return arms & ~covered


def draw(path: str | Path, garment: Garment, body: Body) -> None:
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
    views = ("front", "three-quarter", "side", "back")
    try:
        size = np.ptp(garment.vertices, axis=0)
        margin = 1.2 * max(1.0, 4 / 3 * size[[0, 2]].max() / size[1])
        pictures = [ray_cast.render(surfaces, ray_cast.camera_for(garment.vertices, view, margin)) for view in views]
        ray_cast.comparison(path, {"": pictures}, views)
    except ImportError as error:
        print(f"{path}: not drawn ({error})")
