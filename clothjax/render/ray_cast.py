"""Vertices over time as pictures and animations: ray-cast on the CPU, no graphics driver needed. NumPy only."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

SKIN, CLOTH, FLOOR, SKY = (0.86, 0.70, 0.60), (0.23, 0.42, 0.72), (0.93, 0.93, 0.92), (0.97, 0.975, 0.98)
KEY_LIGHT = np.array([0.42, 0.6, 0.71])  # low and from the side, so that folds show; the camera looks from +z
FILL_LIGHT = np.array([-0.86, 0.25, 0.02])
OPENING = 48  # rays that tell how much of the sky a vertex sees
NEAR = 0.2  # m, farther surfaces leave the sky open
CELL = 0.025  # m, side of a check


class Surface(NamedTuple):
    """A triangle mesh at one moment."""

    vertices: np.ndarray  # [N, 3] m
    faces: np.ndarray  # [F, 3]
    colour: tuple[float, float, float] = CLOTH
    checked: np.ndarray | None = None  # [N, 3] m, places of the vertices in the cloth at rest: a check is drawn on it


class Camera(NamedTuple):
    """Position and field of view of a camera."""

    eye: np.ndarray  # [3] m
    target: np.ndarray  # [3] m
    height: float  # m, the height that is visible at the target


def camera_for(
    vertices: np.ndarray, view: str = "three-quarter", margin: float = 1.12, aspect: float = np.inf
) -> Camera:
    """Return a camera that sees vertices [..., 3] m, from `front`, `back`, `side` or `three-quarter`.

    Args:
        margin: how much more than their height it sees.
        aspect: width of the picture over its height, if it must hold all of their width too.

    Raises:
        ValueError: for another view.
    """
    angles = {"front": 0.0, "three-quarter": 0.6, "side": np.pi / 2, "back": np.pi}
    if view not in angles:
        raise ValueError(f"view {view!r} is not one of {sorted(angles)}")
    points = np.asarray(vertices, np.float64).reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    target = 0.5 * (low + high)
    width = np.ptp(points @ np.array([np.cos(angles[view]), 0.0, -np.sin(angles[view])]))
    height = margin * max(high[1] - low[1], width / aspect)
    away = np.array([np.sin(angles[view]), 0.12, np.cos(angles[view])])
    return Camera(target + 4.0 * height * away / np.linalg.norm(away), target, height)


def render(
    surfaces: Sequence[Surface],
    camera: Camera,
    size: tuple[int, int] = (360, 480),
    *,
    floor: float | None = None,
    samples: int = 2,
) -> np.ndarray:
    """Render a lit picture [h, w, 3] uint8 of surfaces, smooth-shaded, with shadows and ambient occlusion.

    Visibility is by ray casting, so skin shows through cloth only where it really penetrates. Both sides are seen.

    Args:
        size: width and height in pixels.
        floor: height in m of a floor to stand on, if any.
        samples: per pixel side.

    Raises:
        ImportError: if embreex is not installed (`pip install clothjax[render]`).
    """
    scene_type, mesh_type = _embree()
    scene = scene_type()
    places, normals = [], []
    for surface in surfaces:
        places.append(np.ascontiguousarray(surface.vertices, np.float32))
        mesh_type(scene, places[-1], np.ascontiguousarray(surface.faces, np.int32))
        normals.append(vertex_normals(places[-1], surface.faces))
    width, height = size[0] * samples, size[1] * samples
    origins, directions = _rays(camera, width, height)
    hit = scene.run(origins, directions, query="INTERSECT", output=1)
    colour = np.tile(np.asarray(SKY, np.float32), (len(origins), 1))
    struck = hit["primID"] >= 0
    points = np.zeros_like(origins)
    normal = np.zeros_like(origins)
    base = np.zeros_like(origins)
    opening = np.ones((len(origins), 2), np.float32)
    for index, surface in enumerate(surfaces):
        chosen = np.flatnonzero(struck & (hit["geomID"] == index))
        corners = np.asarray(surface.faces)[hit["primID"][chosen]]
        u, v = hit["u"][chosen], hit["v"][chosen]
        weights = np.stack([1 - u - v, u, v], axis=1)
        seen = np.unique(corners)
        openings = np.ones((len(places[index]), 2), np.float32)  # of the front and of the back of each vertex
        for column, side in enumerate((1, -1)):
            openings[seen, column] = _open(scene, places[index][seen], side * normals[index][seen])
        for found, values in ((points, places[index]), (normal, normals[index]), (opening, openings)):
            found[chosen] = np.einsum("nk,nkc->nc", weights, values[corners])
        base[chosen] = surface.colour
        if surface.checked is not None:
            base[chosen[_dark(np.asarray(surface.checked)[corners], weights)]] *= 0.8
    # the inside of cloth is a little darker
    behind = np.sum(normal * directions, axis=1) > 0
    base[behind & struck] *= 0.75
    normal[behind] *= -1
    opening = np.where(behind, opening[:, 1], opening[:, 0])
    if floor is not None:
        distance = (floor - origins[:, 1]) / np.where(directions[:, 1] < -1e-6, directions[:, 1], -1e-6)
        on_floor = ~struck & (directions[:, 1] < -1e-6) & (distance > 0)
        points[on_floor] = origins[on_floor] + distance[on_floor, None] * directions[on_floor]
        normal[on_floor], base[on_floor] = (0, 1, 0), FLOOR
    else:
        on_floor = np.zeros(len(origins), bool)
    lit = np.flatnonzero(struck | on_floor)
    shade = _shade(scene, camera, points[lit], normal[lit], base[lit], opening[lit])
    if on_floor.any():
        # the floor fades into the sky away from its subject
        spread = np.linalg.norm(points[lit][:, [0, 2]] - camera.target[[0, 2]], axis=1)
        fade = np.clip(spread / (2.2 * camera.height), 0, 1)[:, None] * on_floor[lit][:, None]
        shade = shade * (1 - fade) + np.asarray(SKY) * fade
    colour[lit] = shade
    picture = colour.reshape(size[1], samples, size[0], samples, 3).mean(axis=(1, 3))
    return (255 * np.clip(picture, 0, 1) ** (1 / 1.15) + 0.5).astype(np.uint8)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return area-weighted unit normals [N, 3] of vertices [N, 3] m."""
    corners = np.asarray(vertices)[np.asarray(faces)]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = np.zeros((len(vertices), 3), np.float32)
    for k in range(3):
        np.add.at(summed, np.asarray(faces)[:, k], face)
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-20)


