"""Displacement across the surface that points stand for, over how far apart the points are."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from jaxmark.geometry.clouds import planes, spacings

_SHARE = 0.95  # of the points that are moved by no more than what is returned


class PointPlanes(NamedTuple):
    """What a cloud looks like around its points."""

    normals: Float64[np.ndarray, "points 3"]  # of the plane through the nearest points
    spacing: float  # mean distance of a point to the nearest other one


def make_point_planes(points: Float64[np.ndarray, "points 3"]) -> PointPlanes:
    """Fit a plane around each point, and measure how far the points are apart."""
    return PointPlanes(planes(KDTree(points), points).normals, float(spacings(points).mean()))


def point_to_plane(displacement: Float64[np.ndarray, "points 3"], around: PointPlanes) -> float:
    """How far 95 % of the points are moved across the surface at most, over the distance of nearest points.

    A cloud is drawn as dots or small discs about as large as the points are apart: what is a small share of that
    neither roughens its surface nor opens it. Along the surface, points may stand anywhere.

    Args:
        displacement: of each point, in the units of the planes.
        around: from `make_point_planes` of the points before they moved.
    """
    across = np.abs(np.sum(displacement * around.normals, axis=1))
    return float(np.quantile(across, _SHARE) / (around.spacing or 1.0))
