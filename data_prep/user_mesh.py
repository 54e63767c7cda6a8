"""A garment from a mesh that was modelled around a body: checked, welded, put into metres, pushed out of the body.

Repairs that have one right answer are made and logged. A mesh that would need a guess is refused, and the message
names the option that answers it.
"""

from pathlib import Path
from typing import NamedTuple

import igl
import numpy as np
from scipy.spatial import cKDTree

from clothjax.geometry.topology import boundary_loops, boundary_mask, components
from clothjax.types import Body, Garment
from data_prep import marks, mesh_file
from data_prep.dressing import WINDING, dress, limbs, push_out
from data_prep.layers import THICKEST, inside, looks_away, outer_side, sides
from data_prep.mesh import compact, edge_table
from data_prep.mesh_file import Mesh
from data_prep.placement import Placement, Surface, better_place, check_draped, check_objects, check_place, worn
from data_prep.remesh import resample
from data_prep.seams import WELD_DISTANCE, check_seams, seams, sewn

FAR = 0.12  # m, from the body in the middle, above which it is asked whether a garment is worn there
LOOSE_DISTANCE = 0.03  # m; a garment with a larger median distance to the body counts as loose
DEEP, MAX_DEEP_SHARE = 0.03, 0.15  # m inside the body; a larger share of such vertices means another body
MIN_VERTICES, MAX_VERTICES = 100, 20_000
LEAST_PIECE = 10  # faces of a piece of cloth in the mean; smaller ones are faces that a file holds one by one
DIFFUSION_SAMPLES = 500  # for each vertex of a loose garment
FAR_PUSH, FARTHEST_PUSH = 0.01, 0.03  # m, by which a garment that is worn is pushed out of the body, and at most


class Answers(NamedTuple):
    """Answers that only the user knows."""

    placement: Placement = Placement()
    pin: str = "none"  # none, highest, above:HEIGHT, red, or object:NAME
    vertices: int | None = None  # wanted; None: the mesh as it is
    loose: bool | None = None  # None: by its distance to the body
    flip: bool = False  # the side that faces the body is the outside
    seed: int = 0
    cloth: tuple[str, ...] = ()  # WHAT=DENSITY,STRETCHING,BENDING with WHAT red or object:NAME
    objects: tuple[str, ...] = ()  # of the file, that are the garment; none for all
    sew: float = 0.1  # mm, between borders that are one seam
    allow: bool = False  # take a mesh that is pushed far, has open seams, or has layers close to each other
    outer: bool = False  # leave out what lies inside: the inner side of one with thickness, linings


class Working(NamedTuple):
    """The garment between two steps of `bring`."""

    vertices: np.ndarray  # [V, 3] m, +Y up
    faces: np.ndarray  # [F, 3]
    pinned: np.ndarray  # [V] bool
    cloth: np.ndarray | None = None  # [V, 3] factors of density, stretching and bending
    log: tuple[str, ...] = ()  # a line for each change

    def logged(self, *lines: str) -> "Working":
        """Return the same garment with more lines in its log."""
        return self._replace(log=(*self.log, *lines))


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
    check_draped(path, mesh, answers.allow)
    check_place(path, mesh, body, surface, answers.placement)
    placed = answers.placement(mesh.vertices)
    check_objects(path, mesh, placed, surface)
    working, index = _clean(path, placed, mesh.faces)
    working = working.logged(*mesh.notes)
    working, index = _layers(path, working, index, surface, answers)
    working, index = _sew(path, working, index, answers)
    _check_open(path, working, answers.allow)
    working = _log_seams(working, placed, mesh.faces[(index[mesh.faces] >= 0).all(axis=1)], answers.sew)
    at_place = marks.is_place(answers.pin)
    if not at_place:
        members = index[marks.marked(path, mesh, answers.pin, "--pin")]
        pinned = np.isin(np.arange(len(working.vertices)), members)
        if not pinned.any() or pinned.all():
            some = "all" if pinned.all() else "none"
            raise ValueError(f"{path}: --pin {answers.pin} pins {some} of the garment's {len(pinned)} vertices")
        working = working._replace(pinned=pinned)
    if answers.cloth:
        cloth, lines = marks.cloth(path, mesh, index, len(working.vertices), answers.cloth)
        working = working._replace(cloth=cloth).logged(*lines)
    working = _orient(path, working, surface, answers.flip)
    if answers.vertices:
        working = _resample(working, answers.vertices)
    if not MIN_VERTICES <= len(working.vertices) <= MAX_VERTICES:
        raise ValueError(
            f"{path}: {len(working.vertices)} vertices; {MIN_VERTICES} to {MAX_VERTICES} can be trained: "
            "give --vertices for another number"
        )
    working = _push_out(path, working, surface, mesh.vertices, answers)
    working = working.logged(worn(working.vertices, working.faces, body))
    distance = float(np.median(np.abs(igl.signed_distance(working.vertices, *surface, sign_type=WINDING)[0])))
    loose = distance > LOOSE_DISTANCE if answers.loose is None else answers.loose
    doubt = ": is it worn elsewhere?" if distance > FAR else ""
    working = working.logged(
        f"{'loose' if loose else 'tight'}: {1e3 * distance:.0f} mm from the body in the middle, so skin and "
        f"shape are those of the body {'around' if loose else 'nearest to'} each vertex{doubt}"
    )
    if at_place:
        pinned = marks.pinned_at(path, working.vertices, working.faces, answers.pin)
        working = working._replace(pinned=pinned)
    working = _log_counts(working)
    vertices, faces, pinned, cloth, log = working
    hidden = _uncovered_arms(vertices, body, names)
    samples = DIFFUSION_SAMPLES if loose else 0
    return dress(vertices, faces, body, hidden, pinned, samples, answers.seed)._replace(cloth=cloth), log


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
    own = {name: which[used] for name, which in mesh.objects.items()}
    return mesh._replace(vertices=vertices, faces=faces, red=mesh.red[used], objects=own)


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
    _check_sides(path, points, faces)
    return Working(points, faces, np.zeros(len(points), bool), log=tuple(log)), index[welded]


