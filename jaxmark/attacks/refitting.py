"""Refitting: what is nearly flat, round or cylindrical is made exactly so, as reverse engineering does; on the host."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float64, Int64, PRNGKeyArray
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, boundary_vertices, diagonal, face_normals, used_vertices
from jaxmark.pose import Points

_MOST = 30.0  # degrees
_LEAST = 10  # vertices of a region; fewer fit most shapes
_STRAY = 0.05  # share of a region's area whose normals may be off: noise tilts single faces
_FIT = 0.005  # the most that is left of a region, RMS over the diagonal of the mesh
_BROAD = 0.25  # share of the vertices of a broad region that are inside
_TURN = 3.0  # curved regions may turn by so many times the angle from face to face
_HALVINGS = 3
_RANK = 0.2  # planes at less than 2 atan 0.2, 23°, count as one: where they meet says little
_STEPS = 5  # the tangent planes of curved shapes turn a little as vertices move


class Shape(Protocol):
    """A surface that vertices are projected on."""

    def across(self, points: Points) -> tuple[Points, Float64[np.ndarray, " points"]]:
        """Unit normals where points are nearest to the surface, and how far along them it is."""
        ...


class Plane(NamedTuple):
    """The points x with normal · x = offset."""

    normal: Float64[np.ndarray, "3"]
    offset: float

    def across(self, points: Points) -> tuple[Points, Float64[np.ndarray, " points"]]:
        """See `Shape`."""
        return np.broadcast_to(self.normal, points.shape), self.offset - points @ self.normal


class Round(NamedTuple):
    """A sphere, or a circular cylinder: what is so far from a point, or from a line through it."""

    centre: Float64[np.ndarray, "3"]
    radius: float
    flat: Float64[np.ndarray, "3 3"]  # projects on the plane across the line; the identity for a sphere

    def across(self, points: Points) -> tuple[Points, Float64[np.ndarray, " points"]]:
        """See `Shape`."""
        out = (points - self.centre) @ self.flat
        far = np.linalg.norm(out, axis=1)
        return out / np.maximum(far, np.finfo(float).tiny)[:, None], self.radius - far


class Region(NamedTuple):
    """Some of the faces, and what is needed of them to fit a shape."""

    vertices: Int64[np.ndarray, " vertices"]  # their numbers
    points: Points  # where those are
    centroids: Float64[np.ndarray, "faces 3"]
    normals: Float64[np.ndarray, "faces 3"]
    areas: Float64[np.ndarray, " faces"]
    rim: int  # how many of the vertices are on it


class Found(NamedTuple):
    """A shape, and the vertices that belong to it."""

    shape: Shape
    vertices: Int64[np.ndarray, " vertices"]


Fit = Callable[[Region], Shape | None]  # None where it is not to be tried


def plane_fitting(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Make flat what is nearly flat.

    Regions grow over edges at which normals turn by less than an angle. One is flat if its least-squares plane has a
    normal within that angle of its faces', but for 5 % of its area that may be noise and is left out, and leaves at
    most 0.5 % of the diagonal, RMS; it must have ten vertices. What is not flat is tried again at half the angle, three
    times: so planes part from what goes over into them smoothly.

    Vertices are projected on the plane of their region, the line of intersection of two, the point of three or more: by
    the displacement of least norm among those of least squares. Directions in which planes hardly differ (singular
    values below 0.2 of the largest, two planes at less than 23°) are left out, so that a vertex moves at most
    √3 / 0.2 < 9 times as far as the farthest of its planes is.

    Args:
        mesh: any mesh, concrete.
        strength: the angle in degrees, in [0, 30]; at 0 nothing changes.
        key: not used; attacks share one signature.

    Returns:
        The mesh with moved vertices; unchanged where nothing is flat.

    Raises:
        JaxmarkError: if the angle is outside [0, 30], or all vertices of the mesh are at one point.
    """
    return _refitted(mesh, strength, ((1.0, (_plane,)),))


