"""Rigid registration of a remeshed suspect by its surface; on the host, deterministic, without the key.

For a whole suspect, the first poses map its principal axes to the original's in all 48 ways, half of which are
reflections; those that fit by far the worst are dropped. Each pose is refined by trimmed closest points (Chetverikov
et al., "Robust Euclidean alignment of 3D point sets: the trimmed iterative closest point algorithm", 2005), from either
surface to the other, so that the scale is determined. If several poses fit, poses by local shape
(`jaxmark.alignment.features`) and rotations about the axis of a round shape are tested, too.

For a part, the first poses are those by local shape only. In both cases, the best pose is refined by distances along
normals. A reflection must fit clearly better than the best rotation. The registration of trimesh is not used, because
it compares residuals with an absolute threshold.
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
    coarse_points: int = 300  # points on each surface for refining and comparing the 48 first poses
    rough_points: int = 500  # vertices of the original for refining all candidate poses
    fine_points: int = 2000  # points for refining likely poses, and for comparing the best ones
    inlier_share: float = 0.8  # fraction of the closest pairs that a round of trimmed closest points uses
    rounds: int = 30  # largest number of rounds of closest points, and of the final refinement
    comparison_rounds: int = 10  # rounds of refinement before poses are compared, enough to determine the best one
    reach: float = 0.03  # distances up to this are used in the first round of refinement, even if all others are small
    outlier_distance: float = 0.005  # larger distances are reduced to this one when poses are compared
    first_ratio: float = 12.0  # first poses are dropped if their distance exceeds this multiple of the least one
    likely_ratio: float = 2.0  # refined poses are dropped if their distance exceeds this multiple of the least one
    mirror_ratio: float = 1.05  # factor on the distance of a reflection when poses are compared
    poor_share: float = 0.8  # a part's pose is poor if its distance exceeds this fraction of `outlier_distance`
    whole_distance: float = 0.01  # largest distance of a whole suspect's pose, several times that of two samplings
    # The following numbers apply to rotations and to reflections separately.
    distinct_poses: int = 32  # most candidate poses, which differ by more than `whole_distance`
    best_poses: int = 4  # most poses that are refined by the fine points
    round_ratio: float = 1.1  # a shape is round about an axis if its widths along the other two have at most this ratio
    turn: float = 1.0  # in degrees, step of the rotations about the axis of a round shape
    turned_poses: int = 100  # most of these rotations that become candidates, the ones that fit best
    feature_poses: int = 6  # most poses by local shape that become candidates
    features: FeatureSettings = FEATURE_SETTINGS


SETTINGS = RegistrationSettings()
Others = Float64[np.ndarray, "others 3"]  # points of a suspect, in contrast to those of an original


def register_whole(
    original: Geometry,
    suspect: Geometry,
    reflections: Sequence[bool] = EITHER,
    *,
    settings: RegistrationSettings = SETTINGS,
) -> Pose | None:
    """Find the similarity that maps a suspect's surface to an original's.

    Args:
        original: the surface of the welded points, about 1 in size.
        suspect: the suspect in any pose and scale; its area must not be 0.
        reflections: whether the pose may be a rotation (False), a reflection (True), or either.
        settings: see `RegistrationSettings`.

    Returns:
        The pose; None if large parts of the original are missing, or the suspect has large other parts.

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
        if len(alike) > 1:  # for a nearly symmetric shape, small features must decide between poses by principal axes
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
    """Refine a surface's poses by few points, then the best poses by more points; returns distances and poses."""
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
    """Find the similarity that maps a suspect to the part of the original that it covers, at least a fifth.

    Args and raises: see `register_whole`.

    Returns:
        The pose; None if local shape suggests none.
    """
    points, normals, _ = suspect.sample(settings.samples)
    fine, rounds = slice(settings.fine_points), settings.comparison_rounds
    ends = []
    for start in poses_by_features(original, suspect, settings.feature_poses, reflections, settings=settings.features):
        # Every point of the part has a corresponding point on the original, but not vice versa. Therefore the original
        # is registered to the part, and the map is inverted.
        posed, along = start(points), unit(normals @ start.matrix.T)
        back = refine(original, posed[fine], along[fine], IDENTITY, rounds=rounds, settings=settings)
        ends.append((_distance(original, posed[fine], back, settings), start, back))
    if not ends:
        return None
    distance, start, back = min(ends, key=lambda end: _unlikeliness(end[0], end[1], settings))
    # A poor pose gets no better by more points, which take most of the time.
    used = fine if distance > settings.poor_share * settings.outlier_distance else slice(None)
    along = unit(normals[used] @ start.matrix.T)
    return start.then(refine(original, start(points[used]), along, back, settings=settings).inverse())


def _unlikeliness(distance: float, pose: Pose, settings: RegistrationSettings) -> float:
    """Return the distance of a pose with a penalty for reflections, for the comparison of poses.

    A shape that is its own mirror image fits both as a rotation and as a reflection, up to the mark.
    """
    return distance * (settings.mirror_ratio if pose.mirrors else 1)


