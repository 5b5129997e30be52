"""Averaging over repeated parts of a shape, such as mirrored halves or equal parts; on the host.

A mark that differs between the repeated parts is averaged out.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.alignment.registration import refine
from jaxmark.attacks.support import check_share, on_host
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, component_of, diagonal, used_vertices
from jaxmark.geometry.pose import IDENTITY, Points, PointSets, Pose, similarity
from jaxmark.geometry.surfaces import Surface, sample
from jaxmark.seeds import Randomness

_SAMPLE_POINTS = 4000
_FIRST_SAMPLE_POINTS = 1000  # used to choose between mirror planes
_MIRROR_ROUNDS = 3
_CLOSEST_POINT_ROUNDS = 5  # in each of the rounds above
_MAX_MIRROR_DISTANCE = 0.02  # from the surface to its mirror image, in diagonals
_MAX_PART_RMS = 0.01  # distance between repeated parts, in diagonals of the part
_MIN_PART_VERTICES = 4  # triangles are too often similar
_PROCRUSTES_ROUNDS = 3


@on_host
def mirror_averaging(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Average the mesh with its mirror image.

    The mirror plane is the best of three through the centroid and perpendicular to the principal axes, each refined by
    closest points between the surface and its image. Vertices move towards the closest point of the image; those
    farther from it than 2 % of the diagonal have no counterpart and stay. The strength is the share of the way to the
    mean of mesh and image, in [0, 1]; 1 is half of the way to the image.

    Raises:
        JaxmarkError: if half of the surface is farther from the best mirror image than 2 % of the diagonal, or has no
            area.
    """
    check_share(strength, "the way to the mean", closed=True)
    if strength == 0:
        return mesh
    vertices, used = np.array(mesh.vertices, np.float64), used_vertices(mesh)
    middle, size = vertices[used].mean(axis=0), diagonal(mesh)
    there = (vertices - middle) / size
    surface = Surface(Mesh(there, np.asarray(mesh.faces)))
    mirror, off = _mirror(surface)
    if not off <= _MAX_MIRROR_DISTANCE:
        raise JaxmarkError(
            f"The mesh has no mirror symmetry: its best mirror image is {100 * off:.2g} % of the diagonal off in the"
            f" median, more than {100 * _MAX_MIRROR_DISTANCE:g} %."
        )
    way = mirror(surface.closest(mirror(there[used]))[0]) - there[used]
    way[np.linalg.norm(way, axis=1) > _MAX_MIRROR_DISTANCE] = 0
    vertices[used] += strength / 2 * size * way
    return Mesh(vertices, mesh.faces)


@on_host
def instance_averaging(mesh: Mesh, strength: float, seed: Randomness | None = None) -> Mesh:
    """Average parts of the mesh that repeat each other, such as screws, leaves or wheels.

    Connected parts repeat each other if their faces are the same once their vertices are numbered in the order in which
    faces use them, and if a similarity brings one to an RMS distance of at most 1 % of its diagonal from the other.
    Their mean shape (by generalised Procrustes analysis; Gower, Psychometrika 40, 1975) is put in the pose of each. The
    strength is the share of the way to the mean, in [0, 1].

    Raises:
        JaxmarkError: if no part of at least four vertices is repeated.
    """
    check_share(strength, "the way to the mean", closed=True)
    if strength == 0:
        return mesh
    vertices, alone = np.array(mesh.vertices, np.float64), True
    for parts in _repetitions(mesh):
        points = vertices[parts]
        vertices[parts] += strength * (_mean(points) - points)
        alone = False
    if alone:
        raise JaxmarkError("No part of the mesh is repeated; there is nothing to average over.")
    return Mesh(vertices, mesh.faces)


