"""The pose of a suspect of foreign connectivity, by its surface; host side, deterministic, free of the key.

Whole suspects: the principal axes of both surfaces in all 24 ways, each improved by trimmed closest points (Chetverikov
et al., "Robust Euclidean alignment of 3D point sets: the trimmed iterative closest point algorithm", 2005), both ways,
so that a scale can be found; where several fit, also poses that local shape suggests (`jaxmark.features`), and all
turns about the axis of what is round. Parts: poses by local shape only. Either way the best is refined by distances
along normals. trimesh's own registration compares against an absolute threshold.
"""

from itertools import permutations, product

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxmark.features import poses_by_features
from jaxmark.mesh import unit, used_vertices, vertex_normals
from jaxmark.pose import IDENTITY, Points, Pose, similarity
from jaxmark.surfaces import Surface, sample

_SAMPLES, _COARSE, _SOME, _FINE = 20_000, 300, 500, 2000
_TRIM = 0.8
_ROUNDS, _FEW = 30, 10  # few are enough to tell which pose is the best
_REACH = 0.03  # of the distances that count in the first round of refinement
_LOST = 0.005  # what a point that is far off counts, when poses are compared
_LIKELY = 2.0  # poses that leave up to so many times the least distance are tried on
_WHOLE = 0.01  # the most that the best pose of a whole suspect leaves: several times what sampling does
_MOST, _BEST = 32, 4  # of them that differ, and that are looked at closely
_ROUND = 1.1  # a shape that is so much wider along one axis than along another is round about the third
_TURN, _TURNS = 1.0, 100  # degrees, and how many that fit are tried on
_CANDIDATES = 6  # poses by features that are tried on


def register_whole(original: Surface, suspect: Surface) -> Pose | None:
    """The similarity that brings a suspect's surface onto an original's; None where much is missing, or beside it.

    Args:
        original: of welded points, about one in size.
        suspect: in any pose and scale, with an area.

    Raises:
        JaxmarkError: if libigl is missing.
    """
    target, source = sample(original.mesh, _SAMPLES).points, sample(suspect.mesh, _SAMPLES).points
    starts = _coarse(target, source)
    if not starts:
        return None
    used = np.flatnonzero(used_vertices(original.mesh))
    some = used[np.random.default_rng(0).permutation(len(used))[:_FINE]]
    points, normals = np.asarray(original.mesh.vertices), vertex_normals(original.mesh)
    if len(starts) > 1:  # principal axes say little of a shape that turns into itself, but for small features
        starts += poses_by_features(original.mesh, suspect.mesh, _CANDIDATES)
        starts += _turned(suspect, target, source, starts)
    for count in (_SOME, _FINE):
        part = some[:count]
        ends = [refine(suspect, points[part], normals[part], start, rounds=_FEW) for start in starts]
        starts = sorted(ends, key=lambda end: _distance(suspect, points[some], end))[:_BEST]
    return refine(suspect, points[used], normals[used], starts[0])


def register_part(original: Surface, suspect: Surface) -> Pose | None:
    """The same where the suspect is a part of the original, a fifth at least; None where no pose suggests itself."""
    points, normals, _ = sample(suspect.mesh, _SAMPLES)
    ends = []
    for start in poses_by_features(original.mesh, suspect.mesh, _CANDIDATES):
        # Every point of a part has its place on the original, but not the other way round: the original is brought
        # onto the part, and back.
        there, along = start(points), unit(normals @ start.matrix.T)
        back = refine(original, there[:_FINE], along[:_FINE], IDENTITY, rounds=_FEW)
        ends.append((_distance(original, there[:_FINE], back), start, back))
    if not ends:
        return None
    _, start, back = min(ends, key=lambda end: end[0])
    return start.then(refine(original, start(points), unit(normals @ start.matrix.T), back).inverse())


