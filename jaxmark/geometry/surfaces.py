"""Surfaces of meshes: closest points and samples on the host, and moments, also of traced arrays.

Closest points come from libigl, which agrees with brute force at any scale of coordinates; trimesh does not.
"""

from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64

from jaxmark.errors import JaxmarkError, require
from jaxmark.geometry.mesh import Mesh, area, boundary_vertices, unit, used_vertices, vertex_normals
from jaxmark.geometry.pose import IDENTITY, Points, Pose

Corners = Float[Array | np.ndarray, "faces 3 3"]  # of each face, in order


class Samples(NamedTuple):
    """Points sampled from a surface."""

    points: Points
    normals: Points  # at the points, unit length
    area: float  # the surface's area, in the mesh's units squared


@runtime_checkable
class Geometry(Protocol):
    """A shape for registration: the surface of a mesh, or the points of a cloud."""

    def anchors(self) -> tuple[Points, Points]:
        """Return the points of the shape itself, and unit normals there."""
        ...

    def closest(self, points: Points, pose: Pose = IDENTITY) -> tuple[Points, Int64[np.ndarray, " points"]]:
        """Return the closest places on the shape, placed by a pose, and the face or point of each."""
        ...

    def sample(self, count: int) -> Samples:
        """Return the points all over the shape, in random order and the same at every call."""
        ...


class Surface:
    """A mesh that finds its closest points by a search tree, which is built at the first query."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self._arrays = np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.int64)

    @cached_property
    def _tree(self) -> Any:
        tree = require("igl", "align").AABB()
        tree.init(*self._arrays)
        return tree

    def closest(self, points: Points, pose: Pose = IDENTITY) -> tuple[Points, Int64[np.ndarray, " points"]]:
        """Find the closest points `[P, 3]` on the surface, placed by a pose, and the index of a face for each.

        The pose is a similarity, or nearly one.

        Raises:
            JaxmarkError: if libigl is missing.
        """
        queries = np.ascontiguousarray(pose.inverse()(points))
        _, face, closest = self._tree.squared_distance(*self._arrays, queries)
        return pose(np.asarray(closest).reshape(-1, 3)), np.asarray(face).ravel().astype(np.int64)

    def anchors(self) -> tuple[Points, Points]:
        """Return the vertices that faces use, and unit normals there."""
        used = used_vertices(self.mesh)
        return np.asarray(self.mesh.vertices)[used], vertex_normals(self.mesh)[used]

    def sample(self, count: int) -> Samples:
        """Sample points; see `sample`."""
        return sample(self.mesh, count)


def sample(mesh: Mesh, count: int) -> Samples:
    """Sample points from a surface uniformly by area, with normals interpolated from those of the vertices.

    The sample is the same at every call.

    Raises:
        JaxmarkError: if the surface has no area.
    """
    import trimesh  # it takes long to import, and most suspects need no samples

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
    """Return a mask of the closest points on the rim of a hole, whose query points may lie beyond the rim."""
    rim = np.zeros(len(mesh.vertices), bool)
    rim[boundary_vertices(mesh.faces)] = True
    if not rim.any():
        return np.zeros(len(face), bool)
    inside = barycentric(mesh, face, closest) > 1e-6
    return np.all(~inside | rim[np.asarray(mesh.faces)[face]], axis=1) & ~np.all(inside, axis=1)


def barycentric(
    mesh: Mesh, face: Int64[np.ndarray, " points"], points: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "points 3"]:
    """Compute the barycentric coordinates of points on faces; zeros on a face without area."""
    from trimesh import triangles

    with np.errstate(all="ignore"):
        share = triangles.points_to_barycentric(np.asarray(mesh.vertices)[np.asarray(mesh.faces)[face]], points)
    return np.nan_to_num(share, nan=0.0, posinf=0.0, neginf=0.0)


class Moments(NamedTuple):
    """Mass, centre and covariance of a shape of density 1."""

    mass: Any  # area, or signed volume: positive where normals point outwards
    centre: Any  # `[3]`
    covariance: Any  # `[3, 3]`, about the centre, per mass


def surface_moments(corners: Corners) -> Moments:
    """Compute the moments of a surface."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (_cross(b - a, c - a) ** 2).sum(axis=1) ** 0.5 / 2
    return _moments(area, area.sum(), (a, b, c), (3, 12))


def volume_moments(corners: Corners) -> Moments:
    """Compute the moments of the volume that a closed surface encloses, as sums over tetrahedra to the origin.

    The mass is not positive if normals point inwards; centre and covariance do not depend on that.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    volume = (a * _cross(b, c)).sum(axis=1) / 6
    return _moments(volume, volume.sum(), (a, b, c), (4, 20))


def _moments(weight: Any, mass: Any, corners: tuple[Any, Any, Any], over: tuple[int, int]) -> Moments:
    """Compute the moments of simplices: with the sum s of n corners p, they are s/n and (ssᵀ + Σ ppᵀ)/(n(n + 1))."""
    total = corners[0] + corners[1] + corners[2]
    centre = weight @ total / over[0] / mass
    square = sum((part.T * weight) @ part for part in (total, *corners)) / over[1] / mass
    return Moments(mass, centre, square - centre[:, None] * centre)


def _cross(x: Any, y: Any) -> Any:
    """Compute the cross products of rows of NumPy or traced arrays."""
    return x[:, [1, 2, 0]] * y[:, [2, 0, 1]] - x[:, [2, 0, 1]] * y[:, [1, 2, 0]]
