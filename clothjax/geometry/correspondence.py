"""Where the vertices of one mesh lie on another: two meshes of one garment, the finer shown and the coarser felt."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.geometry.proximity import closest_on_triangle, nearest_face, patches
from clothjax.types import Array, Garment

APART = 0.03  # m, between two meshes of one garment; those of the library are up to 0.013 m apart


class OnMesh(NamedTuple):
    """The points of a mesh that are nearest to other points."""

    corners: Array  # [n, 3] int32, vertices of the nearest face, the one with the largest share first
    shares: Array  # [n, 3] barycentric coordinates

    def interpolated(self, values: Array) -> Array:
        """Return values [n, C] at the points, from those [V, C] at the vertices."""
        return jnp.sum(values[self.corners] * self.shares[:, :, None], axis=1)


def on_mesh(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> OnMesh:
    """Find the points of a mesh of `vertices` [V, 3] m and `faces` [F, 3] that are nearest to `points` [n, 3] m."""
    face = np.asarray(jax.jit(nearest_face)(points, vertices[faces], patches(vertices, faces).groups))
    shares = np.asarray(closest_on_triangle(points, vertices[faces[face]])[0])
    order = np.argsort(-shares, axis=1, kind="stable")
    return OnMesh(*(np.take_along_axis(rows, order, axis=1) for rows in (faces[face], shares)))


def on_each_other(felt: Garment, garment: Garment) -> tuple[OnMesh, OnMesh]:
    """Return where a garment that feels lies on the one that is shown, and that one on it, in the canonical pose.

    Pinned vertices have no shares in the other's displacement.

    Raises:
        ValueError: if a vertex of one is farther than `APART` from the other: they are not the same garment.
    """

    def on(one: Garment, other: Garment) -> OnMesh:
        found = on_mesh(*(np.asarray(x) for x in (one.vertices, other.vertices, other.faces)))
        nearest = np.asarray(found.interpolated(np.asarray(other.vertices)))
        farthest = np.linalg.norm(nearest - np.asarray(one.vertices), axis=1).max()
        if farthest > APART:
            raise ValueError(
                f"model.felt and the garment lie up to {1e3 * farthest:.0f} mm apart: give the same garment with fewer "
                f"vertices (at most {1e3 * APART:.0f} mm)"
            )
        return found._replace(shares=np.where(np.asarray(one.pinned)[:, None], 0.0, found.shares))

    return on(felt, garment), on(garment, felt)


def rigged_like(felt: Garment, garment: Garment) -> Garment:
    """Return a garment that feels, skinned and shaped as the one that is shown is where it lies on it.

    Skinning that was diffused onto each apart would hold two meshes of a loose garment millimetres from each other, and
    stretch a waist that is pinned: pinned vertices take the other one's too.
    """
    on_garment = on_mesh(*(np.asarray(x) for x in (felt.vertices, garment.vertices, garment.faces)))
    directions = np.asarray(garment.shapedirs)
    weights = np.asarray(on_garment.interpolated(np.asarray(garment.weights)))
    shapes = np.asarray(on_garment.interpolated(directions.reshape(len(directions), -1)))
    return felt._replace(weights=weights, shapedirs=shapes.reshape(-1, *directions.shape[1:]))
