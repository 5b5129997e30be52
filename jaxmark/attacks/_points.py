"""Attacks on point clouds: remove, add or displace points, merge another scan, or resample; on the host.

All raise `JaxmarkError` if the mesh has faces, or if no point would be left.
"""

import numpy as np
from scipy.spatial import KDTree

from jaxmark.attacks.support import check_share, on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, diagonal
from jaxmark.geometry.pose import Points
from jaxmark.seeds import Randomness, generator

_AROUND = 0.25  # width of the margin around a cloud's box on each side, over its diagonal
_CORNERS = 6  # number of nearest points, two of which form a triangle with a point


@on_host
def subsampling(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Remove random points; the others keep their positions and their order.

    The strength is the fraction of the points that are removed, in [0, 1).
    """
    points = _points("Subsampling", mesh)
    check_share(strength, "points")
    count = round(strength * len(points))
    if count == len(points):
        raise JaxmarkError(f"Of {len(points)} points none would be left; take fewer away.")
    return mesh._replace(vertices=points[np.sort(generator(seed).permutation(len(points))[count:])])


@on_host
def outliers(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Move random points to random positions in and around the cloud's box.

    The strength is the fraction of the points that are moved, in [0, 1).
    """
    points, random = np.array(_points("Throwing points off", mesh)), generator(seed)
    check_share(strength, "points")
    chosen = random.permutation(len(points))[: round(strength * len(points))]
    points[chosen] = _anywhere(mesh, len(chosen), random)
    return mesh._replace(vertices=points)


@on_host
def floaters(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Add points at random positions in and around the cloud's box, in random order among the others.

    The strength is the number of added points, over the number of points of the cloud.
    """
    points, random = _points("Adding points", mesh), generator(seed)
    more = _anywhere(mesh, round(strength * len(points)), random)
    return mesh._replace(vertices=random.permutation(np.concatenate([points, more])))


@on_host
def merging(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Merge the cloud with a second scan of as many points on the same surface, in random order.

    The strength is the half width of the uniform noise on each coordinate of the second scan, over the diagonal.
    """
    points, random = _points("Merging scans", mesh), generator(seed)
    second = _between(points, len(points), random)
    second += strength * diagonal(mesh) * random.uniform(-1, 1, second.shape)
    return mesh._replace(vertices=random.permutation(np.concatenate([points, second])))


@on_host
def resampling(mesh: Mesh, strength: float, seed: Randomness) -> Mesh:
    """Resample the surface: replace all points by random positions between neighbouring points.

    The strength is the number of new points, over the number of points of the cloud.
    """
    points = _points("Resampling", mesh)
    if not (count := round(strength * len(points))):
        raise JaxmarkError(f"{strength:g} times {len(points)} points are none; take more.")
    return mesh._replace(vertices=_between(points, count, generator(seed)))


def _points(name: str, mesh: Mesh) -> Points:
    """Return the points of a cloud; refuse a mesh, whose faces would be lost."""
    if len(mesh.faces):
        raise JaxmarkError(f"{name} takes a point cloud, and this mesh has {len(mesh.faces)} faces; leave them out.")
    return np.asarray(mesh.vertices, np.float64)


def _anywhere(mesh: Mesh, count: int, random: np.random.Generator) -> Points:
    """Draw random positions in the box of a cloud, and around it."""
    points, wide = np.asarray(mesh.vertices, np.float64), _AROUND * diagonal(mesh)
    return random.uniform(points.min(axis=0) - wide, points.max(axis=0) + wide, (count, 3))


def _between(points: Points, count: int, random: np.random.Generator) -> np.ndarray:
    """Draw random positions in triangles, each formed by a random point and two of its nearest points."""
    around = min(_CORNERS, len(points) - 1)
    if around < 1:
        return np.repeat(points, count, axis=0)[:count]
    start = random.integers(len(points), size=count)
    nearest = np.asarray(KDTree(points).query(points[start], around + 1)[1])
    corners = [nearest[np.arange(count), random.integers(around + 1, size=count)] for _ in range(2)]
    share, *shares = random.dirichlet(np.ones(3), count).T[..., None]
    return share * points[start] + sum(part * points[corner] for part, corner in zip(shares, corners, strict=True))
