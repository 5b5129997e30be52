"""Imprints of originals, which restore a copy that was saved again to exactly the geometry that was hashed.

If a coordinate lies between two planes of the grid, rounding a copy may choose the other plane. So the imprint keeps a
short hash of each point: of the eight corners of the grid's cube around a point of the copy, the one with a known hash
is taken. The order of points and faces, copies of points and isolated vertices do not count, as canonical geometry has
none. A copy that was moved, turned and scaled as a whole is aligned by its moments.
"""

from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt32

from jaxmark.geometry.canonical import Canonical, mix, rounded
from jaxmark.geometry.mesh import Mesh, cross_product, host_mesh, used_vertices, weld
from jaxmark.geometry.pose import IDENTITY, Points, Pose, similarity

_NEAR, _WIDE = (0.0, 1.0), (-1.0, 0.0, 1.0, 2.0)  # planes of the grid about a coordinate, from the one below
_SAMPLE = 500  # points by which a pose is tried
_MIN_SHARE = 0.25  # least fraction of sample points that a pose must recognise; a wrong pose has only chance matches
_MAX_ROUNDS = 4  # of fitting the pose to the points that were found, and finding them again


class Imprint(NamedTuple):
    """A record of a canonical geometry that distinguishes its points from all others."""

    hash: bytes
    grid: float  # spacing of the grid, in the original's units
    centre: Float64[np.ndarray, " 3"]  # of the surface
    covariance: Float64[np.ndarray, "3 3"]  # of the surface, about its centre
    tags: UInt32[np.ndarray, " points"]  # hash of each point that faces use, in their canonical order
    order: bytes  # `Canonical.order` of the original's file


class Restored(NamedTuple):
    """A copy, restored to an original's grid as far as possible."""

    mesh: Mesh  # the copy, in the original's pose; the points that were found are exactly the original's
    exact: bool  # whether its canonical geometry is the original's
    places: Int64[np.ndarray, " vertices"]  # canonical index of the point at each vertex; -1 if it is none
    share: float  # share of the original's points that were found, but for the few whose hashes coincide
    distance: float  # distance of the two shapes by their moments, over the original's size


def make_imprint(canonical: Canonical, grid: float) -> Imprint:
    """Make the imprint of a canonical geometry with this grid."""
    points = np.asarray(canonical.points.vertices, np.float64)[used_vertices(canonical.points)]
    return Imprint(canonical.hash, grid, *_moments(canonical.points), _tags(points / grid), canonical.order)


def restore(copy: Mesh, imprint: Imprint) -> Restored:
    """Restore a copy of an original to exactly the geometry that was hashed, or as near to it as possible.

    A copy that was moved, turned or scaled is recognised only as a whole, and not if it is nearly a ball.
    `JaxmarkError` is raised as by `make_mesh`.
    """
    copy = host_mesh(copy)
    vertices = np.array(copy.vertices, np.float64)
    used = np.flatnonzero(used_vertices(copy))
    welded = weld(vertices[used])
    points = vertices[used][welded.first]
    centre, covariance = _moments(copy)
    table = np.sort(imprint.tags)
    some = np.unique(np.linspace(0, len(points) - 1, min(len(points), _SAMPLE)).astype(np.int64))
    best, found, cells = IDENTITY, np.zeros(len(points), bool), points.copy()
    for pose in (IDENTITY, *_poses(centre, covariance, imprint)):
        if np.mean(_find(pose(points[some]), imprint.grid, table)[1]) < _MIN_SHARE:
            continue
        for _ in range(_MAX_ROUNDS):
            corners, there = _find(pose(points), imprint.grid, table)
            improved = there.sum() > found.sum()
            if improved:
                best, found, cells = pose, there, corners
            if there.all() or not improved:
                break
            pose = similarity(points[there], corners[there])
        if found.all():
            break
    missing = np.flatnonzero(~found) if found.any() else []
    if len(missing):  # coordinates that are large beside the mesh have lost more of their digits
        cells[missing], found[missing] = _find(best(points[missing]), imprint.grid, table, _WIDE)
    vertices = best(vertices)
    vertices[used] = np.where(found[:, None], cells, best(points))[welded.point]
    mesh = Mesh(vertices, copy.faces)
    places = np.full(len(vertices), -1)
    order = np.argsort(imprint.tags, kind="stable")
    place = np.minimum(np.searchsorted(table, _tags(cells / imprint.grid)), len(table) - 1)
    places[used] = np.where(found, order[place], -1)[welded.point]
    share = len(np.unique(places[places >= 0])) / len(table)
    exact = bool(found.all()) and rounded(mesh, imprint.grid).hash == imprint.hash
    return Restored(mesh, exact, places, share, _distance(centre, covariance, imprint))