def primitive_fitting(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Make flat what is nearly flat, and round what is nearly a sphere or a circular cylinder.

    As `plane_fitting`; but regions that turn by less than three times the angle from face to face, and are not flat,
    are fitted by a sphere and a cylinder, of which the closer one counts if it passes as a plane has to: by its normals
    at the faces' centroids and by what it leaves. Facets, flat regions of which less than a fourth of the vertices are
    inside, are planes only where that fails. Vertices go to the shape radially, and to all their shapes where regions
    meet, by Gauss-Newton steps.

    Args:
        mesh: any mesh, concrete.
        strength: the angle in degrees, in [0, 30]; at 0 nothing changes.
        key: not used; attacks share one signature.

    Returns:
        The mesh with moved vertices; unchanged where nothing fits.

    Raises:
        JaxmarkError: if the angle is outside [0, 30], or all vertices of the mesh are at one point.
    """
    # The facets of a cylinder are flat too: only what is broad is a plane before it has been tried.
    kinds = ((1.0, (_broad,)), (_TURN, (_plane,)), (_TURN, (_sphere, _cylinder)), (1.0, (_plane,)))
    return _refitted(mesh, strength, kinds)


def _refitted(mesh: Mesh, strength: float, kinds: Sequence[tuple[float, Sequence[Fit]]]) -> Mesh:
    """Project vertices on the shapes found; kinds are how much a region may turn, in angles, and what fits it."""
    if not 0 <= strength <= _MOST:
        raise JaxmarkError(f"An angle between normals is from 0 to {_MOST:g} degrees, got {strength:g}.")
    size = diagonal(mesh)
    if strength == 0:
        return mesh
    vertices = np.asarray(mesh.vertices, np.float64)
    # Near the origin squares keep their digits.
    start = vertices - vertices[used_vertices(mesh)].mean(axis=0)
    found = _found(Mesh(start, np.asarray(mesh.faces, np.int64)), np.radians(strength), _FIT * size, kinds)
    return Mesh(vertices + _displacement(start, found), mesh.faces) if found else mesh


def _found(mesh: Mesh, angle: float, most: float, kinds: Sequence[tuple[float, Sequence[Fit]]]) -> list[Found]:
    """The shapes that are in a mesh, none sharing a face with another."""
    import trimesh  # takes long to import

    normals = face_normals(mesh)
    pairs = np.asarray(trimesh.graph.face_adjacency(np.asarray(mesh.faces)), np.int64).reshape(-1, 2)
    cosine = np.sum(normals[pairs[:, 0]] * normals[pairs[:, 1]], axis=1)
    found: list[Found] = []
    free: Bool[np.ndarray, " faces"] = np.any(normals != 0, axis=1)
    for one in angle / 2.0 ** np.arange(_HALVINGS + 1):
        for turn, fits in kinds:
            linked = pairs[(cosine > np.cos(turn * one)) & free[pairs].all(axis=1)]
            for faces in _parts(linked, free):
                best = _best(mesh, normals, faces, fits, one, most)
                if best is not None:
                    found.append(best[0])
                    free[best[1]] = False
    return found


def _parts(linked: Int64[np.ndarray, "links 2"], free: Bool[np.ndarray, " faces"]) -> Iterator[np.ndarray]:
    """The faces of each connected part that may have vertices enough."""
    size = len(free)
    graph = sparse.coo_array((np.ones(len(linked)), (linked[:, 0], linked[:, 1])), (size, size))
    label = csgraph.connected_components(graph, directed=False)[1]
    # A connected part of so many vertices has at least so many faces, less two.
    large = np.flatnonzero(free & (np.bincount(label)[label] >= _LEAST - 2))
    large = large[np.argsort(label[large], kind="stable")]
    if len(large) > 0:
        yield from np.split(large, np.flatnonzero(np.diff(label[large])) + 1)


def _best(
    mesh: Mesh,
    normals: Float64[np.ndarray, "faces 3"],
    faces: Int64[np.ndarray, " some"],
    fits: Sequence[Fit],
    angle: float,
    most: float,
) -> tuple[Found, Int64[np.ndarray, " kept"]] | None:
    """The closest shape to a region, with its vertices, and the faces that are not off it; None if there is none."""
    region = _region(mesh, normals, faces)
    ends = []
    for fit in fits if len(region.vertices) >= _LEAST else ():
        shape = fit(region)
        if shape is None:
            continue
        along = np.abs(np.sum(shape.across(region.centroids)[0] * region.normals, axis=1)) > np.cos(angle)
        left = float(np.sqrt(np.mean(shape.across(region.points)[1] ** 2)))
        if left <= most and region.areas[~along].sum() <= _STRAY * region.areas.sum():
            ends.append((left, shape, faces[along]))
    if not ends:
        return None
    _, shape, kept = min(ends, key=lambda end: end[0])
    return Found(shape, np.unique(np.asarray(mesh.faces)[kept])), kept


def _region(mesh: Mesh, normals: Float64[np.ndarray, "faces 3"], faces: Int64[np.ndarray, " some"]) -> Region:
    vertices, corners = np.asarray(mesh.vertices), np.asarray(mesh.faces)[faces]
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    used = np.unique(corners)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    return Region(used, vertices[used], (a + b + c) / 3, normals[faces], areas, len(boundary_vertices(corners)))


def _plane(region: Region) -> Plane:
    """Of least squares."""
    middle = region.points.mean(axis=0)
    normal = _least(region.points - middle)
    return Plane(normal, float(normal @ middle))


def _broad(region: Region) -> Plane | None:
    """The plane of a region with an inside."""
    return _plane(region) if len(region.points) - region.rim >= _BROAD * len(region.points) else None


def _sphere(region: Region) -> Round:
    return _round(region.points, np.eye(3))


def _cylinder(region: Region) -> Round:
    """About the direction that normals have the least of."""
    axis = _least(region.normals * np.sqrt(region.areas)[:, None])
    return _round(region.points, np.eye(3) - np.outer(axis, axis))


def _round(points: Points, flat: Float64[np.ndarray, "3 3"]) -> Round:
    """By linear least squares of |x|² = 2 c · x + (r² - |c|²) (Kåsa, IEEE Trans. Instrum. Meas. 25, 1976)."""
    middle = points.mean(axis=0)
    across = (points - middle) @ flat
    squares = np.sum(across**2, axis=1)
    # Along the axis of a cylinder all is zero, and the solution of least norm is zero too.
    centre = np.linalg.lstsq(2 * across, squares - squares.mean(), rcond=1e-9)[0]
    return Round(middle + centre, float(np.sqrt(squares.mean() + centre @ centre)), flat)


def _least(rows: Float64[np.ndarray, "rows 3"]) -> Float64[np.ndarray, "3"]:
    """The direction that rows have the least of: the smallest eigenvector of the sum of their outer products."""
    return np.linalg.eigh(rows.T @ rows)[1][:, 0]


def _displacement(start: Points, found: Sequence[Found]) -> Points:
    """What brings vertices onto all of their shapes, as nearly as may be."""
    vertex = np.concatenate([one.vertices for one in found])
    order = np.argsort(vertex, kind="stable")
    moved, first, count = np.unique(vertex[order], return_index=True, return_counts=True)
    there = start.copy()
    for _ in range(_STEPS):
        parts = [one.shape.across(there[one.vertices]) for one in found]
        normals, far = (np.concatenate(part)[order] for part in zip(*parts, strict=True))
        for shapes in np.unique(count).tolist():
            these = count == shapes
            rows = first[these][:, None] + np.arange(shapes)
            there[moved[these]] += (np.linalg.pinv(normals[rows], rcond=_RANK) @ far[rows][..., None])[..., 0]
    return there - start