def _distance(surface: Surface, points: Points, pose: Pose) -> float:
    """How far points are off in the mean, those that are lost by no more than a little."""
    return float(np.mean(np.minimum(np.linalg.norm(surface.closest(points, pose)[0] - points, axis=1), _LOST)))


def refine(
    surface: Surface, points: Points, normals: Points, pose: Pose, *, by_affine: bool = False, rounds: int = _ROUNDS
) -> Pose:
    """Bring a surface closer to points along their normals, by a similarity or an affine map (Gauss-Newton)."""
    for one in range(rounds):
        closest, _ = surface.closest(points, pose)
        distance = np.sum(normals * (closest - points), axis=1)
        # Where most of a shape fits in many poses, the rest must tell: at first nearly all counts.
        near = np.abs(distance) <= max(4 * np.median(np.abs(distance)), _REACH * 0.8**one) + 1e-12
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


def _coarse(target: Points, source: Points) -> list[Pose]:
    """The likeliest poses that differ, if any will do."""
    forward, backward = KDTree(target), KDTree(source)
    ends = [
        _closest_points(start, target[:_COARSE], source[:_COARSE], forward, backward) for start in _axes(target, source)
    ]
    least = min(off for _, off in ends)
    fine = [
        _closest_points(pose, target[:_FINE], source[:_FINE], forward, backward)
        for pose, off in ends
        if off <= min(_LIKELY * least, _WHOLE)
    ]
    different: list[Pose] = []
    for pose, _ in sorted(fine, key=lambda end: end[1]):
        there = pose(source[:_COARSE])
        if all(np.mean(np.sum((other(source[:_COARSE]) - there) ** 2, axis=1)) > _WHOLE**2 for other in different):
            different.append(pose)
    return different[:_MOST]


def _axes(target: Points, source: Points) -> list[Pose]:
    """Principal axes onto principal axes, in all ways that do not mirror."""
    (to, wide, onto), (back, size, of) = (_principal(points) for points in (target, source))
    starts = []
    for order, signs in product(permutations(range(3)), product([1, -1], repeat=3)):
        change = np.eye(3)[list(order)] * signs
        if np.linalg.det(change) > 0:
            matrix = np.linalg.norm(wide) / np.linalg.norm(size) * onto @ change @ of.T
            starts.append(Pose(matrix, to - matrix @ back))
    return starts


def _turned(suspect: Surface, target: Points, source: Points, starts: list[Pose]) -> list[Pose]:
    """Turns about the axis of a shape that is round about it, upright and upside down, that fit better than those near.

    The teeth of a wheel fit in many places.
    """
    (centre, wide, axes), (_, _, of) = _principal(target), _principal(source)
    for one, near in ((0, wide[2] < _ROUND * wide[1]), (2, wide[1] < _ROUND * wide[0])):
        if not near:
            continue
        axis, some = axes[:, one], target[:_COARSE]
        turns = Rotation.from_rotvec(np.arange(0, 360, _TURN)[:, None] * axis, degrees=True).as_matrix()
        ends = []
        for side in (True, False):
            same = [start for start in starts if (axis @ start.matrix @ of[:, one] > 0) == side]
            if not same:
                continue
            best = min(same, key=lambda pose: _distance(suspect, some, pose))
            turned = [best.then(Pose(turn, centre - turn @ centre)) for turn in turns]
            off = np.array([_distance(suspect, some, pose) for pose in turned])
            least = np.flatnonzero((off <= np.roll(off, 1)) & (off <= np.roll(off, -1)))
            ends += [(off[place], turned[place]) for place in least]
        return [pose for _, pose in sorted(ends, key=lambda end: end[0])[:_TURNS]]
    return []


def _principal(points: Points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mean, how wide the points spread along each axis, least first, and the axes as columns."""
    centre = points.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov((points - centre).T))
    return centre, np.sqrt(np.maximum(variance, 0)), axes * [1, 1, np.sign(np.linalg.det(axes))]


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
