"""Parts of a mesh that are pinned or of another cloth: marked by its file, openings, borders above a height."""

from pathlib import Path

import numpy as np

from clothjax.files.storage import FACTORS
from clothjax.geometry.topology import boundary_loops, boundary_mask
from data_prep.dressing import highest_opening
from data_prep.mesh_file import Mesh

MOST_OF_HEIGHT = 0.4  # of the garment's, that an opening to pin may take up


def is_place(pin: str) -> bool:
    """Return whether an answer to --pin is one of `pinned_at`, not a mark."""
    return pin in ("none", "highest") or pin.startswith("above:")


def marked(path: str | Path, mesh: Mesh, what: str, flag: str) -> np.ndarray:
    """Return which of a file's vertices [V] bool are marked there, by a colour or as an object.

    Raises:
        ValueError: naming the flag, if nothing is marked so.
    """
    if what == "red":
        if not mesh.red.any():
            raise ValueError(
                f"{path}: {flag} red, but no vertex is painted red (.ply, .obj and .glb keep colours of vertices)"
            )
        return mesh.red
    if what.startswith("object:"):
        name = what.removeprefix("object:")
        if name not in mesh.objects:
            raise ValueError(f"{path}: has no object {name!r} for {flag}; there are: {', '.join(mesh.objects)}")
        return mesh.objects[name]
    known = "none, highest, above:HEIGHT, red or object:NAME" if flag == "--pin" else "red=... or object:NAME=..."
    raise ValueError(f"{flag} {what}: choose {known}")


def pinned_at(path: str | Path, vertices: np.ndarray, faces: np.ndarray, place: str) -> np.ndarray:
    """Return the vertices [V] bool of a garment [V, 3] m that are pinned at a place, as of `is_place`.

    Raises:
        ValueError: if nothing is there, or it is no opening to pin.
    """
    if place == "none":
        return np.zeros(len(vertices), bool)
    if place == "highest":
        return _highest(path, vertices, faces)
    try:
        height = float(place.removeprefix("above:"))
    except ValueError:
        raise ValueError(f"--pin {place}: give a height in m, such as above:0.45") from None
    pinned = boundary_mask(faces, len(vertices)) & (vertices[:, 1] > height)
    if not pinned.any():
        raise ValueError(f"{path}: no border is above {height} m; the highest is at {vertices[:, 1].max():.2f} m")
    return pinned


def _highest(path: str | Path, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the highest opening; refuse one that also runs far down, as along an open front."""
    if not boundary_loops(faces):
        raise ValueError(f"{path}: closed, it has no opening to pin: use --pin none, red or object:NAME")
    pinned = highest_opening(vertices, faces)
    heights, whole = vertices[pinned, 1], np.ptp(vertices[:, 1])
    if np.ptp(heights) > MOST_OF_HEIGHT * whole:
        raise ValueError(
            f"{path}: its highest border runs from {heights.max():.2f} down to {heights.min():.2f} m, as of an open "
            "front or a seam that is not sewn: pin it above a height, as with --pin "
            f"above:{heights.max() - 0.1 * whole:.2f}, paint it red (--pin red), or sew the seam (--sew MM)"
        )
    return pinned


def cloth(
    path: str | Path, mesh: Mesh, index: np.ndarray, count: int, regions: tuple[str, ...]
) -> tuple[np.ndarray, list[str]]:
    """Return the cloth's factors [count, 3] in regions WHAT=DENSITY,STRETCHING,BENDING, and a line of log for each.

    A later region covers an earlier one.

    Args:
        path: of the file.
        mesh: as read.
        index: for each of its vertices [V] its index among the garment's `count` vertices, or -1.
        count: of the garment's vertices.
        regions: with WHAT as of `marked`.

    Raises:
        ValueError: naming the region that is wrong.
    """
    factors, log, (low, high) = np.ones((count, 3)), [], FACTORS
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
        members = np.setdiff1d(index[marked(path, mesh, what, "--cloth")], [-1])
        factors[members] = values
        log.append(
            f"{what}: {len(members)} vertices with {values[0]:g} times the weight, {values[1]:g} times the stiffness, "
            f"{values[2]:g} times that of bending"
        )
    return factors, log
