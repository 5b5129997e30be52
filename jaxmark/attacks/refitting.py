"""Refitting: nearly flat, round or cylindrical regions are made exactly so, as in reverse engineering; on the host.

Strengths are angles in degrees, in [0, 30]; at 0, and where no shape fits, nothing changes.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.attacks.support import on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, boundary_vertices, diagonal, face_normals, used_vertices
from jaxmark.geometry.pose import Points
from jaxmark.seeds import Randomness

_MAX_DEGREES = 30.0
_MIN_REGION_VERTICES = 10  # fewer fit most shapes
_MAX_STRAY_SHARE = 0.05  # largest fraction of a region's area whose normals do not fit, because noise tilts faces
_MAX_RMS_DISTANCE = 0.005  # distance of a region's vertices to its shape, in diagonals of the mesh
_MIN_INNER_SHARE = 0.25  # of the vertices of a broad region: those that are not on its boundary
_CURVED_TURN_FACTOR = 3.0  # curved regions may turn from face to face by this multiple of the angle
_ANGLE_HALVINGS = 3
# Least singular value, over the largest. Two planes at less than 2 atan 0.2, 23°, count as one plane, because their
# intersection is inaccurate.
_RANK_CUTOFF = 0.2
_GAUSS_NEWTON_STEPS = 5  # the tangent planes of curved shapes turn a little as vertices move

# A surface onto which vertices are projected: a function of points that returns the unit normals at the surface's
# points nearest to them, and signed distances along these normals to the surface.
Shape = Callable[[Points], tuple[Points, Float64[np.ndarray, " points"]]]
Found = tuple[Shape, Int64[np.ndarray, " _"]]  # a shape, and the vertices that belong to it


class Region(NamedTuple):
    """A region of faces, with the quantities that fitting a shape needs."""

    points: Points  # the positions of their vertices
    centroids: Float64[np.ndarray, "faces 3"]
    normals: Float64[np.ndarray, "faces 3"]
    areas: Float64[np.ndarray, " faces"]
    rim: int  # number of the vertices that are on the boundary of the region


Fit = Callable[[Region], Shape | None]  # None for a region that it does not apply to
Kinds = Sequence[tuple[float, Sequence[Fit]]]


@on_host
def plane_fitting(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Flatten nearly flat regions.

    Regions grow over edges at which normals turn by less than an angle, the strength. A region of at least ten vertices
    is flat if the normal of its least-squares plane is within that angle of the normals of its faces, except on at most
    5 % of its area, which may be noise and is left out, and if its RMS distance to the plane is at most 0.5 % of the
    diagonal. Regions that are not flat are tried again at half the angle, three times, which separates planes from
    surfaces that join them smoothly.

    Vertices are projected onto the plane of their region, the line where two planes meet, or the point where three or
    more do: by the least-squares displacement of least norm. Directions in which planes hardly differ (singular values
    below 0.2 of the largest, two planes at less than 23°) are left out, so that a vertex moves at most √3 / 0.2 < 9
    times as far as the farthest of its planes is.

    Raises:
        JaxmarkError: if all vertices of the mesh are at one point.
    """
    return _refit(mesh, strength, ((1.0, (_plane,)),))


@on_host
def primitive_fitting(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Flatten nearly flat regions, and make nearly spherical or cylindrical ones exactly so.

    As `plane_fitting`, except that regions that are not flat may turn by up to three times the angle from face to face,
    and are fitted by a sphere and a circular cylinder. The closer one is taken if it meets the conditions on a plane:
    on its normals, at the faces' centroids, and on its RMS distance. Facets, flat regions with less than a fourth of
    their vertices off the boundary, become planes only where that fails. Vertices move radially onto their shape, and
    where regions meet onto all of their shapes, by Gauss-Newton steps.
    """
    # The facets of a cylinder are flat, too: only broad regions become planes before curved shapes are tried.
    kinds = (
        (1.0, (_broad_plane,)),
        (_CURVED_TURN_FACTOR, (_plane,)),
        (_CURVED_TURN_FACTOR, (_sphere, _cylinder)),
        (1.0, (_plane,)),
    )
    return _refit(mesh, strength, kinds)


def _refit(mesh: Mesh, strength: float, kinds: Kinds) -> Mesh:
    """Project vertices onto shapes; `kinds` are pairs of the turn between a region's faces, in angles, and its fits."""
    if not 0 <= strength <= _MAX_DEGREES:
        raise JaxmarkError(f"An angle between normals is from 0 to {_MAX_DEGREES:g} degrees, got {strength:g}.")
    size = diagonal(mesh)
    if strength == 0:
        return mesh
    vertices = np.asarray(mesh.vertices, np.float64)
    # Squares of coordinates near the origin keep their digits.
    start = vertices - vertices[used_vertices(mesh)].mean(axis=0)
    centred = Mesh(start, np.asarray(mesh.faces, np.int64))
    found = _find_shapes(centred, np.radians(strength), _MAX_RMS_DISTANCE * size, kinds)
    return Mesh(vertices + _displacement(start, found), mesh.faces) if found else mesh


def _find_shapes(mesh: Mesh, angle: float, most: float, kinds: Kinds) -> list[Found]:
    """Find the shapes in a mesh; no two share a face."""
    import trimesh  # takes long to import

    normals = face_normals(mesh)
    pairs = np.asarray(trimesh.graph.face_adjacency(np.asarray(mesh.faces)), np.int64).reshape(-1, 2)
    cosine = np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1)
    found: list[Found] = []
    free: Bool[np.ndarray, " faces"] = np.any(normals != 0, axis=1)
    for one in angle / 2.0 ** np.arange(_ANGLE_HALVINGS + 1):
        for turn, fits in kinds:
            linked = pairs[(cosine > np.cos(turn * one)) & free[pairs].all(axis=1)]
            for faces in _parts(linked, free):
                if best := _best(_region(mesh, normals, faces), fits, one, most):
                    kept = faces[best[1]]
                    found.append((best[0], np.unique(np.asarray(mesh.faces)[kept])))
                    free[kept] = False
    return found


