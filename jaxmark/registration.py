"""The pose of a suspect of foreign connectivity, by its surface; host side, deterministic, free of the key.

Coarse: the principal axes of both surfaces in all 24 ways, each improved by trimmed closest points (Chetverikov et al.,
"Robust Euclidean alignment of 3D point sets: the trimmed iterative closest point algorithm", 2005), both ways, so that
a scale can be found. Fine: the best of them, by distances from the original's points to the suspect's surface along the
original's normals. Closest points on surfaces are libigl's, which agree with brute force at any scale of coordinates;
trimesh's do not, and its registration compares against an absolute threshold.
"""

from itertools import permutations, product
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Int64
from scipy.spatial import KDTree

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.mesh import Mesh, used_vertices, vertex_normals
from jaxmark.pose import IDENTITY, Points, Pose, similarity

_SAMPLES, _COARSE, _FINE = 20_000, 300, 2000
_TRIM = 0.8
_ROUNDS = 30
_LIKELY = 2.0  # poses that leave up to so many times the least distance are tried on


class Surface:
    """A mesh that answers where its closest points are."""

    def __init__(self, mesh: Mesh) -> None:
        """Raises JaxmarkError if libigl is missing."""
        igl: Any = require("igl", "align")
        self._vertices = np.ascontiguousarray(mesh.vertices, np.float64)
        self._faces = np.ascontiguousarray(mesh.faces, np.int64)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def closest(self, points: Points, pose: Pose = IDENTITY) -> tuple[Points, Int64[np.ndarray, " points"]]:
        """The closest points when the surface is in a pose (a similarity, or nearly), and on which faces they lie."""
        there = np.ascontiguousarray(pose.inverse()(points))
        _, face, closest = self._tree.squared_distance(self._vertices, self._faces, there)
        return pose(np.asarray(closest).reshape(-1, 3)), np.asarray(face).ravel().astype(np.int64)


def register(original: Mesh, suspect: Mesh) -> tuple[Pose, Surface]:
    """Find the similarity that brings a suspect's surface onto an original's.

    Args:
        original: of welded points, about one in size.
        suspect: in any pose and scale.

    Returns:
        The map from the suspect's coordinates to the original's, and the suspect's surface in its own coordinates.

    Raises:
        JaxmarkError: if libigl is missing, or a surface has no area.
    """
    surface = Surface(suspect)
    starts = _coarse(_sample(original), _sample(suspect))
    used = np.flatnonzero(used_vertices(original))
    some = used[np.random.default_rng(0).permutation(len(used))[:_FINE]]
    points, normals = np.asarray(original.vertices), vertex_normals(original)
    ends = [refine(surface, points[some], normals[some], start) for start in starts]
    best = ends[int(np.argmin([_distance(surface, points[some], end) for end in ends]))]
    return refine(surface, points[used], normals[used], best), surface


def _distance(surface: Surface, points: Points, pose: Pose) -> float:
    """How far half of the points are off at most."""
    return float(np.median(np.linalg.norm(surface.closest(points, pose)[0] - points, axis=1)))


def refine(surface: Surface, points: Points, normals: Points, pose: Pose, *, by_affine: bool = False) -> Pose:
    """Bring a surface closer to points along their normals, by a similarity or an affine map (Gauss-Newton)."""
    for _ in range(_ROUNDS):
        closest, _ = surface.closest(points, pose)
        distance = np.sum(normals * (closest - points), axis=1)
        near = np.abs(distance) <= 4 * np.median(np.abs(distance)) + 1e-12
        near &= np.linalg.norm(closest - points, axis=1) <= 2 * np.abs(distance) + 1e-6
        c, n, d = closest[near], normals[near], distance[near]
        if by_affine:
            columns = np.concatenate([(n[:, :, None] * c[:, None, :]).reshape(len(c), 9), n], axis=1)
        else:
            columns = np.concatenate([np.cross(c, n), np.sum(n * c, axis=1, keepdims=True), n], axis=1)
        step = np.linalg.lstsq(columns, -d, rcond=1e-9)[0]
        if by_affine:
            change = Pose(np.eye(3) + step[:9].reshape(3, 3), step[9:])
        else:
            skew = np.cross(np.eye(3), step[:3])  # skew @ c = step[:3] × c
            u, _, vt = np.linalg.svd(np.eye(3) + skew)
            change = Pose((1 + step[3]) * (u @ vt), step[4:])
        pose = pose.then(change)
        if np.abs(step).max() < 1e-9:
            break
    return pose


def _sample(mesh: Mesh) -> Points:
    """Points spread over a surface by area."""
    surface = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), process=False)
    if not 0 < surface.area < np.inf:
        raise JaxmarkError(f"A surface has an area of {surface.area:g}; nothing can be aligned with it.")
    return np.asarray(trimesh.sample.sample_surface(surface, _SAMPLES, seed=0)[0])


def _coarse(target: Points, source: Points) -> list[Pose]:
    """The likeliest poses."""
    forward, backward = KDTree(target), KDTree(source)
    ends = [
        _closest_points(start, target[:_COARSE], source[:_COARSE], forward, backward) for start in _axes(target, source)
    ]
    least = min(off for _, off in ends)
    return [
        _closest_points(pose, target[:_FINE], source[:_FINE], forward, backward)[0]
        for pose, off in ends
        if off <= _LIKELY * least
    ]


def _axes(target: Points, source: Points) -> list[Pose]:
    """Principal axes onto principal axes, in all ways that do not mirror."""
    frames, centres, sizes = [], [], []
    for points in (target, source):
        centres.append(points.mean(axis=0))
        centred = points - centres[-1]
        sizes.append(np.sqrt((centred**2).sum(axis=1).mean()))
        axes = np.linalg.eigh(centred.T @ centred)[1]
        frames.append(axes * [1, 1, np.sign(np.linalg.det(axes))])
    starts = []
    for order, signs in product(permutations(range(3)), product([1, -1], repeat=3)):
        change = np.eye(3)[list(order)] * signs
        if np.linalg.det(change) > 0:
            matrix = sizes[0] / sizes[1] * frames[0] @ change @ frames[1].T
            starts.append(Pose(matrix, centres[0] - matrix @ centres[1]))
    return starts


def _closest_points(
    pose: Pose, target: Points, source: Points, forward: KDTree, backward: KDTree
) -> tuple[Pose, float]:
    """Trimmed iterative closest points, both ways, with scale; and how far the closer ones are off in the end."""
    off = np.inf
    for _ in range(_ROUNDS):
        there, here = forward.query(pose(source)), backward.query(pose.inverse()(target))
        scale = np.cbrt(abs(np.linalg.det(pose.matrix)))
        pairs = [
            (source, forward.data[there[1]], there[0]),
            (backward.data[here[1]], target, here[0] * scale),
        ]
        kept = [(s[near], t[near], d[near]) for s, t, d in pairs for near in [d <= np.quantile(d, _TRIM)]]
        before, off = off, float(np.sqrt(np.mean(np.concatenate([d for *_, d in kept]) ** 2)))
        pose = similarity(np.concatenate([s for s, *_ in kept]), np.concatenate([t for _, t, _ in kept]))
        if off > 0.99 * before:
            break
    return pose, off
