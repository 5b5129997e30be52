"""Averages of what a shape repeats: the halves of a mirror symmetry, equal parts; on the host.

What was hidden in one of them and not in the others is averaged out.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64, Int64, PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, component_of, diagonal, used_vertices
from jaxmark.pose import IDENTITY, Points, PointSets, Pose, similarity
from jaxmark.registration import refine
from jaxmark.surfaces import Surface, sample

_SAMPLES, _SOME = 4000, 1000
_ROUNDS, _FEW = 3, 5
_NEAR = 0.02  # of the diagonal, that a mirror image may be off
_CONGRUENT = 0.01  # of the diagonal of a part, RMS, that another may be off
_LEAST = 4  # vertices of a part; triangles are all too similar


def mirror_averaging(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Average the mesh with its mirror image.

    The mirror plane is the best of those through the centroid across the principal axes, each refined by closest
    points between the surface and its image. Vertices go towards the closest point of the image; those that are farther
    from it than 2 % of the diagonal have no counterpart and stay.

    Args:
        mesh: any mesh, concrete.
        strength: share of the way to the mean of both, in [0, 1]; at 1, half of that to the image.
        key: not used; attacks share one signature.

    Returns:
        The mesh with moved vertices.

    Raises:
        JaxmarkError: if the share is outside [0, 1]; if half of the surface is farther from the best mirror image than
            2 % of the diagonal, or it has no area; if libigl is missing.
    """
    _check(strength)
    if strength == 0:
        return mesh
    vertices, used = np.array(mesh.vertices, np.float64), used_vertices(mesh)
    middle, size = vertices[used].mean(axis=0), diagonal(mesh)
    there = (vertices - middle) / size
    surface = Surface(Mesh(there, np.asarray(mesh.faces)))
    mirror, off = _mirror(surface)
    if not off <= _NEAR:
        raise JaxmarkError(
            f"The mesh has no mirror symmetry: its best mirror image is {100 * off:.2g} % of the diagonal off in the"
            f" median, more than {100 * _NEAR:g} %."
        )
    way = mirror(surface.closest(mirror(there[used]))[0]) - there[used]
    way[np.linalg.norm(way, axis=1) > _NEAR] = 0
    vertices[used] += strength / 2 * size * way
    return Mesh(vertices, mesh.faces)


def instance_averaging(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Average parts of the mesh that repeat each other: screws, leaves, wheels.

    Connected parts repeat each other if their faces are the same once their vertices are numbered in the order in which
    faces use them, and a similarity brings one to within 1 % of its diagonal, RMS, of the other. Their mean shape (by
    generalised Procrustes analysis; Gower, Psychometrika 40, 1975) takes the pose of each.

    Args:
        mesh: any mesh, concrete.
        strength: share of the way to the mean, in [0, 1].
        key: not used; attacks share one signature.

    Returns:
        The mesh with moved vertices.

    Raises:
        JaxmarkError: if the share is outside [0, 1], or no part of at least four vertices is repeated.
    """
    _check(strength)
    if strength == 0:
        return mesh
    vertices, alone = np.array(mesh.vertices, np.float64), True
    for parts in _repeated(mesh):
        points = vertices[parts]
        vertices[parts] += strength * (_mean(points) - points)
        alone = False
    if alone:
        raise JaxmarkError("No part of the mesh is repeated; there is nothing to average over.")
    return Mesh(vertices, mesh.faces)


def _check(strength: float) -> None:
    if not 0 <= strength <= 1:
        raise JaxmarkError(f"A share of the way to the mean is in [0, 1], got {strength:g}.")


def _mirror(surface: Surface) -> tuple[Pose, float]:
    """The mirror that changes a surface least, and how far it takes points off it, in the median."""
    points, normals, _ = sample(surface.mesh, _SAMPLES)
    middle = points.mean(axis=0)
    axes = np.linalg.eigh((points - middle).T @ (points - middle))[1].T
    starts = [_reflection(axis, float(axis @ middle)) for axis in axes]
    ends = [_improved(surface, points[:_SOME], normals[:_SOME], start) for start in starts]
    best = min(ends, key=lambda end: _distance(surface, points[:_SOME], end))
    mirror = _improved(surface, points, normals, best)
    return mirror, _distance(surface, points, mirror)


def _improved(surface: Surface, points: Points, normals: Points, mirror: Pose) -> Pose:
    """The mirror nearest to the pose that closest points suggest of the image."""
    for _ in range(_ROUNDS):
        image = mirror(points)
        pose = refine(surface, image, normals @ mirror.matrix, IDENTITY, rounds=_FEW)
        mirror = _between(points, pose.inverse()(image))
    return mirror


def _distance(surface: Surface, points: Points, mirror: Pose) -> float:
    """How far a mirror takes points off their surface, in the median."""
    image = mirror(points)
    return float(np.median(np.linalg.norm(surface.closest(image)[0] - image, axis=1)))


def _reflection(normal: Float64[np.ndarray, "3"], offset: float) -> Pose:
    """Across the plane normal · x = offset."""
    return Pose(np.eye(3) - 2 * np.outer(normal, normal), 2 * offset * normal)


def _between(points: Points, images: Points) -> Pose:
    """The reflection that brings points closest to others.

    What it leaves, squared and summed, is 4 nᵀ Σ x yᵀ n - count · (n · Δ)² and a constant, of centred points x and
    images y whose means are Δ apart.
    """
    one, other = points.mean(axis=0), images.mean(axis=0)
    product = 4 * (points - one).T @ (images - other) - len(points) * np.outer(other - one, other - one)
    normal = np.linalg.eigh((product + product.T) / 2)[1][:, 0]
    return _reflection(normal, float(normal @ (one + other)) / 2)


def _repeated(mesh: Mesh) -> Iterator[Int64[np.ndarray, "parts vertices"]]:
    """The vertices of parts that repeat each other, a part a row, in corresponding order."""
    vertices = np.asarray(mesh.vertices, np.float64)
    for parts in _same_faces(mesh):
        left = parts
        while len(left) > 1:
            points = vertices[left]
            off = points - similarity(points[0], points)(points[0])
            size = np.linalg.norm(np.ptp(points, axis=1), axis=1)
            same = np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1)) < _CONGRUENT * size
            same[0] = True  # also where it is a point, and so fits nothing
            if same.sum() > 1:
                yield left[same]
            left = left[~same]


def _same_faces(mesh: Mesh) -> Iterator[Int64[np.ndarray, "parts vertices"]]:
    """The vertices of parts of the same connectivity, in the order in which faces use them."""
    faces = np.asarray(mesh.faces, np.int64)
    label = component_of(mesh)[faces[:, 0]]
    order = np.argsort(label, kind="stable")
    alike: dict[bytes, list[np.ndarray]] = {}
    for part in np.split(faces[order], np.flatnonzero(np.diff(label[order])) + 1):
        number, first, place = np.unique(part, return_index=True, return_inverse=True)
        turn = np.argsort(first)
        rank = np.argsort(turn)
        if len(number) >= _LEAST:
            alike.setdefault(rank[place].tobytes(), []).append(number[turn])
    for parts in alike.values():
        yield np.stack(parts)


def _mean(points: PointSets) -> PointSets:
    """The mean shape of sets of points, in the pose of each."""
    mean = points[0]
    for _ in range(_ROUNDS):
        mean = similarity(points, mean)(points).mean(axis=0)
    return similarity(mean, points)(mean)
