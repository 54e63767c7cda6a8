"""Meshes of polygons in OBJ, PLY and OFF files, with colours and, in OBJ, names of objects, groups and materials.

trimesh cuts every polygon into a fan from its first corner, which folds over where it is concave. It also takes a text
that was cut short as far as it goes.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from data_prep.recording import read_lines

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8",
}  # fmt: skip
LINE = 1e-6  # of a polygon's area, of a triangle that is a line
INDICES = ("vertex_indices", "vertex_index")  # of a face of a PLY file

Names = tuple[str, ...]


class Polygons(NamedTuple):
    """The polygons of a file, grouped by their names, none of these in most formats."""

    vertices: np.ndarray  # [V, 3] in the file's units
    colours: np.ndarray | None  # [V, 3], 0 to 255; NaN for a vertex without one
    groups: dict[Names, list[list[int]]]  # the corners of each polygon, from 0


def read(path: Path) -> Polygons:
    """Read an .obj, .ply or .off file.

    Raises:
        ValueError: naming the line, or what is missing.
    """
    polygons = {".obj": _obj, ".ply": _ply, ".off": _off}[path.suffix.lower()](path)
    count = len(polygons.vertices)
    for corner in (corner for group in polygons.groups.values() for polygon in group for corner in polygon):
        if not 0 <= corner < count:
            raise ValueError(f"a face names vertex {corner + 1} of {count}")
    return polygons


def triangles(vertices: np.ndarray, polygons: list[list[int]]) -> np.ndarray:
    """Cut polygons with corners among vertices [V, 3] into triangles [F, 3]: fans, and ears where fans fold over."""
    found = []
    for polygon in polygons:
        fan = [[polygon[0], b, c] for b, c in zip(polygon[1:], polygon[2:], strict=False)]
        found += fan if len(fan) < 2 or _even(vertices[fan]) else _ears(vertices, polygon)
    return np.array(found, np.int64).reshape(-1, 3)


def _even(corners: np.ndarray) -> bool:
    """Return whether triangles [F, 3, 3] all look the way of their sum, and none is a line."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    whole = normals.sum(axis=0)
    return bool((normals @ whole > LINE * (whole @ whole)).all())


def _ears(vertices: np.ndarray, polygon: list[int]) -> list[list[int]]:
    """Cut a polygon into triangles by clipping ears: convex corners that hold no other one, the roundest first."""
    points = vertices[polygon]
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)  # Newell's
    _, _, axes = np.linalg.svd(normal[None])
    flat = points @ axes[1:].T
    if np.cross(axes[1], axes[2]) @ normal < 0:
        flat = flat[:, ::-1]
    left, found = list(range(len(polygon))), []

    def side(a: int, b: int, c: int) -> float:
        (x, y), (u, v) = flat[b] - flat[a], flat[c] - flat[a]
        return x * v - y * u

    def roundness(k: int) -> float:
        a, b, c = left[k - 1], left[k], left[(k + 1) % len(left)]
        if any(min(side(a, b, d), side(b, c, d), side(c, a, d)) >= 0 for d in left if d not in (a, b, c)):
            return -np.inf
        return side(a, b, c) / max(float(((flat[[a, b, c]] - flat[[b, c, a]]) ** 2).sum()), 1e-30)

    while len(left) > 3:
        k = max(range(len(left)), key=roundness)
        found.append([polygon[left[k - 1]], polygon[left[k]], polygon[left[(k + 1) % len(left)]]])
        del left[k]
    return [*found, [polygon[k] for k in left]]


def _obj(path: Path) -> Polygons:
    """Read an OBJ file. Programs such as Maya and Marvelous Designer write parts as groups, others as objects."""
    vertices, colours, groups = [], [], {}
    counts, current = {"v": 0, "vt": 0, "vn": 0}, {"o": (), "g": (), "usemtl": ()}
    for number, words in _joined(_bare(path)):
        key, rest = words[0], words[1:]
        if key in counts:
            counts[key] += 1
        if key == "v":
            values = _numbers(number, rest)
            vertices.append(values[:3])
            colours.append(values[3:6] if len(values) >= 6 else [np.nan] * 3)
        elif key == "g":
            current["g"] = tuple(rest)  # a face may be in several groups
        elif key in current:
            current[key] = (" ".join(rest),)
        elif key == "f":
            names = (name for own in current.values() for name in own if name and name != "default")
            corners = [_corner(number, word, counts["v"]) for word in rest]
            groups.setdefault(tuple(dict.fromkeys(names)), []).append(corners)
    return Polygons(np.array(vertices).reshape(-1, 3), _to_255(np.array(colours).reshape(-1, 3)), groups)


def _to_255(colours: np.ndarray) -> np.ndarray:
    """Return colours [V, 3] from 0 to 255; those up to 1 were shares."""
    return colours * (255.0 if np.nanmax(colours, initial=0.0) <= 1.0 else 1.0)