def _check_sides(path: str | Path, points: np.ndarray, faces: np.ndarray) -> None:
    """Refuse edges with more than two faces."""
    edges, _, face_count = edge_table(faces)
    crowded = np.flatnonzero(face_count > 2)
    if len(crowded):
        middle = np.round(points[edges[crowded[0]]].mean(axis=0), 3)
        raise ValueError(
            f"{path}: {len(crowded)} edges have more than two faces, the first at {middle} m: a cloth has two sides; "
            "separate the layers there, delete the inner faces, or --sew less"
        )


def _layers(
    path: str | Path, working: Working, index: np.ndarray, surface: Surface, answers: Answers
) -> tuple[Working, np.ndarray]:
    """Leave out what lies inside, or refuse it if it is close; return the garment and where the file's vertices are."""
    points, faces = working.vertices, working.faces
    kept, ways = np.ones(len(faces), bool), "--outer keeps what is outermost"
    two = sides(points, faces)
    if two.thick.any():
        place = np.round(points[faces[two.opposite >= 0][0]].mean(axis=0), 2)
        said = f"it has thickness: its two sides are {1e3 * two.apart:.1f} mm apart, as at {place} m"
        if answers.outer:
            kept = outer_side(path, points, two, surface)
            share = 100 * igl.doublearea(points, faces[kept]).sum() / igl.doublearea(points, faces).sum()
            said = (
                f"left out: {int((~kept).sum())} faces of an inner side {1e3 * two.apart:.1f} mm from the outer one, "
                f"and of strips between them; {share:.0f} % of the area remains"
            )
        elif not answers.allow:
            raise ValueError(f"{path}: {said}, but a cloth is one sheet: {ways}, --allow takes it as it is")
        working = working.logged(said)
    within, apart = inside(points, faces[kept], surface)
    if within.any():
        place = np.round(points[faces[kept][within][0]].mean(axis=0), 2)
        said = f"a layer lies {1e3 * apart:.1f} mm inside another, as at {place} m"
        if answers.outer:
            kept[kept] = ~within
            said = f"left out: {int(within.sum())} faces of layers {1e3 * apart:.1f} mm inside others"
        elif apart < THICKEST and not answers.allow:
            raise ValueError(f"{path}: {said}: a lining? {ways}, --allow takes all of its layers")
        working = working.logged(said if answers.outer else f"{said}: {ways}")
    if answers.outer and kept.all():
        working = working.logged("it is a single layer: --outer leaves nothing out")
    used = np.unique(faces[kept])
    points, faces = compact(points, faces[kept])
    place_of = np.full(len(working.vertices) + 1, -1)
    place_of[used] = np.arange(len(used))
    return working._replace(vertices=points, faces=faces, pinned=np.zeros(len(points), bool)), place_of[index]


def _sew(path: str | Path, working: Working, index: np.ndarray, answers: Answers) -> tuple[Working, np.ndarray]:
    """Sew seams, and refuse one that stays open; return the garment, and the indices of the file's vertices in it."""
    vertices, faces, joined, splits = sewn(working.vertices, working.faces, 1e-3 * answers.sew)
    count = len(working.vertices) - len(vertices)
    working = working._replace(vertices=vertices, faces=faces, pinned=np.zeros(len(vertices), bool))
    _check_sides(path, vertices, faces)
    working = working.logged(*check_seams(path, vertices, faces, 1e-3 * answers.sew, answers.allow))
    if count:
        working = working.logged(f"sewn: {count} vertices of borders lay within {answers.sew:g} mm of others")
    if splits:
        working = working.logged(f"sewn: {splits} vertices lay on edges of another border")
    return working, np.where(index < 0, -1, joined[index])


def _check_open(path: str | Path, working: Working, allow: bool) -> None:
    """Refuse a part without any border: cloth has one, something with thickness has none."""
    vertices, faces = working.vertices, working.faces
    part = components(len(vertices), faces)
    closed = np.setdiff1d(part, part[boundary_mask(faces, len(vertices))])
    if len(closed) and not allow:
        place = np.round(vertices[part == closed[0]].mean(axis=0), 2)
        raise ValueError(
            f"{path}: the part around {place} m is closed, with no opening, as something thick is: leave it out "
            "(--object), or delete its inner side; --allow takes it as cloth"
        )