def _moments(mesh: Mesh) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, "3 3"]]:
    """Compute the centre and covariance of a surface, which, unlike those of its vertices, ignore welding.

    Those of a cloud are of its distinct points, as it has nothing else.
    """
    if len(mesh.faces) == 0:
        vertices = np.asarray(mesh.vertices, np.float64)
        points = vertices[weld(vertices).first]
        middle = points.mean(axis=0)
        return middle, (points - middle).T @ (points - middle) / len(points)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    start = vertices[faces[0, 0]]  # keeps the digits of a mesh that is far from the origin
    a, b, c = (vertices[faces[:, corner]] - start for corner in range(3))
    normals, total = cross_product(b - a, c - a), a + b + c
    weight = np.sqrt(np.einsum("fi,fi->f", normals, normals))
    weight /= max(weight.sum(), 1e-300)
    middle, parts = weight @ total / 3, (total, a, b, c)
    return start + middle, sum((part.T * weight) @ part for part in parts) / 12 - np.outer(middle, middle)


def _tags(cells: Float64[np.ndarray, "*points 3"]) -> UInt32[np.ndarray, "*points"]:
    """Hash points that are given as multiples of the grid's spacing."""
    x, y, z = np.moveaxis(cells.astype(np.int64).view(np.uint64), -1, 0)
    return (mix(mix(mix(x) + y) + z) >> np.uint64(32)).astype(np.uint32)


def _find(
    points: Points, grid: float, table: UInt32[np.ndarray, " tags"], planes: Sequence[float] = _NEAR
) -> tuple[Points, Bool[np.ndarray, " points"]]:
    """Find the corner of the grid near each point whose tag is in a sorted table, and whether there is one.

    If there are several, because tags are short, it is one that no other point needs; then the nearest.
    """
    low = np.floor(points / grid)
    corners = low[:, None] + np.array(list(product(planes, repeat=3)))
    corners = np.where(np.abs(corners) < 2.0**62, corners, 2.0**62)
    tags = _tags(corners)
    place = np.minimum(np.searchsorted(table, tags), len(table) - 1)
    known = table[place] == tags
    taken = np.zeros(len(table), bool)
    single = known.sum(axis=1) == 1
    taken[place[single][known[single]]] = True
    free = known & ~taken[place]
    free = np.where((single | ~free.any(axis=1))[:, None], known, free)
    off = np.where(free, np.sum((corners * grid - points[:, None]) ** 2, axis=2), np.inf)
    chosen = np.take_along_axis(corners, off.argmin(axis=1)[:, None, None], axis=1)[:, 0]
    return chosen * grid, known.any(axis=1)


def _poses(centre: Float64[np.ndarray, " 3"], covariance: Float64[np.ndarray, "3 3"], imprint: Imprint) -> list[Pose]:
    """Compute the similarities that map the moments of a copy to an original's, as all 24 rotations."""
    (size, axes), (wide, onto) = np.linalg.eigh(covariance), np.linalg.eigh(imprint.covariance)
    if not size.sum() > 0:
        return []
    scale, poses = np.sqrt(wide.sum() / size.sum()), []
    for order, signs in product(permutations(range(3)), product([1, -1], repeat=3)):
        turn = onto @ (np.eye(3)[list(order)] * signs) @ axes.T
        if np.linalg.det(turn) > 0:
            poses.append(Pose(scale * turn, imprint.centre - scale * turn @ centre))
    return poses


def _distance(centre: Float64[np.ndarray, " 3"], covariance: Float64[np.ndarray, "3 3"], imprint: Imprint) -> float:
    """Compute the distance of two ellipsoids by their centres and widths, if needed after alignment.

    It is the smaller of the distances with that alignment and without, as a shift, a turn or a scale is no difference.
    """
    here, there = (np.sqrt(np.maximum(np.linalg.eigvalsh(one), 0)) for one in (covariance, imprint.covariance))
    size = max(float(np.linalg.norm(there)), 1e-300)
    plain = np.sqrt(np.sum((centre - imprint.centre) ** 2) + np.sum((here - there) ** 2))
    scaled = np.linalg.norm(here * (size / max(float(np.linalg.norm(here)), 1e-300)) - there)
    return float(min(plain, scaled) / size)