def _bare(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield number and words of the lines of a text, without comments."""
    for number, words in read_lines(path):
        end = next((k for k, word in enumerate(words) if word.startswith("#")), len(words))
        if end:
            yield number, words[:end]


def _joined(lines: Iterable[tuple[int, list[str]]]) -> Iterator[tuple[int, list[str]]]:
    """Yield lines of words, those that a backslash ends with the next one."""
    before: list[str] = []
    for number, words in lines:
        words, goes_on = before + words, words[-1].endswith("\\")
        before = [word for word in (*words[:-1], words[-1][:-1]) if word] if goes_on else []
        if not goes_on:
            yield number, words


def _corner(number: int, word: str, count: int) -> int:
    """Return the vertex that a corner of a face names, which may count back from the last of `count` so far."""
    try:
        index = int(word.partition("/")[0])
    except ValueError:
        raise ValueError(f"line {number}: {word!r} names no vertex") from None
    if index == 0:
        raise ValueError(f"line {number}: a face names vertex 0, but OBJ counts from 1")
    return index - 1 if index > 0 else count + index


def _numbers(number: int, words: list[str]) -> list[float]:
    """Return the numbers of a vertex, three at least."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        comma = " with a point in place of the comma" * any("," in word for word in words)
        raise ValueError(f"line {number}: {' '.join(words)!r} should be numbers{comma}") from None
    if len(values) < 3:
        raise ValueError(f"line {number}: a vertex of {len(values)} numbers")
    return values


def _off(path: Path) -> Polygons:
    """Read an OFF file, also with normals or colours of its vertices."""
    rows = list(_bare(path))
    kind = ""
    if rows and "OFF" in rows[0][1][0].upper():
        number, words = rows[0]
        kind = words[0].upper().partition("OFF")[0]
        rows[:1] = [(number, words[1:])] if len(words) > 1 else []
    counts = rows[0][1] if rows else []
    if len(counts) < 2 or not all(word.isdigit() for word in counts):
        raise ValueError("it does not say how many vertices and faces it has, as a text does: export it as text")
    points, faces = (int(word) for word in counts[:2])
    rows = rows[1:]
    if len(rows) < points + faces:
        raise ValueError(f"it is cut short: {len(rows)} lines for {points} vertices and {faces} faces")
    values = [_numbers(*row) for row in rows[:points]]
    colours = None
    if "C" in kind:
        first = 6 if "N" in kind else 3
        colours = _to_255(np.array([own[first : first + 3] for own in values], np.float64).reshape(points, 3))
    polygons = []
    for number, words in rows[points : points + faces]:
        count = int(words[0]) if words[0].isdigit() else 0
        if not 0 < count < len(words):
            raise ValueError(f"line {number}: {' '.join(words)!r} is no face")
        polygons.append([int(word) for word in words[1 : count + 1]])
    return Polygons(np.array([own[:3] for own in values]).reshape(-1, 3), colours, {(): polygons})


class _Element(NamedTuple):
    """A sort of rows of a PLY file."""

    count: int
    scalars: dict[str, str]  # types by name, in the file's order; of a list, the type of its length ...
    lists: dict[str, str]  # ... and here of its entries


def _ply(path: Path) -> Polygons:
    """Read a PLY file, text or binary."""
    kind, elements, body = _ply_header(path.read_bytes())
    order, text, at = ">" if kind.endswith("big_endian") else "<", body.split() if kind == "ascii" else None, 0
    columns: dict[str, dict[str, list]] = {}
    for name, element in elements.items():
        rows = columns[name] = {own: [] for own in element.scalars}
        for number in range(element.count):
            for own, scalar in element.scalars.items():
                try:
                    if own in element.lists:
                        (count,), at = _taken(body, text, at, order + scalar, 1)
                        values, at = _taken(body, text, at, order + element.lists[own], int(count))
                        rows[own].append(values)
                    else:
                        (value,), at = _taken(body, text, at, order + scalar, 1)
                        rows[own].append(value)
                except EOFError:
                    raise ValueError(f"it is cut short: {name} {number} of {element.count}") from None
    vertex, face = columns.get("vertex", {}), columns.get("face", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise ValueError("its vertices have no x, y and z: export it again")
    vertices = np.stack([np.array(vertex[axis], np.float64) for axis in "xyz"], axis=1)
    corners = next((face[name] for name in INDICES if name in face), [])
    colours = None
    if {"red", "green", "blue"} <= vertex.keys():
        whole = elements["vertex"].scalars["red"][0] in "iu"
        colours = np.stack([np.array(vertex[name], np.float64) for name in ("red", "green", "blue")], axis=1)
        colours = colours if whole else _to_255(colours)
    return Polygons(vertices, colours, {(): [np.asarray(own).astype(int).tolist() for own in corners]})


def _ply_header(data: bytes) -> tuple[str, dict[str, _Element], bytes]:
    """Return the format of a PLY file, its elements by name, and what follows the header."""
    head, found, body = data.partition(b"end_header")
    if not found or not head.startswith(b"ply"):
        raise ValueError("no header of a PLY file")
    kind, elements = "", {}
    for words in (line.split() for line in head.decode("ascii", "replace").splitlines()):
        if words[:1] == ["format"]:
            kind = words[1]
        elif words[:1] == ["element"]:
            elements[words[1]] = _Element(int(words[2]), {}, {})
        elif words[:1] == ["property"]:
            element = list(elements.values())[-1]
            kinds = words[2:4] if words[1] == "list" else words[1:2]
            unknown = [kind for kind in kinds if kind not in PLY_TYPES]
            if unknown:
                raise ValueError(f"numbers of type {unknown[0]}, which PLY has not: export it again")
            element.scalars[words[-1]] = PLY_TYPES[kinds[0]]
            if words[1] == "list":
                element.lists[words[-1]] = PLY_TYPES[kinds[1]]
    if "tristrips" in elements:
        raise ValueError("strips of triangles: export it as triangles")
    if kind not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise ValueError(f"a PLY file of format {kind!r}")
    return kind, elements, body.partition(b"\n")[2]


def _taken(data: bytes, text: list[bytes] | None, at: int, dtype: str, count: int) -> tuple[Any, int]:
    """Return the next numbers of a PLY file, of its words or else of its bytes, and where they end.

    Raises:
        EOFError: if they are not there.
    """
    if text is not None:
        if len(text) < at + count:
            raise EOFError
        return [float(word) for word in text[at : at + count]], at + count
    size = count * np.dtype(dtype).itemsize
    if count < 0 or len(data) < at + size:
        raise EOFError
    return np.frombuffer(data, dtype, count, at), at + size