def _parts(linked: Int64[np.ndarray, "links 2"], free: Bool[np.ndarray, " faces"]) -> Iterator[np.ndarray]:
    """Yield the faces of each connected part that is large enough to have the vertices of a region."""
    size = len(free)
    graph = sparse.coo_array((np.ones(len(linked)), (linked[:, 0], linked[:, 1])), (size, size))
    label = csgraph.connected_components(graph, directed=False)[1]
    # A connected part of n vertices has at least n - 2 faces.
    large = np.flatnonzero(free & (np.bincount(label)[label] >= _MIN_REGION_VERTICES - 2))
    large = large[np.argsort(label[large], kind="stable")]
    if len(large) > 0:
        yield from np.split(large, np.flatnonzero(np.diff(label[large])) + 1)


def _best(
    region: Region, fits: Sequence[Fit], angle: float, most: float
) -> tuple[Shape, Bool[np.ndarray, " faces"]] | None:
    """Find the shape closest to a region, and the faces that agree with it; None if no shape fits."""
    ends = []
    for shape in (fit(region) for fit in fits if len(region.points) >= _MIN_REGION_VERTICES):
        if shape is None:
            continue
        along = np.abs(np.sum(shape(region.centroids)[0] * region.normals, axis=1)) > np.cos(angle)
        left = float(np.sqrt(np.mean(shape(region.points)[1] ** 2)))
        if left <= most and region.areas[~along].sum() <= _MAX_STRAY_SHARE * region.areas.sum():
            ends.append((left, shape, along))
    return min(ends, key=lambda end: end[0])[1:] if ends else None


def _region(mesh: Mesh, normals: Float64[np.ndarray, "faces 3"], faces: Int64[np.ndarray, " some"]) -> Region:
    vertices, corners = np.asarray(mesh.vertices), np.asarray(mesh.faces)[faces]
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    rim = len(boundary_vertices(corners))
    return Region(vertices[np.unique(corners)], (a + b + c) / 3, normals[faces], areas, rim)


def _plane(region: Region) -> Shape:
    """Fit the least-squares plane of a region."""
    middle = region.points.mean(axis=0)
    normal = _smallest_direction(region.points - middle)
    offset = float(normal @ middle)
    return lambda points: (np.broadcast_to(normal, points.shape), offset - points @ normal)


def _broad_plane(region: Region) -> Shape | None:
    """Fit a plane to a region with enough vertices off its boundary; return None for others."""
    return _plane(region) if len(region.points) - region.rim >= _MIN_INNER_SHARE * len(region.points) else None


def _cylinder(region: Region) -> Shape:
    """Fit a circular cylinder about the direction in which the faces' normals have the smallest components."""
    axis = _smallest_direction(region.normals * np.sqrt(region.areas)[:, None])
    return _sphere(region, np.eye(3) - np.outer(axis, axis))


def _sphere(region: Region, flat: Float64[np.ndarray, "3 3"] | None = None) -> Shape:
    """Fit a sphere, or a cylinder if `flat` projects points onto the plane across its axis.

    It is a linear least-squares fit of |x|² = 2 c · x + (r² - |c|²) (Kåsa, IEEE Trans. Instrum. Meas. 25, 1976).
    """
    points, flat = region.points, np.eye(3) if flat is None else flat
    middle = points.mean(axis=0)
    across = (points - middle) @ flat
    squares = np.sum(across**2, axis=1)
    # Along the axis of a cylinder all coordinates are zero, and so is the solution of least norm.
    shift = np.linalg.lstsq(2 * across, squares - squares.mean(), rcond=1e-9)[0]
    centre, radius = middle + shift, float(np.sqrt(squares.mean() + shift @ shift))

    def shape(points: Points) -> tuple[Points, Float64[np.ndarray, " points"]]:
        out = (points - centre) @ flat
        far = np.linalg.norm(out, axis=1)
        return out / np.maximum(far, np.finfo(float).tiny)[:, None], radius - far

    return shape


def _smallest_direction(rows: Float64[np.ndarray, "rows 3"]) -> Float64[np.ndarray, "3"]:
    """Return the direction of the rows' smallest components: the lowest eigenvector of their second moments."""
    return np.linalg.eigh(rows.T @ rows)[1][:, 0]


def _displacement(start: Points, found: Sequence[Found]) -> Points:
    """Return the displacement that brings vertices as close as possible to all of their shapes (Gauss-Newton)."""
    vertex = np.concatenate([vertices for _, vertices in found])
    order = np.argsort(vertex, kind="stable")
    moved, first, count = np.unique(vertex[order], return_index=True, return_counts=True)
    there = start.copy()
    for _ in range(_GAUSS_NEWTON_STEPS):
        parts = [shape(there[vertices]) for shape, vertices in found]
        normals, far = (np.concatenate(part)[order] for part in zip(*parts, strict=True))
        for shapes in np.unique(count).tolist():
            these = count == shapes
            rows = first[these][:, None] + np.arange(shapes)
            there[moved[these]] += (np.linalg.pinv(normals[rows], rcond=_RANK_CUTOFF) @ far[rows][..., None])[..., 0]
    return there - start