def comparison(path: str | Path | BinaryIO, rows: dict[str, Sequence[np.ndarray]], columns: Sequence[str]) -> None:
    """Write a labelled grid of pictures of one size as a PNG: one row a method, one column a moment."""
    image, draw, font = _pillow("Image", "ImageDraw", "ImageFont")
    height, width = next(iter(rows.values()))[0].shape[:2]
    letters = font.load_default(20)
    left, top = 24 + round(max(letters.getlength(label) for label in rows)), 40
    sheet = image.new("RGB", (left + width * len(columns), top + height * len(rows)), "white")
    pen = draw.Draw(sheet)
    for c, label in enumerate(columns):
        pen.text((left + width * (c + 0.5), top / 2), label, fill="black", font=letters, anchor="mm")
    for r, (label, pictures) in enumerate(rows.items()):
        pen.text((left - 12, top + height * (r + 0.5)), label, fill="black", font=letters, anchor="rm")
        for c, picture in enumerate(pictures):
            sheet.paste(image.fromarray(picture), (left + width * c, top + height * r))
    sheet.save(path, format="png")


def beside(pictures: dict[str, np.ndarray]) -> np.ndarray:
    """Return pictures [h, w, 3] uint8 of one height side by side, each with its name in the corner."""
    image, draw, font = _pillow("Image", "ImageDraw", "ImageFont")
    sheet = image.fromarray(np.concatenate(list(pictures.values()), axis=1))
    pen, letters, left = draw.Draw(sheet), font.load_default(20), 0
    for name, picture in pictures.items():
        pen.text((left + 12, 12), name, fill="black", font=letters)
        left += picture.shape[1]
    return np.asarray(sheet)


def webp(path: str | Path, frames: Sequence[np.ndarray], fps: float, quality: int = 82) -> None:
    """Write an animated WebP of pictures [h, w, 3] uint8 that repeats endlessly."""
    (image,) = _pillow("Image")
    pictures = [image.fromarray(frame) for frame in frames]
    pictures[0].save(
        path,
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 / fps),
        loop=0,
        quality=quality,
        method=4,
    )


