"""Bring a part of a shape onto many originals, to tell which of those that look alike it was cut from.

Local shape gives poses of the part on a few originals of different shape (`jaxmark.alignment.features`). Near
duplicates have much the same frame, so that the poses which fit best are tried on all candidates, and improved by
trimmed distances along normals (Chetverikov et al. 2005) to the points that the catalogue keeps. The scale may change
by a tenth only: anything fits when it is small enough.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from jaxmark.alignment.features import poses_by_features
from jaxmark.alignment.registration import poses_by_axes
from jaxmark.catalogue import descriptors
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Points, Pose
from jaxmark.geometry.surfaces import Surface

_SAMPLES = 300  # points of the part
_POSES = 3  # of each hand and reference
_KEPT_POSES = 3  # that are tried on all candidates
_ROUNDS, _FIRST_ROUNDS = 10, 4
_WHOLE_REFERENCES = 2  # originals by which poses of a whole shape are found
_KEPT_SHARE = 0.8  # of the closest pairs in each round
_COUNTED_SHARE = 0.9  # of distances in the result
_FAR = 0.15  # the most that a distance counts, in an original's mean distances to its centre
_MOST_SCALING = 1.1
_NEIGHBOURS = 10  # points that a normal is fitted to
_UNIT = 3.0  # an original is about this large in mean distances to its centre


class Target:
    """The points that are kept of an original, and planes through them."""

    def __init__(self, points: Points) -> None:
        self.points, self.tree = points, KDTree(points)
        near = points[self.tree.query(points, _NEIGHBOURS)[1]]
        away = near - near.mean(axis=1, keepdims=True)
        self.normals = np.linalg.eigh(np.einsum("pki,pkj->pij", away, away))[1][:, :, 0]

    def fit(self, part: Points, pose: Pose, rounds: int = _ROUNDS) -> tuple[float, Pose]:
        """Improve a part's pose; returns the distance that it leaves, and the pose, never a worse one."""
        first, start = (self.off(part, pose), pose), _scale(pose)
        scale = start
        for _ in range(rounds):
            posed = pose(part)
            off, near = map(np.asarray, self.tree.query(posed))
            kept = off <= np.quantile(off, _KEPT_SHARE)
            at, along = posed[kept], self.normals[near[kept]]
            height = np.sum((at - self.points[near[kept]]) * along, axis=1)
            columns = np.concatenate([np.cross(at, along), np.sum(along * at, axis=1, keepdims=True), along], axis=1)
            step = np.linalg.lstsq(columns, -height, rcond=1e-9)[0]
            u, _, vt = np.linalg.svd(np.eye(3) + np.cross(np.eye(3), step[:3]))
            grown = float(np.clip(scale * (1 + step[3]), start / _MOST_SCALING, start * _MOST_SCALING)) / scale
            pose, scale = pose.then(Pose(grown * (u @ vt), step[4:])), scale * grown
            if np.abs(step).max() < 1e-4:
                break
        return min(first, (self.off(part, pose), pose), key=lambda end: end[0])

    def off(self, part: Points, pose: Pose) -> float:
        """The mean distance of a part's points in a pose from the planes, without the largest."""
        posed = pose(part)
        off, near = map(np.asarray, self.tree.query(posed))
        height = np.abs(np.sum((posed - self.points[near]) * self.normals[near], axis=1))
        height = np.sort(np.where(off > _FAR, _FAR, height))
        return float(height[: max(1, int(_COUNTED_SHARE * len(height)))].mean())


def fit_part(
    part: Mesh, references: Sequence[Mesh], candidates: Sequence[Points]
) -> Float64[np.ndarray, " candidates"]:
    """Find how well a part fits each of many originals: the distance that it leaves, in mean distances to the centre.

    Args:
        part: with an extent.
        references: a few of the originals, by which poses are found.
        candidates: points kept of each original, from `descriptors.few_points`.
    """
    seen = descriptors.spread(part, _SAMPLES)
    if seen is None or not len(part.faces):
        return np.full(len(candidates), np.inf)
    found: list[tuple[float, Pose]] = []
    for reference in references:
        points, centre, size = descriptors.centred(reference)
        target = Target(points)
        unit = Mesh((np.asarray(reference.vertices) - centre) / (size * _UNIT), reference.faces)
        for pose in poses_by_features(Surface(unit), Surface(part), _POSES):
            found.append(target.fit(seen.points, Pose(_UNIT * pose.matrix, _UNIT * pose.shift)))
    return _tried_on_all(seen.points, found, candidates)


def _tried_on_all(
    points: Points, found: list[tuple[float, Pose]], candidates: Sequence[Points]
) -> Float64[np.ndarray, " candidates"]:
    """The least distance that the best of some poses leave on each original."""
    poses = [pose for _, pose in sorted(found, key=lambda end: end[0])[:_KEPT_POSES]]
    off = np.full(len(candidates), np.inf)
    for place, kept in enumerate(candidates):
        target = Target(kept)
        off[place] = min((target.fit(points, pose)[0] for pose in poses), default=np.inf)
    return off


def fit_whole(shape: Mesh, candidates: Sequence[Points]) -> Float64[np.ndarray, " candidates"]:
    """Find how well a whole shape fits each of several originals, the likeliest first; see `fit_part`.

    Its principal axes are brought onto those of the first ones.
    """
    seen = descriptors.spread(shape, _SAMPLES)
    if seen is None:
        return np.full(len(candidates), np.inf)
    few, found = seen.points, []
    for points in candidates[:_WHOLE_REFERENCES]:
        target = Target(points)
        starts = poses_by_axes(points, few)
        found += [target.fit(few, pose, rounds=_FIRST_ROUNDS) for pose in starts]
    return _tried_on_all(few, found, candidates)


def _scale(pose: Pose) -> float:
    return float(np.cbrt(abs(np.linalg.det(pose.matrix))))
