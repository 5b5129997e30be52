"""Point clouds as surfaces: planes through nearest points, evenly spaced points, and closest points.

Results depend neither on the order of points nor on how densely a scanner covers each region.
"""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from jaxmark.geometry.mesh import unit
from jaxmark.geometry.pose import IDENTITY, Points, Pose
from jaxmark.geometry.surfaces import Samples

_PLANE_POINTS = 12  # nearest points that a plane is fitted to
_SIDE_POINTS = 80  # number of nearest samples whose mean is assumed to be inside, to orient normals outwards
_BLOCK = 2**16  # points whose planes are fitted at a time
_COUNTED_POINTS = 200_000  # random points by which the size of cells is chosen
_ANCHORS = 20_000  # points that are enough to find a pose by
_STRAY_POINTS, _STRAY_RATIO = 8, 3.0  # stray points: mean distance to 8 nearest points above 3 times the median one
_REACH = 2.0  # radius of a point's plane, in spacings; beyond it, the closest place is the point itself


class Planes(NamedTuple):
    """Planes through the nearest of some points, one for each place."""

    centres: Float64[np.ndarray, "places 3"]  # means of the nearest points
    normals: Float64[np.ndarray, "places 3"]  # unit vectors, of either side
    reach: Float64[np.ndarray, " places"]  # distance of the nearest point from the place


def spacings(points: Points, neighbours: int = 1) -> Float64[np.ndarray, " points"]:
    """Compute the mean distance of each point to the nearest others; 0 for a point alone."""
    count = min(neighbours, len(points) - 1)
    if count < 1:
        return np.zeros(len(points))
    return np.asarray(KDTree(points).query(points, count + 1)[0])[:, 1:].mean(axis=1)


def planes(tree: KDTree, places: Points, neighbours: int = _PLANE_POINTS) -> Planes:
    """Fit a plane to the points of a tree that are nearest to each place, by total least squares."""
    points, count = np.asarray(tree.data), min(neighbours, tree.n)
    parts = []
    for start in range(0, len(places), _BLOCK):
        found = tree.query(places[start : start + _BLOCK], count)
        distance, nearest = (np.asarray(part).reshape(-1, count) for part in found)
        around = points[nearest]
        centres = around.mean(axis=1)
        centred = around - centres[:, None]
        # The largest component of a normal is positive, so that equal points give equal normals.
        normals = np.linalg.eigh(centred.transpose(0, 2, 1) @ centred)[1][:, :, 0]
        largest = np.take_along_axis(normals, np.abs(normals).argmax(axis=1)[:, None], axis=1)
        parts.append((centres, normals * np.where(largest < 0, -1, 1), distance[:, 0]))
    return Planes(*(np.concatenate(part) for part in zip(*parts, strict=True)))


class Cloud:
    """A point cloud as a surface, with the same methods as `jaxmark.geometry.surfaces.Surface`."""

    def __init__(self, points: Points) -> None:
        """Take over points, each of which counts."""
        self.points = np.ascontiguousarray(points, np.float64)

    @cached_property
    def tree(self) -> KDTree:
        """The search tree of the points."""
        return KDTree(self.points)

    @cached_property
    def spacing(self) -> float:
        """Median distance of a point to the nearest other one."""
        return float(np.median(spacings(self.points)))

    @cached_property
    def planes(self) -> Planes:
        """The plane around each point."""
        return planes(self.tree, self.points)

    def without_strays(self) -> "Cloud":
        """Return the points without floaters and outliers, whose nearest points are much further than usual."""
        apart = spacings(self.points, _STRAY_POINTS)
        return Cloud(self.points[apart <= _STRAY_RATIO * np.median(apart)])

    def anchors(self) -> tuple[Points, Points]:
        """Choose random points, and unit normals there, with arbitrary signs."""
        chosen = np.sort(np.random.default_rng(0).permutation(len(self.points))[:_ANCHORS])
        return self.points[chosen], self.planes.normals[chosen]

    def closest(self, points: Points, pose: Pose = IDENTITY) -> tuple[Points, Int64[np.ndarray, " points"]]:
        """Find the closest places `[P, 3]` on the placed planes of the nearest points, and these points' indices."""
        queries = pose.inverse()(points)
        nearest = np.asarray(self.tree.query(queries)[1])
        normals = self.planes.normals[nearest]
        off = np.sum((queries - self.planes.centres[nearest]) * normals, axis=1, keepdims=True)
        foot = queries - off * normals
        beside = np.linalg.norm(foot - self.points[nearest], axis=1) > _REACH * self.spacing
        return pose(np.where(beside[:, None], self.points[nearest], foot)), nearest

    def sample(self, count: int) -> Samples:
        """Choose evenly spaced points: means of the points in cells, in random order.

        The area is that of the cells' faces, up to a factor that clouds of like density have in common.
        """
        random = np.random.default_rng(0)
        cells, size = self._cells(min(count, len(self.points) // 4))
        area = size**2 * len(np.unique(cells))
        places = self.points
        if len(places) > count:
            cells, _ = self._cells(count)
            which, inside = np.unique(cells, return_inverse=True, return_counts=True)[1:]
            places = np.stack([np.bincount(which, column) for column in self.points.T], axis=1) / inside[:, None]
        places = places[random.permutation(len(places))[:count]]
        around = KDTree(places)
        nearest = np.asarray(around.query(places, min(_SIDE_POINTS, len(places)))[1]).reshape(len(places), -1)
        normals = planes(around, places).normals
        outward = np.sum(normals * (places - places[nearest].mean(axis=1)), axis=1, keepdims=True)
        return Samples(places, unit(np.where(outward < 0, -normals, normals)), area)

    def _cells(self, count: int) -> tuple[Int64[np.ndarray, " points"], float]:
        """Assign points to cells, of which about `count` have points; returns cell numbers and the cell size."""
        chosen = np.random.default_rng(0).permutation(len(self.points))[:_COUNTED_POINTS]
        low, extent = self.points.min(axis=0), float(np.ptp(self.points, axis=0).max()) or 1.0

        def numbered(size: float, points: Points) -> Int64[np.ndarray, " points"]:
            return np.floor((points - low) / size).astype(np.int64) @ np.array([1, 2**20, 2**40])

        small, large = extent / 2**18, 2 * extent
        for _ in range(16):
            size = np.sqrt(small * large)
            many = len(np.unique(numbered(size, self.points[chosen]))) > max(count, 1)
            small, large = (size, large) if many else (small, size)
        return numbered(large, self.points), large
