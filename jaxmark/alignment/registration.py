"""Find the pose of a suspect of foreign connectivity by its surface; on the host, deterministic, without the key.

A whole suspect's principal axes are brought onto the original's in all 48 ways, of which half mirror, and what fits by
far the worst is left out. Each pose is improved by trimmed closest points (Chetverikov et al., "Robust Euclidean
alignment of 3D point sets: the trimmed iterative closest point algorithm", 2005), from either surface to the other, so
that the scale is determined. If several poses fit, those by local shape (`jaxmark.alignment.features`) are tried,
too, and turns about the axis of a round shape. A part is posed by local shape only. In both cases, the best pose
is refined by distances along normals; a pose that mirrors must fit clearly better than the best that does not.
trimesh's own registration is no alternative, because it compares against an absolute threshold.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxmark.alignment.features import EITHER, FEATURE_SETTINGS, FeatureSettings, poses_by_features
from jaxmark.geometry.mesh import unit
from jaxmark.geometry.pose import IDENTITY, Points, Pose, similarity
from jaxmark.geometry.surfaces import Geometry


@dataclass(frozen=True)
class RegistrationSettings:
    """Settings of registration; lengths are relative to an original that is about 1 in size."""

    samples: int = 20_000  # points sampled on each surface
    coarse_points: int = 300  # points on each surface by which the 48 first poses are improved and told apart
    rough_points: int = 500  # vertices of the original by which all candidate poses are refined
    fine_points: int = 2000  # points by which likely poses are improved, and the best ones refined and compared
    inlier_share: float = 0.8  # share of the closest pairs that a round of trimmed closest points keeps
    rounds: int = 30  # largest number of rounds of closest points, and of the final refinement
    comparison_rounds: int = 10  # rounds of refinement before poses are compared: enough to tell which one is the best
    reach: float = 0.03  # distances up to this count in the first round of refinement, however small the others are
    outlier_distance: float = 0.005  # points that are further off count as this far off when poses are compared
    first_ratio: float = 12.0  # of the first poses, those that leave up to this many times the least are improved
    likely_ratio: float = 2.0  # poses that leave up to this many times the least distance are pursued
    mirror_ratio: float = 1.05  # a pose that mirrors must leave so many times less than one that does not
    whole_distance: float = 0.01  # the most that a whole suspect's pose may leave, several times what sampling leaves
    # Of these, as many again may mirror.
    distinct_poses: int = 32  # most poses that are pursued, which differ by more than `whole_distance`
    best_poses: int = 4  # most poses that are refined by the fine points
    round_ratio: float = 1.1  # a shape with two principal axes of widths within this ratio is round about the third
    turn: float = 1.0  # in degrees, between the turns about the axis of a round shape
    turned_poses: int = 100  # most of these turns that are pursued, those that fit best
    feature_poses: int = 6  # most poses by local shape that are pursued
    features: FeatureSettings = FEATURE_SETTINGS


SETTINGS = RegistrationSettings()
Others = Float64[np.ndarray, "others 3"]  # points of a suspect, where those of an original are there, too


def register_whole(
    original: Geometry,
    suspect: Geometry,
    reflections: Sequence[bool] = EITHER,
    *,
    settings: RegistrationSettings = SETTINGS,
) -> Pose | None:
    """Find the similarity that brings a suspect's surface onto an original's.

    Args:
        original: the surface of the welded points, about 1 in size.
        suspect: in any pose and scale, with an area.
        reflections: whether the pose may be one that does not mirror (False), one that mirrors (True), or either.
        settings: see `RegistrationSettings`.

    Returns:
        The pose; None if much of the original is missing, or much else is beside it.

    Raises:
        JaxmarkError: if libigl is missing, or a surface has no area.
    """
    target, source = (shape.sample(settings.samples).points for shape in (original, suspect))
    starts = _coarse(target, source, settings)
    if not starts:
        return None
    points, normals = original.anchors()
    chosen = np.random.default_rng(0).permutation(len(points))[: settings.fine_points]
    ends = []
    for mirrored in reflections:
        alike = [start for start in starts if start.mirrors == mirrored]
        if len(alike) > 1:  # the principal axes of a shape that is nearly symmetric leave small features to decide
            count, features = settings.feature_poses, settings.features
            alike += poses_by_features(original, suspect, count, [mirrored], settings=features)
            alike += _turned(suspect, target, source, alike, settings)
        ends += _best(suspect, points[chosen], normals[chosen], alike, settings)[:1]
    if not ends:
        return None
    _, best = min(ends, key=lambda end: _unlikeliness(end[0], end[1], settings))
    return refine(suspect, points, normals, best, settings=settings)


def _best(
    surface: Geometry, points: Points, normals: Points, starts: list[Pose], settings: RegistrationSettings
) -> list[tuple[float, Pose]]:
    """Refine a surface's poses by few points, then the best of them by more; returns the distances that these leave."""
    ends: list[tuple[float, Pose]] = []
    for count in (settings.rough_points, settings.fine_points):
        few, rounds = slice(count), settings.comparison_rounds
        refined = [
            refine(surface, points[few], normals[few], start, rounds=rounds, settings=settings) for start in starts
        ]
        ends = sorted(((_distance(surface, points, pose, settings), pose) for pose in refined), key=lambda end: end[0])
        ends = ends[: settings.best_poses]
        starts = [pose for _, pose in ends]
    return ends