def _mirror(surface: Surface) -> tuple[Pose, float]:
    """Find the reflection that changes a surface least, and the median distance of reflected points from it."""
    points, normals, _ = sample(surface.mesh, _SAMPLE_POINTS)
    middle = points.mean(axis=0)
    axes = np.linalg.eigh((points - middle).T @ (points - middle))[1].T
    few, some = points[:_FIRST_SAMPLE_POINTS], normals[:_FIRST_SAMPLE_POINTS]
    ends = [_refine_mirror(surface, few, some, _reflection(axis, float(axis @ middle))) for axis in axes]
    best = min(ends, key=lambda end: _distance(surface, few, end))
    mirror = _refine_mirror(surface, points, normals, best)
    return mirror, _distance(surface, points, mirror)


def _refine_mirror(surface: Surface, points: Points, normals: Points, mirror: Pose) -> Pose:
    """Refine a mirror: fit a reflection to the pose of the image that closest points suggest, a few times."""
    for _ in range(_MIRROR_ROUNDS):
        image = mirror(points)
        pose = refine(surface, image, normals @ mirror.matrix, IDENTITY, rounds=_CLOSEST_POINT_ROUNDS)
        mirror = _fit_reflection(points, pose.inverse()(image))
    return mirror


def _distance(surface: Surface, points: Points, mirror: Pose) -> float:
    """Return the median distance of reflected points from the surface."""
    image = mirror(points)
    return float(np.median(np.linalg.norm(surface.closest(image)[0] - image, axis=1)))


def _reflection(normal: Float64[np.ndarray, "3"], offset: float) -> Pose:
    """Return the reflection across the plane normal · x = offset."""
    return Pose(np.eye(3) - 2 * np.outer(normal, normal), 2 * offset * normal)


def _fit_reflection(points: Points, images: Points) -> Pose:
    """Return the reflection that brings points closest to their images, in the least-squares sense.

    The sum of squares that remains is 4 nᵀ Σ x yᵀ n - count · (n · Δ)² plus a constant, for centred points x and images
    y whose means are Δ apart.
    """
    one, other = points.mean(axis=0), images.mean(axis=0)
    product = 4 * (points - one).T @ (images - other) - len(points) * np.outer(other - one, other - one)
    normal = np.linalg.eigh((product + product.T) / 2)[1][:, 0]
    return _reflection(normal, float(normal @ (one + other)) / 2)


def _repetitions(mesh: Mesh) -> Iterator[Int64[np.ndarray, "parts vertices"]]:
    """Yield the vertices of parts that repeat each other, one part per row, in corresponding order."""
    vertices = np.asarray(mesh.vertices, np.float64)
    for parts in _same_faces(mesh):
        left = parts
        while len(left) > 1:
            points = vertices[left]
            off = points - similarity(points[0], points)(points[0])
            size = np.linalg.norm(np.ptp(points, axis=1), axis=1)
            same = np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1)) < _MAX_PART_RMS * size
            same[0] = True  # also where it is a single point, which matches nothing
            if same.sum() > 1:
                yield left[same]
            left = left[~same]


def _same_faces(mesh: Mesh) -> Iterator[Int64[np.ndarray, "parts vertices"]]:
    """Yield the vertices of parts of the same connectivity, one part per row, in the order in which faces use them."""
    faces = np.asarray(mesh.faces, np.int64)
    label = component_of(mesh)[faces[:, 0]]
    order = np.argsort(label, kind="stable")
    alike: dict[bytes, list[np.ndarray]] = {}
    for part in np.split(faces[order], np.flatnonzero(np.diff(label[order])) + 1):
        number, first, place = np.unique(part, return_index=True, return_inverse=True)
        turn = np.argsort(first)
        rank = np.argsort(turn)
        if len(number) >= _MIN_PART_VERTICES:
            alike.setdefault(rank[place].tobytes(), []).append(number[turn])
    for parts in alike.values():
        yield np.stack(parts)


def _mean(points: PointSets) -> PointSets:
    """Return the mean shape of several sets of points, put in the pose of each."""
    mean = points[0]
    for _ in range(_PROCRUSTES_ROUNDS):
        mean = similarity(points, mean)(points).mean(axis=0)
    return similarity(mean, points)(mean)