def _log_seams(working: Working, points: np.ndarray, torn: np.ndarray, sew: float) -> Working:
    """Log how many pieces of the file, of vertices [V, 3] m and faces [F, 3], are joined along how many seams."""
    pieces, count = seams((points, torn), working.vertices, working.faces, 1e-3 * sew)
    if not count or len(torn) < LEAST_PIECE * pieces:
        return working
    return working.logged(f"sewn: {pieces} piece{'s' * (pieces > 1)} along {count} seam{'s' * (count > 1)}")


def _orient(path: str | Path, working: Working, surface: Surface, flip: bool) -> Working:
    """Turn the faces of each part one way, with the outside away from the body, or towards it for `flip`."""
    points, faces = working.vertices, working.faces
    turned, part = igl.bfs_orient(faces)
    half_edges, times = np.unique(turned[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=0, return_counts=True)
    if times.max() > 1:
        middle = np.round(points[half_edges[times.argmax()]].mean(axis=0), 3)
        raise ValueError(f"{path}: has only one side (a Moebius strip): cut it open, as along the edge at {middle} m")
    reverse = looks_away(points, turned, part, surface) == flip
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


def _push_out(path: str | Path, working: Working, surface: Surface, in_file: np.ndarray, answers: Answers) -> Working:
    """Push the garment, of vertices [V, 3] in its file, out of the body; refuse one that is deep inside or is stuck."""
    points, lost = working.vertices, "Move the mesh onto the body, or name its body with --body; "
    signed = igl.signed_distance(points, *surface, sign_type=WINDING)[0]
    deep_share, deepest = float((signed < -DEEP).mean()), np.round(points[signed.argmin()], 2)
    if deep_share > MAX_DEEP_SHARE and not answers.allow:
        raise ValueError(
            f"{path}: {100 * deep_share:.0f} % of its vertices are more than {1e3 * DEEP:.0f} mm inside the body, "
            f"at most {-1e3 * signed.min():.0f}, at {deepest} m: it was made for another body or another pose, or is "
            f"worn elsewhere. {better_place(in_file, surface, answers.placement) or lost}--allow takes it as it is"
        )
    cleared = push_out(points, working.faces, *surface)
    signed = igl.signed_distance(cleared, *surface, sign_type=WINDING)[0]
    if signed.min() < 0:
        place = np.round(points[signed.argmin()], 2)
        raise ValueError(
            f"{path}: {int((signed < 0).sum())} vertices cannot be pushed out of the body, the first at {place} m: "
            f"{better_place(in_file, surface, answers.placement)}move them out of it, or "
            "fit it to this body and its pose, if it was made for another"
        )
    moved = np.linalg.norm(cleared - points, axis=1)
    if moved.max() > FARTHEST_PUSH and not answers.allow:
        place = np.round(points[moved.argmax()], 2)
        raise ValueError(
            f"{path}: {int((moved > FARTHEST_PUSH).sum())} vertices would be pushed out of the body by more than "
            f"{1e3 * FARTHEST_PUSH:.0f} mm, the farthest by {1e3 * moved.max():.0f} mm, at {place} m: it is not worn "
            f"like that. {better_place(in_file, surface, answers.placement) or lost}--allow takes it as it is"
        )
    working = working._replace(vertices=cleared)
    if not moved.any():
        return working
    nearer = better_place(in_file, surface, answers.placement) if moved.max() > FAR_PUSH else ""
    return working.logged(
        f"pushed out of the body: {int((moved > 0).sum())} vertices, by {1e3 * moved.max():.0f} mm at the most",
        *([nearer.removesuffix("; ")] if nearer else []),
    )


def _log_counts(working: Working) -> Working:
    """Log the number of vertices, faces, parts, openings and pins."""
    vertices, faces, pinned = working.vertices, working.faces, working.pinned
    part = components(len(vertices), faces)
    parts, free = 1 + int(part.max()), 1 + int(part.max()) - len(np.unique(part[pinned]))
    working = working.logged(
        f"{len(vertices)} vertices, {len(faces)} faces, {parts} part{'s' * (parts > 1)}, "
        f"{len(boundary_loops(faces))} openings, {int(pinned.sum())} vertices pinned"
    )
    if not pinned.any() or not free:
        return working
    return working.logged(f"{free} of {parts} parts have no pinned vertex: nothing but the body holds them")


def _uncovered_arms(points: np.ndarray, body: Body, names: tuple[str, ...]) -> np.ndarray:
    """Return the body's vertices [B] bool of forearms and hands, none if the garment covers those.

    A skirt must not follow the hands beside it.
    """
    arms = limbs(body, names, "ForeArm")
    distance, nearest = cKDTree(body.vertices).query(points)
    covered = (arms[nearest] & (distance < LOOSE_DISTANCE)).mean() > 0.01
    return arms & ~covered