def _distance(surface: Geometry, points: Points, pose: Pose, settings: RegistrationSettings) -> float:
    """Compute the mean distance of points from a surface; distances of missing points are bounded."""
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
    """Register a surface to points by their distances along normals (Gauss-Newton).

    Args:
        surface: the surface to be moved.
        points: the points to which it is registered.
        normals: unit normals at the points.
        pose: the surface's initial pose.
        by_affine: whether to fit an affine map instead of a similarity.
        rounds: largest number of rounds; by default `settings.rounds`.
        settings: the reach of the first round, and the number of rounds.

    Returns:
        The refined pose of the surface.
    """
    for number in range(settings.rounds if rounds is None else rounds):
        closest, _ = surface.closest(points, pose)
        distance = np.sum(normals * (closest - points), axis=1)
        # If most of a shape fits in many poses, the rest must decide. Therefore the first rounds use nearly all points.
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
    """Find the likeliest rotations and reflections by principal axes and closest points; none if all fit badly."""
    forward, backward = KDTree(target), KDTree(source)
    coarse, fine = slice(settings.coarse_points), slice(settings.fine_points)
    starts = poses_by_axes(target, source)
    first = [_closest_pairs(start, target[coarse], source[coarse], forward, backward, settings)[2] for start in starts]
    ends = [
        _closest_points(start, target[coarse], source[coarse], forward, backward, settings)
        for start, distance in zip(starts, first, strict=True)
        if distance <= settings.first_ratio * min(first)
    ]
    least = min(distance for _, distance in ends)
    improved = [
        _closest_points(pose, target[fine], source[fine], forward, backward, settings)
        for pose, distance in ends
        if distance <= min(settings.likely_ratio * least, settings.whole_distance)
    ]
    distinct: dict[bool, list[Pose]] = {False: [], True: []}
    for pose, _ in sorted(improved, key=lambda end: end[1]):
        posed, alike = pose(source[coarse]), distinct[pose.mirrors]
        squares = [np.mean(np.sum((other(source[coarse]) - posed) ** 2, axis=1)) for other in alike]
        if all(square > settings.whole_distance**2 for square in squares):
            alike.append(pose)
    return [pose for alike in distinct.values() for pose in alike[: settings.distinct_poses]]


def poses_by_axes(target: Points, source: Others) -> list[Pose]:
    """Compute the 48 poses that map the source's principal axes to the target's; half of them are reflections."""
    (target_mean, target_widths, target_axes), (source_mean, source_widths, source_axes) = (
        _principal(points) for points in (target, source)
    )
    starts = []
    for order, signs in product(permutations(range(3)), product([1, -1], repeat=3)):
        change = np.eye(3)[list(order)] * signs
        scale = np.linalg.norm(target_widths) / np.linalg.norm(source_widths)
        matrix = scale * target_axes @ change @ source_axes.T
        starts.append(Pose(matrix, target_mean - matrix @ source_mean))
    return starts


def _turned(
    suspect: Geometry, target: Points, source: Others, starts: list[Pose], settings: RegistrationSettings
) -> list[Pose]:
    """Rotate poses about the axis of a round shape, upright and upside down, and return the local optima.

    A gear, for example, fits in as many poses as it has teeth.
    """
    (centre, widths, axes), (_, _, source_axes) = _principal(target), _principal(source)
    ratio, points = settings.round_ratio, target[: settings.coarse_points]
    for column, is_round in ((0, widths[2] < ratio * widths[1]), (2, widths[1] < ratio * widths[0])):
        if not is_round:
            continue
        axis = axes[:, column]
        turns = Rotation.from_rotvec(np.arange(0, 360, settings.turn)[:, None] * axis, degrees=True).as_matrix()
        ends = []
        for upright in (True, False):
            same = [start for start in starts if (axis @ start.matrix @ source_axes[:, column] > 0) == upright]
            if not same:
                continue
            best = min(same, key=lambda pose: _distance(suspect, points, pose, settings))
            turned = [best.then(Pose(turn, centre - turn @ centre)) for turn in turns]
            distance = np.array([_distance(suspect, points, pose, settings) for pose in turned])
            minima = np.flatnonzero((distance <= np.roll(distance, 1)) & (distance <= np.roll(distance, -1)))
            ends += [(distance[place], turned[place]) for place in minima]
        return [pose for _, pose in sorted(ends, key=lambda end: end[0])[: settings.turned_poses]]
    return []


def _principal(points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the mean of points, their widths along the principal axes, ascending, and the axes as columns."""
    centre = points.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov((points - centre).T))
    return centre, np.sqrt(np.maximum(variance, 0)), axes * [1, 1, np.sign(np.linalg.det(axes))]


def _closest_points(
    pose: Pose, target: Points, source: Others, forward: KDTree, backward: KDTree, settings: RegistrationSettings
) -> tuple[Pose, float]:
    """Refine a rotation or reflection by trimmed iterative closest points, from source to target and back.

    Returns:
        The pose, and the root mean square distance of the pairs that were used in the last round.
    """
    distance = np.inf
    for _ in range(settings.rounds):
        before = distance
        points, places, distance = _closest_pairs(pose, target, source, forward, backward, settings)
        pose = similarity(points, places, pose.mirrors)
        if distance > 0.99 * before:
            break
    return pose, distance


def _closest_pairs(
    pose: Pose, target: Points, source: Others, forward: KDTree, backward: KDTree, settings: RegistrationSettings
) -> tuple[Float64[np.ndarray, "pairs 3"], Float64[np.ndarray, "pairs 3"], float]:
    """Pair points with the closest points of the other surface, and select the closest pairs.

    Returns:
        The source points, the target points, and the root mean square distance of the selected pairs in the pose.
    """
    to_target = forward.query(pose(source))
    to_source = backward.query(pose.inverse()(target))
    scale = pose.scale
    pairs = [
        (source, forward.data[to_target[1]], to_target[0]),
        (backward.data[to_source[1]], target, to_source[0] * scale),
    ]
    share = settings.inlier_share
    closest = [(s[near], t[near], d[near]) for s, t, d in pairs for near in [d <= np.quantile(d, share)]]
    points, places, distance = (np.concatenate(arrays) for arrays in zip(*closest, strict=True))
    return points, places, float(np.sqrt(np.mean(distance**2)))
