"""Distances between surfaces; host side, by exact closest points.

Cignoni, Rocchini, Scopigno, "Metro: measuring error on simplified surfaces", Computer Graphics Forum 17(2), 1998.
"""

from typing import NamedTuple

import numpy as np

from jaxmark.mesh import Mesh, used_vertices
from jaxmark.surfaces import Surface, sample

_SAMPLES = 100_000


class SurfaceDistance(NamedTuple):
    """In the units of the positions."""

    mrms: float  # the larger of the two one-sided root mean squares
    hausdorff: float  # the largest distance of a point of either from the other


def surface_distance(first: Mesh, second: Mesh) -> SurfaceDistance:
    """How far two surfaces are apart, each seen from vertices and from 100,000 points spread over the other by area.

    Distances to the surfaces are exact. The mean is over the points spread by area, the largest over both.

    Raises:
        JaxmarkError: if a surface has no area, or libigl is missing.
    """
    sides = [_one_sided(first, Surface(second)), _one_sided(second, Surface(first))]
    return SurfaceDistance(*(max(values) for values in zip(*sides, strict=True)))


def _one_sided(mesh: Mesh, other: Surface) -> tuple[float, float]:
    spread = sample(mesh, _SAMPLES).points
    vertices = np.asarray(mesh.vertices, np.float64)[used_vertices(mesh)]
    off, most = (np.linalg.norm(other.closest(points)[0] - points, axis=1) for points in (spread, vertices))
    return float(np.sqrt(np.mean(off**2))), float(max(off.max(), most.max()))