def mp4(path: str | Path, frames: Sequence[np.ndarray], fps: float, quality: int = 18) -> None:
    """Write a film (H.264) of pictures [h, w, 3] uint8 of even size.

    Args:
        quality: the encoder's constant rate factor: 0 is lossless, 18 looks lossless, 51 is the worst.

    Raises:
        ImportError: if PyAV is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise ImportError("films need PyAV: pip install clothjax[render]") from error
    height, width = frames[0].shape[:2]
    with av.open(str(path), "w") as film:
        stream = film.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": str(quality)}
        for frame in frames:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        film.mux(stream.encode())


def _dark(corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return which places, by weights [N, 3] of the corners [N, 3, 3] m of triangles, are in a dark field of a check.

    The check lies in the plane of two axes that a triangle faces most.
    """
    normals = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    fields = np.floor(np.einsum("nk,nkc->nc", weights, corners) / CELL)
    fields[np.arange(len(fields)), normals.argmax(axis=1)] = 0.0
    return fields.sum(axis=1) % 2 == 0


def _open(scene, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the share [N] of the sky above the vertices [N, 3] m that no surface within `NEAR` hides."""
    # evenly spread about the normal, by the cosine: a spiral on the disk, raised to the sphere
    count = np.arange(OPENING) + 0.5
    radius, angle = np.sqrt(count / OPENING), count * np.pi * (3.0 - np.sqrt(5.0))
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=1)
    helper = np.where(np.abs(normals[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(helper, normals)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-20)
    axes = np.stack([side, np.cross(normals, side), normals], axis=1)  # [N, 3, 3]
    directions = np.einsum("ka,nac->nkc", local, axes).reshape(-1, 3).astype(np.float32)
    start = np.repeat(vertices + 2e-3 * normals, OPENING, axis=0).astype(np.float32)
    free = _unhidden(scene, start, directions, NEAR)
    return free.reshape(-1, OPENING).mean(axis=1).astype(np.float32)


def _unhidden(scene, start: np.ndarray, directions: np.ndarray, within: float = np.inf) -> np.ndarray:
    """Return which rays [N] hit nothing within a distance in m."""
    far = np.full(len(start), min(within, 1e30), np.float32)
    return np.asarray(scene.run(start, directions, far, query="OCCLUDED")) < 0


def _shade(
    scene, camera: Camera, points: np.ndarray, normal: np.ndarray, base: np.ndarray, opening: np.ndarray
) -> np.ndarray:
    """Return the colours of points under a key light with shadow, a fill light and light from the sky.

    The lights go around with the camera.

    Args:
        opening: [N], the share of the sky that each point sees.
    """
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    x, _, z = (camera.eye - camera.target) / max(float(np.linalg.norm((camera.eye - camera.target)[[0, 2]])), 1e-9)
    turn = np.array([[z, 0.0, x], [0.0, 1.0, 0.0], [-x, 0.0, z]])
    key, fill = (turn @ light / np.linalg.norm(light) for light in (KEY_LIGHT, FILL_LIGHT))
    toward = np.tile(key.astype(np.float32), (len(points), 1))
    start = (points + 4e-3 * normal).astype(np.float32)  # clear of the surface the point is on
    diffuse = np.clip(normal @ key, 0, None) * _unhidden(scene, start, toward)
    soft = 0.5 + 0.5 * np.clip(normal @ fill, -1, 1)
    sky = 0.5 + 0.5 * normal[:, 1]
    return base * (0.74 * diffuse + (0.2 * soft + 0.34 * sky) * opening)[:, None]


def _rays(camera: Camera, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    forward = camera.target - camera.eye
    distance = np.linalg.norm(forward)
    forward = forward / distance
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    scale = camera.height / height
    x = (np.arange(width) + 0.5 - width / 2) * scale
    y = (height / 2 - np.arange(height) - 0.5) * scale
    plane = distance * forward + y[:, None, None] * up + x[None, :, None] * right
    directions = plane.reshape(-1, 3)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.tile(camera.eye.astype(np.float32), (len(directions), 1)), directions.astype(np.float32)


def _embree():
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise ImportError("pictures need embreex: pip install clothjax[render]") from error
    return EmbreeScene, TriangleMesh


def _pillow(*names: str):
    try:
        import importlib

        return [importlib.import_module(f"PIL.{name}") for name in names]
    except ImportError as error:
        raise ImportError("pictures need Pillow: pip install clothjax[render]") from error
