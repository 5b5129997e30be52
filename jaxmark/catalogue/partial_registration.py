"""Register a part of a shape to many originals, to distinguish the one it was cut from among those that look alike.

Local shape gives poses of the part on a few originals of different shape (`jaxmark.alignment.features`). Near
duplicates have much the same frame, so that the poses which fit best are tried on those that look like these originals,
and improved by trimmed distances along normals (Chetverikov et al. 2005) to the points that the catalogue keeps. The
scale may change by a tenth only: anything fits when it is small enough.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from jaxmark.alignment.features import FeatureSettings, poses_by_features
from jaxmark.alignment.registration import poses_by_axes
from jaxmark.catalogue import descriptors
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Points, Pose
from jaxmark.geometry.surfaces import Surface

_SAMPLES = 300  # points of the part
_POSES = 3  # of each reference and its reflection
_KEPT_POSES = 2  # of each reference that is kept
_KEPT_REFERENCES = 3  # those that a part fits best
_CLOSE = 40  # candidates that a part is fitted to as well as it can be
_FEATURES = FeatureSettings(points=2000, radius=0.15)  # coarser than for alignment, which is enough here, and faster
_ROUNDS, _FIRST_ROUNDS = 10, 4
_WHOLE_REFERENCES = 2  # originals by which poses of a whole shape are found
_WHOLE_POSES = 3  # that are tried on all candidates
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
        first = self.off(part, pose), pose
        scale = start = float(np.cbrt(abs(np.linalg.det(pose.matrix))))
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
        return _least([first, (self.off(part, pose), pose)])

    def off(self, part: Points, pose: Pose) -> float:
        """Compute the mean distance of a part's points in a pose from the planes, without the largest."""
        posed = pose(part)
        off, near = map(np.asarray, self.tree.query(posed))
        height = np.abs(np.sum((posed - self.points[near]) * self.normals[near], axis=1))
        height = np.sort(np.where(off > _FAR, _FAR, height))
        return float(height[: max(1, int(_COUNTED_SHARE * len(height)))].mean())


class Placed(NamedTuple):
    """A pose of a part on a reference."""

    off: float  # the distance that it leaves
    reference: int  # its number
    pose: Pose


class Part:
    """A part of a shape, ready to be fitted; refused if it has no faces with an extent."""

    def __init__(self, mesh: Mesh) -> None:
        seen = descriptors.spread(mesh, _SAMPLES)
        if seen is None or not len(mesh.faces):
            raise JaxmarkError("A part without a surface fits nothing; it is compared as a whole.")
        self.points, self._surface = seen.points, Surface(mesh)

    def place(self, references: Iterable[Mesh]) -> list[Placed]:
        """Find poses of the part on the few of some originals that it fits best, the best first."""
        found: list[list[Placed]] = []
        for number, reference in enumerate(references):
            points, centre, size = descriptors.centred(reference)
            target = Target(points)
            unit = Surface(Mesh((np.asarray(reference.vertices) - centre) / (size * _UNIT), reference.faces))
            poses = poses_by_features(unit, self._surface, _POSES, settings=_FEATURES)
            starts = (Pose(_UNIT * pose.matrix, _UNIT * pose.shift) for pose in poses)
            fits = sorted((target.fit(self.points, start) for start in starts), key=lambda end: end[0])
            found.append([Placed(off, number, pose) for off, pose in fits[:_KEPT_POSES]])
        found = sorted(filter(None, found), key=lambda poses: poses[0].off)[:_KEPT_REFERENCES]
        return [placed for poses in found for placed in poses]

    def fit(self, candidates: Mapping[int, Points], poses: Mapping[int, Sequence[Pose]]) -> dict[int, float]:
        """Find the least distances that poses leave on some originals, in their mean distances to their centres.

        Args:
            candidates: the points that are kept of each original, from `descriptors.centred`, by its number.
            poses: on originals that look like it.
        """
        found = {
            number: _least([Target(points).fit(self.points, pose, _FIRST_ROUNDS) for pose in poses[number]])
            for number, points in candidates.items()
        }
        close = sorted(found, key=lambda number: found[number][0])[:_CLOSE]
        again = {number: Target(candidates[number]).fit(self.points, found[number][1])[0] for number in close}
        return {number: off for number, (off, _) in found.items()} | again


def fit_whole(shape: Mesh, candidates: Sequence[Points]) -> Float64[np.ndarray, " candidates"]:
    """Compute how well a whole shape fits each of several originals, the likeliest first; see `Part.fit`.

    Its principal axes are aligned with those of the first ones.
    """
    seen = descriptors.spread(shape, _SAMPLES)
    if seen is None:
        return np.full(len(candidates), np.inf)
    few, found, targets = seen.points, [], [Target(points) for points in candidates]
    for target in targets[:_WHOLE_REFERENCES]:
        found += [target.fit(few, pose, rounds=_FIRST_ROUNDS) for pose in poses_by_axes(target.points, few)]
    poses = [pose for _, pose in sorted(found, key=lambda end: end[0])[:_WHOLE_POSES]]
    return np.array([min((target.fit(few, pose)[0] for pose in poses), default=np.inf) for target in targets])


def _least(ends: Sequence[tuple[float, Pose]]) -> tuple[float, Pose]:
    """Return the fit that leaves the least distance."""
    return min(ends, key=lambda end: end[0])
