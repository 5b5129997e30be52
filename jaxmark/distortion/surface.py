"""Distances between surfaces by exact closest points, on the host.

Reference: Cignoni, Rocchini, Scopigno, "Metro: measuring error on simplified surfaces", Computer Graphics Forum 17(2),
1998.
"""

from typing import NamedTuple

import numpy as np

from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.geometry.surfaces import Surface, sample

_SAMPLED_POINTS = 100_000  # on each surface


class SurfaceDistance(NamedTuple):
    """Distances between two surfaces, in the units of the positions."""

    mrms: float  # the larger of the two one-sided root mean square distances
    hausdorff: float  # the largest distance of a point on either surface from the other


def surface_distance(first: Mesh, second: Mesh) -> SurfaceDistance:
    """Measure how far two surfaces are apart, from the vertices and 100,000 sampled points of each to the other.

    Distances to the surfaces are exact. Root mean squares are over the points, which are sampled uniformly by area;
    the largest distance is over points and vertices.

    Raises:
        JaxmarkError: if a surface has no area, or libigl is missing.
    """
    sides = [_one_sided(first, Surface(second)), _one_sided(second, Surface(first))]
    return SurfaceDistance(*(max(values) for values in zip(*sides, strict=True)))


def _one_sided(mesh: Mesh, other: Surface) -> tuple[float, float]:
    sampled = sample(mesh, _SAMPLED_POINTS).points
    vertices = np.asarray(mesh.vertices, np.float64)[used_vertices(mesh)]
    of_points, of_vertices = (
        np.linalg.norm(other.closest(points)[0] - points, axis=1) for points in (sampled, vertices)
    )
    return float(np.sqrt(np.mean(of_points**2))), float(max(of_points.max(), of_vertices.max()))
