"""Registration of a part of a shape to many originals, to find the original that it was cut from.

Local shape descriptors give poses of the part on a few originals of different shapes (`jaxmark.alignment.features`).
Near duplicates are usually in the same coordinate frame. Therefore the best poses are tested on all originals that are
similar to these, and refined by trimmed distances along normals (Chetverikov et al. 2005) to the points that the
catalogue stores. The refinement may change the scale by a tenth only, because a small part fits everywhere.
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

_SAMPLES = 300  # points sampled on the part
_POSES = 3  # most rotations, and most reflections, that are tested on each reference
_KEPT_POSES = 2  # best poses of each reference that are used
_KEPT_REFERENCES = 3  # best references that are used
_CLOSE = 40  # candidates to which a part is fitted with all rounds
_FEATURES = FeatureSettings(points=2000, radius=0.15)  # coarser and faster than for alignment, but sufficient here
_ROUNDS, _FIRST_ROUNDS = 10, 4
_WHOLE_REFERENCES = 2  # originals by which the poses of a whole shape are found
_WHOLE_POSES = 3  # best poses that are tested on all candidates
_KEPT_SHARE = 0.8  # fraction of the closest pairs that a round uses
_COUNTED_SHARE = 0.9  # fraction of the smallest distances that the result averages
_FAR = 0.15  # larger distances are reduced to this one, in RMS distances of an original to its centre
_MOST_SCALING = 1.1  # largest change of scale by the refinement
_NEIGHBOURS = 10  # number of points to which a normal is fitted
_UNIT = 3.0  # approximate size of an original, in RMS distances to its centre


class Target:
    """The stored points of an original, with planes through them."""

    def __init__(self, points: Points) -> None:
        self.points, self.tree = points, KDTree(points)
        near = points[self.tree.query(points, _NEIGHBOURS)[1]]
        offsets = near - near.mean(axis=1, keepdims=True)
        self.normals = np.linalg.eigh(np.einsum("pki,pkj->pij", offsets, offsets))[1][:, :, 0]

    def fit(self, part: Points, pose: Pose, rounds: int = _ROUNDS) -> tuple[float, Pose]:
        """Refine a part's pose; returns its distance and the pose, which is never worse than the initial one."""
        first = self.off(part, pose), pose
        scale = start = pose.scale
        for _ in range(rounds):
            posed = pose(part)
            distance, near = map(np.asarray, self.tree.query(posed))
            inliers = distance <= np.quantile(distance, _KEPT_SHARE)
            at, along = posed[inliers], self.normals[near[inliers]]
            height = np.sum((at - self.points[near[inliers]]) * along, axis=1)
            columns = np.concatenate([np.cross(at, along), np.sum(along * at, axis=1, keepdims=True), along], axis=1)
            step = np.linalg.lstsq(columns, -height, rcond=1e-9)[0]
            u, _, vt = np.linalg.svd(np.eye(3) + np.cross(np.eye(3), step[:3]))
            factor = float(np.clip(scale * (1 + step[3]), start / _MOST_SCALING, start * _MOST_SCALING)) / scale
            pose, scale = pose.then(Pose(factor * (u @ vt), step[4:])), scale * factor
            if np.abs(step).max() < 1e-4:
                break
        return _least([first, (self.off(part, pose), pose)])

    def off(self, part: Points, pose: Pose) -> float:
        """Compute the trimmed mean distance of a part's points, in a pose, from the planes."""
        posed = pose(part)
        distance, near = map(np.asarray, self.tree.query(posed))
        height = np.abs(np.sum((posed - self.points[near]) * self.normals[near], axis=1))
        height = np.sort(np.where(distance > _FAR, _FAR, height))
        return float(height[: max(1, int(_COUNTED_SHARE * len(height)))].mean())


class Placed(NamedTuple):
    """A pose of a part on a reference."""

    off: float  # distance of the part from the reference
    reference: int  # number of the reference
    pose: Pose


class Part:
    """A part of a shape, prepared for registration; it needs faces, and a size and area above 0."""

    def __init__(self, mesh: Mesh) -> None:
        spread = descriptors.spread(mesh, _SAMPLES)
        if spread is None or not len(mesh.faces):
            raise JaxmarkError("A part without a surface cannot be registered; compare it as a whole.")
        self.points, self._surface = spread.points, Surface(mesh)

    def place(self, references: Iterable[Mesh]) -> list[Placed]:
        """Find the poses of the part on the references that it fits best, the best reference first."""
        placed: list[list[Placed]] = []
        for number, reference in enumerate(references):
            points, centre, size = descriptors.centred(reference)
            target = Target(points)
            unit = Surface(Mesh((np.asarray(reference.vertices) - centre) / (size * _UNIT), reference.faces))
            poses = poses_by_features(unit, self._surface, _POSES, settings=_FEATURES)
            starts = (Pose(_UNIT * pose.matrix, _UNIT * pose.shift) for pose in poses)
            fits = sorted((target.fit(self.points, start) for start in starts), key=lambda end: end[0])
            placed.append([Placed(distance, number, pose) for distance, pose in fits[:_KEPT_POSES]])
        placed = sorted(filter(None, placed), key=lambda poses: poses[0].off)[:_KEPT_REFERENCES]
        return [pose for poses in placed for pose in poses]

    def fit(self, candidates: Mapping[int, Points], poses: Mapping[int, Sequence[Pose]]) -> dict[int, float]:
        """Compute the least distance of the part from each candidate, in the candidate's RMS distances to its centre.

        Args:
            candidates: the stored points of each original, from `descriptors.centred`, by its number.
            poses: initial poses for each original, from originals that are similar to it.
        """
        fits = {
            number: _least([Target(points).fit(self.points, pose, _FIRST_ROUNDS) for pose in poses[number]])
            for number, points in candidates.items()
        }
        close = sorted(fits, key=lambda number: fits[number][0])[:_CLOSE]
        refined = {number: Target(candidates[number]).fit(self.points, fits[number][1])[0] for number in close}
        return {number: distance for number, (distance, _) in fits.items()} | refined


def fit_whole(shape: Mesh, candidates: Sequence[Points]) -> Float64[np.ndarray, " candidates"]:
    """Compute the distance of a whole shape from each of several originals, see `Part.fit`.

    The initial poses align the principal axes of the shape with those of the first originals, which should be the most
    likely ones.
    """
    spread = descriptors.spread(shape, _SAMPLES)
    if spread is None:
        return np.full(len(candidates), np.inf)
    few, fits, targets = spread.points, [], [Target(points) for points in candidates]
    for target in targets[:_WHOLE_REFERENCES]:
        fits += [target.fit(few, pose, rounds=_FIRST_ROUNDS) for pose in poses_by_axes(target.points, few)]
    poses = [pose for _, pose in sorted(fits, key=lambda end: end[0])[:_WHOLE_POSES]]
    return np.array([min((target.fit(few, pose)[0] for pose in poses), default=np.inf) for target in targets])


def _least(ends: Sequence[tuple[float, Pose]]) -> tuple[float, Pose]:
    """Return the fit with the least distance."""
    return min(ends, key=lambda end: end[0])