def register_part(
    original: Geometry,
    suspect: Geometry,
    reflections: Sequence[bool] = EITHER,
    *,
    settings: RegistrationSettings = SETTINGS,
) -> Pose | None:
    """Find the similarity that brings a suspect onto the part of the original that it shows, at least a fifth.

    Args and raises: see `register_whole`.

    Returns:
        The pose; None if local shape suggests none.
    """
    points, normals, _ = suspect.sample(settings.samples)
    fine, rounds = slice(settings.fine_points), settings.comparison_rounds
    ends = []
    for start in poses_by_features(original, suspect, settings.feature_poses, reflections, settings=settings.features):
        # Every point of a part has its place on the original, but not the other way round: the original is brought
        # onto the part, and that map is inverted.
        posed, along = start(points), unit(normals @ start.matrix.T)
        back = refine(original, posed[fine], along[fine], IDENTITY, rounds=rounds, settings=settings)
        ends.append((_distance(original, posed[fine], back, settings), start, back))
    if not ends:
        return None
    _, start, back = min(ends, key=lambda end: _unlikeliness(end[0], end[1], settings))
    along = unit(normals @ start.matrix.T)
    return start.then(refine(original, start(points), along, back, settings=settings).inverse())


def _unlikeliness(distance: float, pose: Pose, settings: RegistrationSettings) -> float:
    """The distance that a pose leaves, by which poses are compared.

    That of a pose that mirrors counts for more: where a shape is its own mirror image, either leaves no more than
    the mark.
    """
    return distance * (settings.mirror_ratio if pose.mirrors else 1)


def _distance(surface: Geometry, points: Points, pose: Pose, settings: RegistrationSettings) -> float:
    """Mean distance of points from a surface, where points that are lost count as a bounded distance."""
    distance = np.linalg.norm(surface.closest(points, pose)[0] - points, axis=1)
    return float(np.mean(np.minimum(distance, settings.outlier_distance)))


def refine(
    surface: Geometry,
    points: Points,
    normals: Points,
    pose: Pose,
    *,
    by_affine: bool = False,
    rounds: int | None = None,
    settings: RegistrationSettings = SETTINGS,
) -> Pose:
    """Bring a surface closer to points along their normals, by a similarity or an affine map (Gauss-Newton).

    Args:
        surface: the surface to be moved.
        points: the points that it is brought to.
        normals: unit normals at the points.
        pose: the surface's pose to begin with.
        by_affine: whether to fit an affine map instead of a similarity.
        rounds: largest number of rounds; that of the settings unless given.
        settings: the reach of the first round, and the number of rounds.

    Returns:
        The refined pose of the surface.
    """
    for number in range(settings.rounds if rounds is None else rounds):
        closest, _ = surface.closest(points, pose)
        distance = np.sum(normals * (closest - points), axis=1)
        # If most of a shape fits in many poses, the rest must decide: in the first rounds nearly all points count.
        near = np.abs(distance) <= max(4 * np.median(np.abs(distance)), settings.reach * 0.8**number) + 1e-12
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


def _coarse(target: Points, source: Others, settings: RegistrationSettings) -> list[Pose]:
    """Find the likeliest poses of either reflection by principal axes and closest points; none if all fit badly."""
    forward, backward = KDTree(target), KDTree(source)
    coarse, fine = slice(settings.coarse_points), slice(settings.fine_points)
    starts = poses_by_axes(target, source)
    first = [_closest_pairs(start, target[coarse], source[coarse], forward, backward, settings)[2] for start in starts]
    ends = [
        _closest_points(start, target[coarse], source[coarse], forward, backward, settings)
        for start, off in zip(starts, first, strict=True)
        if off <= settings.first_ratio * min(first)
    ]
    least = min(off for _, off in ends)
    improved = [
        _closest_points(pose, target[fine], source[fine], forward, backward, settings)
        for pose, off in ends
        if off <= min(settings.likely_ratio * least, settings.whole_distance)
    ]
    distinct: dict[bool, list[Pose]] = {False: [], True: []}
    for pose, _ in sorted(improved, key=lambda end: end[1]):
        posed, alike = pose(source[coarse]), distinct[pose.mirrors]
        squares = [np.mean(np.sum((other(source[coarse]) - posed) ** 2, axis=1)) for other in alike]
        if all(square > settings.whole_distance**2 for square in squares):
            alike.append(pose)
    return [pose for alike in distinct.values() for pose in alike[: settings.distinct_poses]]


