"""Canonical geometry: the points that a mark is written in, and a hash of them that distinguishes originals.

Positions are rounded to a grid, and points and faces ordered by position, so that the geometry survives what rounds,
reorders or splits vertices; see `jaxmark.geometry.imprint` for how rounding is repeated exactly.
"""

import hashlib
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt64
from numpy.typing import ArrayLike

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, Weld, weld, weld_mesh

# Six significant digits are off by up to 5e-6 of the largest coordinate, float32 by 6e-8. Both stay below a quarter of
# the grid's spacing, 1.5e-5 to 3e-5 of the diagonal, where coordinates are no larger than three quarters of the latter.
_CELLS = 2**15  # in a bounding-box diagonal, at least


class Canonical(NamedTuple):
    """The canonical geometry of a mesh."""

    points: Mesh  # the distinct points, and the mesh's faces as indices of these
    weld: Weld  # which vertices of the mesh stand at which point
    hash: bytes  # SHA-256 that identifies this geometry
    order: bytes  # SHA-256 of the order in which the mesh's file has the canonical points, and of its faces


def geometry_hash(mesh: Mesh) -> bytes:
    """Return a SHA-256 that is the same for every file that stores the geometry exactly and in the same order.

    It covers the welded points in order of first occurrence, as little-endian float64 with -0.0 as 0.0, and the
    triangles that refer to them, as little-endian int64.
    """
    points = weld_mesh(mesh, weld(mesh.vertices))
    vertices = np.asarray(points.vertices, np.float64) + 0.0  # turns -0.0 into 0.0
    return _digest(b"jaxmark/1/geometry", len(vertices), len(points.faces), vertices, points.faces)


def grid_spacing(diagonal: float) -> float:
    """Return the grid's spacing for a bounding-box diagonal: a power of two of its unit, so that rounding is exact."""
    return 2.0 ** math.floor(math.log2(diagonal / _CELLS))


def rounded(mesh: Mesh, spacing: float) -> Canonical:
    """Round points to a grid, and order them by their coordinates; those that no face uses are last.

    Faces begin at their lowest corner and are sorted, and those without three different corners are left out, so that
    the result depends neither on the order in a file nor on what a format leaves out. The hash covers the spacing, the
    points that faces use, and the faces; of a point cloud, all points and no faces.

    Args:
        mesh: any mesh.
        spacing: distance of the grid's planes, in units of the mesh; a power of two.

    Raises:
        JaxmarkError: if the mesh has faces, but none is left.
    """
    cells = np.rint(np.asarray(mesh.vertices, np.float64) / spacing) * spacing + 0.0  # turns -0.0 into 0.0
    order = np.lexsort(cells.T[::-1])
    rows = cells[order]
    fresh = np.append(True, (rows[1:] != rows[:-1]).any(axis=1))
    point = np.empty_like(order)
    point[order] = np.cumsum(fresh) - 1
    corners = point[np.asarray(mesh.faces)]
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    if len(mesh.faces) and not len(corners):
        raise JaxmarkError(
            "No face of the mesh has three corners that differ by more than rounding; it has no surface."
        )
    # A cloud, which never had faces, uses all of its points.
    used = np.full(int(fresh.sum()), len(mesh.faces) == 0)
    used[corners] = True
    place = np.empty(len(used), np.int64)
    place[np.argsort(~used, kind="stable")] = np.arange(len(used))
    point = place[point]
    first = np.empty(len(used), np.int64)
    first[point[::-1]] = np.arange(len(point))[::-1]
    faces = place[corners]
    faces = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    points, count = cells[first], int(used.sum())
    found = _digest(b"jaxmark/2/geometry", count, len(faces), spacing, points[:count], faces)
    ordered = _digest(b"jaxmark/2/order", len(point), len(mesh.faces), point, mesh.faces)
    return Canonical(Mesh(points, faces), Weld(point, first), found, ordered)


def mix(values: UInt64[np.ndarray, "*values"]) -> UInt64[np.ndarray, "*values"]:
    """Hash integers by a 64-bit finaliser (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", 2014).

    It is no cryptographic hash: collisions are easy to make.
    """
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def _digest(label: bytes, *arrays: ArrayLike) -> bytes:
    """Compute the SHA-256 of a label and arrays, as little-endian float64 or int64."""
    state = hashlib.sha256(label)
    for array in map(np.asarray, arrays):
        state.update(array.astype("<f8" if array.dtype.kind == "f" else "<i8").tobytes())
    return state.digest()
