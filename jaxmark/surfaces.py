"""Surfaces of meshes: their closest points, and points spread over them; host side.

Closest points are libigl's, which agree with brute force at any scale of coordinates; trimesh's do not.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.mesh import Mesh, area, boundary_vertices, unit, vertex_normals
from jaxmark.pose import IDENTITY, Points, Pose


class Surface:
    """A mesh that answers where its closest points are; what that needs is built when it is first asked."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._arrays = np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.int64)

    @cached_property
    def _tree(self) -> Any:
        tree = require("igl", "align").AABB()
        tree.init(*self._arrays)
        return tree

    def closest(self, points: Points, pose: Pose = IDENTITY) -> tuple[Points, Int64[np.ndarray, " points"]]:
        """The closest points when the surface is in a pose (a similarity, or nearly), and on which faces they lie.

        Raises:
            JaxmarkError: if libigl is missing.
        """
        there = np.ascontiguousarray(pose.inverse()(points))
        _, face, closest = self._tree.squared_distance(*self._arrays, there)
        return pose(np.asarray(closest).reshape(-1, 3)), np.asarray(face).ravel().astype(np.int64)


class Samples(NamedTuple):
    """Points spread over a surface by area."""

    points: Points
    normals: Points
    area: float


def sample(mesh: Mesh, count: int) -> Samples:
    """Spread points over a surface, with normals between those of the vertices.

    Raises:
        JaxmarkError: if the surface has no area.
    """
    import trimesh  # takes long to import, and most suspects do without

    size = area(mesh)
    if not 0 < size < np.inf:
        raise JaxmarkError(f"A surface has an area of {size:g}; nothing can be aligned with it.")
    surface = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
    points, face = map(np.asarray, trimesh.sample.sample_surface(surface, count, seed=0)[:2])
    share = barycentric(mesh, face, points)
    normals = np.einsum("pk,pkc->pc", share, vertex_normals(mesh)[np.asarray(mesh.faces)[face]])
    return Samples(points, unit(normals), size)


def on_rim(
    mesh: Mesh, face: Int64[np.ndarray, " points"], closest: Float64[np.ndarray, "points 3"]
) -> Bool[np.ndarray, " points"]:
    """Which closest points lie on the rim of a hole: what they are closest to is beyond it."""
    rim = np.zeros(len(mesh.vertices), bool)
    rim[boundary_vertices(mesh.faces)] = True
    if not rim.any():
        return np.zeros(len(face), bool)
    inside = barycentric(mesh, face, closest) > 1e-6
    return np.all(~inside | rim[np.asarray(mesh.faces)[face]], axis=1) & ~np.all(inside, axis=1)


def barycentric(
    mesh: Mesh, face: Int64[np.ndarray, " points"], points: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "points 3"]:
    """Shares of a face's corners in points on it; zeros on a face without area."""
    from trimesh import triangles

    with np.errstate(all="ignore"):
        share = triangles.points_to_barycentric(np.asarray(mesh.vertices)[np.asarray(mesh.faces)[face]], points)
    return np.nan_to_num(share, nan=0.0, posinf=0.0, neginf=0.0)