def poses_by_axes(target: Points, source: Others) -> list[Pose]:
    """The poses that bring the source's principal axes onto the target's, in all 48 ways, of which half mirror."""
    (target_mean, wide, onto), (source_mean, size, of) = (_principal(points) for points in (target, source))
    starts = []
    for order, signs in product(permutations(range(3)), product([1, -1], repeat=3)):
        change = np.eye(3)[list(order)] * signs
        matrix = np.linalg.norm(wide) / np.linalg.norm(size) * onto @ change @ of.T
        starts.append(Pose(matrix, target_mean - matrix @ source_mean))
    return starts


def _turned(
    suspect: Geometry, target: Points, source: Others, starts: list[Pose], settings: RegistrationSettings
) -> list[Pose]:
    """Turn poses about the axis of a round shape, upright and upside down, and keep the turns that fit locally best.

    A wheel with teeth fits in as many poses as it has teeth.
    """
    (centre, wide, axes), (_, _, of) = _principal(target), _principal(source)
    ratio, points = settings.round_ratio, target[: settings.coarse_points]
    for column, is_round in ((0, wide[2] < ratio * wide[1]), (2, wide[1] < ratio * wide[0])):
        if not is_round:
            continue
        axis = axes[:, column]
        turns = Rotation.from_rotvec(np.arange(0, 360, settings.turn)[:, None] * axis, degrees=True).as_matrix()
        ends = []
        for upright in (True, False):
            same = [start for start in starts if (axis @ start.matrix @ of[:, column] > 0) == upright]
            if not same:
                continue
            best = min(same, key=lambda pose: _distance(suspect, points, pose, settings))
            turned = [best.then(Pose(turn, centre - turn @ centre)) for turn in turns]
            off = np.array([_distance(suspect, points, pose, settings) for pose in turned])
            least = np.flatnonzero((off <= np.roll(off, 1)) & (off <= np.roll(off, -1)))
            ends += [(off[place], turned[place]) for place in least]
        return [pose for _, pose in sorted(ends, key=lambda end: end[0])[: settings.turned_poses]]
    return []


def _principal(points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mean of points, their widths along the principal axes, ascending, and these axes as columns."""
    centre = points.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov((points - centre).T))
    return centre, np.sqrt(np.maximum(variance, 0)), axes * [1, 1, np.sign(np.linalg.det(axes))]


def _closest_points(
    pose: Pose, target: Points, source: Others, forward: KDTree, backward: KDTree, settings: RegistrationSettings
) -> tuple[Pose, float]:
    """Improve a similarity, which may mirror, by trimmed iterative closest points, from source to target and back.

    Returns:
        The pose, and the root mean square distance of the pairs that were kept in the last round.
    """
    off = np.inf
    for _ in range(settings.rounds):
        before = off
        points, places, off = _closest_pairs(pose, target, source, forward, backward, settings)
        pose = similarity(points, places, pose.mirrors)
        if off > 0.99 * before:
            break
    return pose, off


def _closest_pairs(
    pose: Pose, target: Points, source: Others, forward: KDTree, backward: KDTree, settings: RegistrationSettings
) -> tuple[Float64[np.ndarray, "pairs 3"], Float64[np.ndarray, "pairs 3"], float]:
    """Pair points with the closest ones of the other surface, and keep the closest pairs.

    Returns:
        The points of the source, those of the target, and their root mean square distance in the pose.
    """
    to_target, to_source = forward.query(pose(source)), backward.query(pose.inverse()(target))
    scale = np.cbrt(abs(np.linalg.det(pose.matrix)))
    pairs = [
        (source, forward.data[to_target[1]], to_target[0]),
        (backward.data[to_source[1]], target, to_source[0] * scale),
    ]
    share = settings.inlier_share
    kept = [(s[near], t[near], d[near]) for s, t, d in pairs for near in [d <= np.quantile(d, share)]]
    points, places, distance = (np.concatenate(arrays) for arrays in zip(*kept, strict=True))
    return points, places, float(np.sqrt(np.mean(distance**2)))
