"""Candidate poses by local shape descriptors, for cropped suspects; on the host, deterministic, without the key.

Points are described by histograms of the angles between the normals around them (Rusu, Blodow, Beetz, "Fast point
feature histograms (FPFH) for 3D registration", ICRA 2009). Points of the two surfaces are matched if their descriptors
are mutually nearest. Three matches whose distances have equal ratios determine a pose (Fischler, Bolles, "Random sample
consensus", 1981), and other matches confirm it. The descriptors of a reflected surface are a permutation of those of
the surface.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree

from jaxmark.geometry.mesh import unit
from jaxmark.geometry.pose import Points, Pose, similarity
from jaxmark.geometry.surfaces import Geometry


@dataclass(frozen=True)
class FeatureSettings:
    """Settings of `poses_by_features`; lengths are relative to an original that is about 1 in size."""

    points: int = 2500  # points sampled on the original; the suspect is sampled with the same density
    radius: float = 0.12  # radius of the neighbourhood that a descriptor describes
    neighbours: int = 80  # largest number of points in a neighbourhood; the nearest ones are used
    bins: int = 11  # histogram bins for each of the three angles
    shares: int = 8  # number of assumed ratios of the suspect's area to the original's: 1, 0.8, 0.64 … 0.21
    share_ratio: float = 0.8  # quotient of successive area ratios
    triples: int = 20_000  # random triples of matches that are tested as poses
    min_side: float = 0.1  # shortest side of a triple's triangle on the original; small triangles give inaccurate poses
    max_side_ratio: float = 1.12  # largest ratio of the scales of two sides; and of their mean to the expected scale
    max_distance: float = 0.03  # largest distance between the two points of a match that confirms a pose


FEATURE_SETTINGS = FeatureSettings()
EITHER = (False, True)  # both rotations (False) and reflections (True)


def poses_by_features(
    original: Geometry,
    suspect: Geometry,
    count: int,
    reflections: Sequence[bool] = EITHER,
    *,
    settings: FeatureSettings = FEATURE_SETTINGS,
) -> list[Pose]:
    """Find the similarities that most likely map a suspect, whole or in part, to an original.

    Args:
        original: the original's shape, about 1 in size.
        suspect: the suspect in any pose and scale, with at least a fifth of the original's area.
        count: largest number of rotations, and largest number of reflections.
        reflections: which poses are searched for: reflections (True), rotations (False), or both.
        settings: see `FeatureSettings`.

    Returns:
        The poses, in the order of `reflections`, each kind by descending number of matches that confirm them.
    """
    target, source = original.sample(settings.points), suspect.sample(settings.points)
    target_descriptors = descriptors(target.points, target.normals, settings.radius, settings=settings)
    random = {mirrored: np.random.default_rng(0) for mirrored in reflections}
    candidates: dict[bool, list[tuple[int, Pose]]] = {mirrored: [] for mirrored in reflections}
    for share in settings.share_ratio ** np.arange(settings.shares):
        # With so many points, the density is that on the original, if the suspect has this share of the original's
        # area.
        points, normals = (array[: int(share * settings.points)] for array in source[:2])
        scale = float(np.sqrt(share * target.area / source.area))
        source_descriptors = descriptors(points, normals, settings.radius / scale, settings=settings)
        for mirrored in reflections:
            for variant in _reflected(source_descriptors) if mirrored else (source_descriptors,):
                on_source, on_target = _mutually_nearest(variant, target_descriptors)
                matches = points[on_source], target.points[on_target]
                candidates[mirrored] += _consensus(*matches, scale, mirrored, random[mirrored], count, settings)
    return [pose for poses in candidates.values() for _, pose in sorted(poses, key=lambda scored: -scored[0])[:count]]


def descriptors(
    points: Points, normals: Points, radius: float, *, settings: FeatureSettings = FEATURE_SETTINGS
) -> Float64[np.ndarray, "points bins"]:
    """Compute fast point feature histograms: of three angles between the normals of each point and its neighbours.

    Args:
        points: points sampled on a surface.
        normals: unit normals at the points.
        radius: radius of neighbourhoods, in the units of the points.
        settings: the number of neighbours and of bins.
    """
    bins = settings.bins
    nearest = KDTree(points).query(points, k=settings.neighbours + 1, distance_upper_bound=radius, workers=-1)
    distance, other = (np.asarray(array)[:, 1:] for array in nearest)  # without the point itself
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
    histogram = np.zeros(len(points) * len(angles) * bins)
    for which, angle in enumerate(angles):
        part = np.clip((angle + 1) / 2 * bins, 0, bins - 1).astype(int) + which * bins
        place = part + len(angles) * bins * np.arange(len(points))[:, None]
        histogram += np.bincount(place[near], minlength=len(histogram))
    histogram = histogram.reshape(len(points), -1) / np.maximum(near.sum(axis=1, keepdims=True), 1)
    # The mean of the neighbours' histograms, weighted by inverse distance, is added.
    weight = near / distance
    weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), np.finfo(float).tiny)
    return histogram + np.einsum("pk,pkb->pb", weight, histogram[other])


def _reflected(
    described: Float64[np.ndarray, "points bins"],
) -> tuple[Float64[np.ndarray, "points bins"], Float64[np.ndarray, "points bins"]]:
    """Compute the descriptors of the reflected surface, with its faces reversed, so that normals stay outside, or not.

    The reflection changes the sign of the angle out of the plane of normal and neighbour. Reversed normals change the
    signs of the other two angles.
    """
    angles = described.reshape(len(described), 3, -1)
    outside = np.concatenate([angles[:, :1, ::-1], angles[:, 1:]], axis=1)
    return outside.reshape(described.shape), angles[:, :, ::-1].reshape(described.shape)


def _mutually_nearest(
    first: Float64[np.ndarray, "first bins"], second: Float64[np.ndarray, "second bins"]
) -> tuple[Int64[np.ndarray, " matches"], Int64[np.ndarray, " matches"]]:
    """Match the descriptors that are mutually nearest; returns the indices of both."""
    square = (first**2).sum(axis=1)[:, None] - 2 * first @ second.T + (second**2).sum(axis=1)
    forth, back = square.argmin(axis=1), square.argmin(axis=0)
    mutual = np.flatnonzero(back[forth] == np.arange(len(first)))
    return mutual, forth[mutual]


def _consensus(
    source: Points,
    target: Points,
    scale: float,
    mirrored: bool,
    random: np.random.Generator,
    count: int,
    settings: FeatureSettings,
) -> list[tuple[int, Pose]]:
    """Find similarities with about a given scale that map many source points near their targets; count these points."""
    if len(source) < 3:
        return []
    triple = random.integers(len(source), size=(settings.triples, 3))
    a, b = source[triple], target[triple]
    sides = [np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1) for corners in (a, b)]
    sound = (sides[0].min(axis=1) > 0) & (sides[1].min(axis=1) > settings.min_side)
    ratio, most = sides[1] / np.where(sides[0] > 0, sides[0], 1), settings.max_side_ratio
    sound &= (ratio.max(axis=1) < most * ratio.min(axis=1)) & (np.abs(ratio.mean(axis=1) / scale - 1) < most - 1)
    poses = similarity(a[sound], b[sound], mirrored)
    near = np.sum(np.sum((poses(source) - target) ** 2, axis=-1) < settings.max_distance**2, axis=-1)
    best = np.argsort(-near, kind="stable")[:count]
    return [(int(near[index]), Pose(poses.matrix[index], poses.shift[index])) for index in best]
