"""Poses that local shape suggests, for suspects of which much is missing; host side, deterministic, free of the key.

Points are described by how normals around them turn (Rusu, Blodow, Beetz, "Fast point feature histograms (FPFH) for 3D
registration", ICRA 2009). Points of both surfaces that are each other's likest are matched, and three matches with
equal ratios of distances make a pose (Fischler, Bolles, "Random sample consensus", 1981), which the others confirm.
"""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from jaxmark.mesh import Mesh, unit
from jaxmark.pose import Points, Pose, similarity
from jaxmark.surfaces import sample

_POINTS = 2500  # on the original, and as densely on the suspect
_RADIUS = 0.12  # of what is described around a point; the original is about one in size
_NEIGHBOURS, _BINS = 80, 11
_SHARES = 0.8 ** np.arange(8)  # of the original's area that the suspect may have
_TRIPLES = 20_000
_LEAST, _SAME, _NEAR = 0.1, 1.12, 0.03  # sides of a triangle, their ratios, and how far off a match is that confirms


def poses_by_features(original: Mesh, suspect: Mesh, count: int) -> list[Pose]:
    """The likeliest similarities that bring a suspect, whole or in part, onto an original.

    Args:
        original: about one in size.
        suspect: in any pose and scale, of a fifth of the original's area at least.
        count: how many poses.
    """
    target, source = sample(original, _POINTS), sample(suspect, _POINTS)
    wanted, random, found = descriptors(target.points, target.normals, _RADIUS), np.random.default_rng(0), []
    for share in _SHARES:
        # As densely as on the original, were that the suspect's share of it.
        points, normals = (array[: int(share * _POINTS)] for array in source[:2])
        scale = float(np.sqrt(share * target.area / source.area))
        here, there = _likest(descriptors(points, normals, _RADIUS / scale), wanted)
        found += _consensus(points[here], target.points[there], scale, random, count)
    return [pose for _, pose in sorted(found, key=lambda one: -one[0])[:count]]


def descriptors(points: Points, normals: Points, radius: float) -> Float64[np.ndarray, "points bins"]:
    """Fast point feature histograms: of three angles between normals, for each point and its neighbours."""
    found = KDTree(points).query(points, k=_NEIGHBOURS + 1, distance_upper_bound=radius)
    distance, other = (np.asarray(array)[:, 1:] for array in found)  # without the point itself
    near = np.isfinite(distance) & (distance > 0)
    other, distance = np.where(near, other, 0), np.where(near, distance, 1)
    towards = (points[other] - points[:, None]) / distance[..., None]
    u = np.broadcast_to(normals[:, None], towards.shape)
    v = unit(np.cross(towards, u))
    w, normal = np.cross(u, v), normals[other]
    angles = [
        np.sum(v * normal, axis=-1),
        np.sum(u * towards, axis=-1),
        np.arctan2(np.sum(w * normal, axis=-1), np.sum(u * normal, axis=-1)) / np.pi,
    ]
    histogram = np.zeros(len(points) * len(angles) * _BINS)
    for which, angle in enumerate(angles):
        part = np.clip((angle + 1) / 2 * _BINS, 0, _BINS - 1).astype(int) + which * _BINS
        place = part + len(angles) * _BINS * np.arange(len(points))[:, None]
        histogram += np.bincount(place[near], minlength=len(histogram))
    histogram = histogram.reshape(len(points), -1) / np.maximum(near.sum(axis=1, keepdims=True), 1)
    # And of the neighbours' own, the closer the more.
    weight = near / distance
    weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    return histogram + np.einsum("pk,pkb->pb", weight, histogram[other])


def _likest(
    first: Float64[np.ndarray, "first bins"], second: Float64[np.ndarray, "second bins"]
) -> tuple[Int64[np.ndarray, " matches"], Int64[np.ndarray, " matches"]]:
    """Which are each other's likest."""
    unlike = (first**2).sum(axis=1)[:, None] - 2 * first @ second.T + (second**2).sum(axis=1)
    forth, back = unlike.argmin(axis=1), unlike.argmin(axis=0)
    mutual = np.flatnonzero(back[forth] == np.arange(len(first)))
    return mutual, forth[mutual]


def _consensus(
    source: Points, target: Points, scale: float, random: np.random.Generator, count: int
) -> list[tuple[int, Pose]]:
    """Similarities of about a scale that bring many source points near their targets, and how many."""
    if len(source) < 3:
        return []
    triple = random.integers(len(source), size=(_TRIPLES, 3))
    a, b = source[triple], target[triple]
    sides = [np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1) for corners in (a, b)]
    sound = (sides[0].min(axis=1) > 0) & (sides[1].min(axis=1) > _LEAST)
    ratio = sides[1] / np.where(sides[0] > 0, sides[0], 1)
    sound &= (ratio.max(axis=1) < _SAME * ratio.min(axis=1)) & (np.abs(ratio.mean(axis=1) / scale - 1) < _SAME - 1)
    poses = similarity(a[sound], b[sound])
    near = np.sum(np.sum((poses(source) - target) ** 2, axis=-1) < _NEAR**2, axis=-1)
    best = np.argsort(-near, kind="stable")[:count]
    return [(int(near[one]), Pose(poses.matrix[one], poses.shift[one])) for one in best]
