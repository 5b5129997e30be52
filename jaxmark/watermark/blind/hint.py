"""Hints: landmarks of an original, from which a reader finds the pose of a part of it.

A hint lies in the record of a mark. It is derived from the original alone, before the mark is made, and depends on no
key: the poses that a reader finds with it are independent of the mark's signs (`jaxmark.watermark.blind.reading`). It
reveals the places, normals and tangents of up to 100 points of the original, and nothing between them.
"""

import base64
import binascii
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, diagonal, unit
from jaxmark.geometry.pose import Points, Pose, similarity
from jaxmark.watermark.blind.landmarks import Landmarks, find_landmarks

_VERSION = 1
_MOST, _COMPARED = 100, 300  # landmarks in a hint, and of a suspect
_RATIO = 2 ** (1 / 3)  # ratio of neighbouring widths, and of the scales that are tried
_WIDTHS = tuple(0.0125 * _RATIO**index for index in range(3))  # widths of the Gaussians, in units of the pose
_UNIT = 2.0**-11  # unit of stored places, in units of the pose
_FARTHEST = 1.5  # largest coordinate of a landmark in the pose, in which a shape is about 1 wide
_HEAD = np.dtype([("version", "u1"), ("scale", "<f8")])
_POINT = np.dtype([("place", "<i2", 3), ("normal", "i1", 3), ("tangent", "i1", 3), ("kind", "u1")])
_LARGEST, _SMALLEST = 1.15, 0.28  # diagonals of parts, in units of the pose
_LARGEST_SCENE = 2.0  # the same for a part in the unit of the original, with other things beside it
_METRES = (1.0, 0.01, 0.001, 0.0254)  # usual units: metre, centimetre, millimetre, inch
#: Factors between usual units, those near 1 first.
_UNITS = tuple(sorted({of / by for of in _METRES for by in _METRES}, key=lambda factor: abs(math.log(factor))))
_POSES = 4  # poses of a suspect that are read, in a usual unit and in any unit
GROUPS, MOST_POSES = 2, 2 * _POSES  # the largest numbers of groups, and of poses, of `Hint.poses`
_NEAR = 0.035  # distance of landmarks, in units of the pose, up to which a rough pose fits them
_CLOSER = (0.035, 0.02, 0.01, 0.006, 0.006)  # the same while the pose is refined
_REFINED = 100  # number of rough poses that are refined
_GRID = 0.0175  # side of the cubes in which rough poses are compared
_CHUNK = 2**19  # number of landmarks that are compared at once
_SAME = 0.005  # change of places, in units of the pose, up to which poses are the same
_MOST_SCALING = 1.25  # largest factor by which refining may change the size of a suspect
_FEWEST, _ENOUGH = 4, 20  # numbers of landmarks that must fit a pose, and with which other units are not tried


class Posed(NamedTuple):
    """A pose of a suspect that a hint gives."""

    pose: Pose  # the map from the coordinates of the suspect's file to the pose of the original
    inside_out: bool  # whether the suspect's faces are inward
    fitting: int  # number of landmarks that fit

    def apply(self, suspect: Mesh) -> Mesh:
        """Return the suspect in this pose, with outward faces."""
        faces = np.asarray(suspect.faces)
        is_reversed = self.inside_out != self.pose.mirrors
        return Mesh(self.pose(np.asarray(suspect.vertices, np.float64)), faces[:, ::-1] if is_reversed else faces)


class _Rough(NamedTuple):
    """A rough pose of a suspect."""

    fitting: int  # number of landmarks that fit roughly
    pose: Pose  # the map from the flipped suspect to the pose of the original
    suspect: Landmarks  # the landmarks of the flipped suspect
    flip: Pose  # the map from the coordinates of the suspect's file to those of the flipped suspect
    inside_out: bool


@dataclass(frozen=True, eq=False)
class Hint:
    """The landmarks of an original in its own pose."""

    landmarks: Landmarks
    scale: float  # units of the pose per unit of the original's file

    @classmethod
    def of(cls, mesh: Mesh, scale: float) -> "Hint":
        """Find the clearest landmarks of an original, which is in its own pose, with outward faces.

        Raises:
            JaxmarkError: if its surface is too large.
        """
        found = find_landmarks(mesh, _WIDTHS)
        found = found.pick(np.abs(found.places).max(axis=1, initial=0) < _FARTHEST)
        return cls(found.clearest(_MOST), scale)

    def to_text(self) -> str:
        """Return the hint as it is stored in a record: at most 1,800 characters."""
        landmarks = self.landmarks
        points = np.zeros(len(landmarks.places), _POINT)
        points["place"] = np.round(landmarks.places / _UNIT)
        points["normal"], points["tangent"] = np.round(127 * landmarks.normals), np.round(127 * landmarks.tangents)
        points["kind"] = landmarks.kinds
        head = np.array([(_VERSION, self.scale)], _HEAD)
        return base64.b64encode(head.tobytes() + points.tobytes()).decode()

    @classmethod
    def from_text(cls, text: str) -> "Hint":
        """Read a hint of a record.

        Raises:
            JaxmarkError: if it is damaged, or of a version that this jaxmark does not know.
        """
        try:
            data = base64.b64decode(text, validate=True)
            head = np.frombuffer(data[: _HEAD.itemsize], _HEAD)[0]
            points = np.frombuffer(data[_HEAD.itemsize :], _POINT)
        except (ValueError, binascii.Error, IndexError):
            raise JaxmarkError("The record is damaged: its hint is incomplete. Use an unedited copy.") from None
        if head["version"] != _VERSION:
            raise JaxmarkError(f"The record's hint is of version {head['version']}; this jaxmark reads {_VERSION}.")
        normals, tangents = (unit(points[name].astype(np.float64)) for name in ("normal", "tangent"))
        places = _UNIT * points["place"]
        is_in_range = normals.any(axis=1) & tangents.any(axis=1) & (points["kind"] < 2 * len(_WIDTHS))
        is_in_range &= np.abs(places).max(axis=1, initial=0) <= _FARTHEST
        if not (0 < head["scale"] < np.inf and len(points) <= _MOST and is_in_range.all()):
            raise JaxmarkError("The record is damaged: its hint is out of range. Use an unedited copy.")
        kinds = points["kind"].astype(np.int64)
        return cls(Landmarks(places, normals, tangents, kinds, np.ones(len(points))), float(head["scale"]))

    def poses(self, suspect: Mesh) -> Iterator[list[Posed]]:
        """Iterate over the likeliest poses of a suspect, the likeliest first.

        Poses in the unit of the original, or in another usual one, come first, and then, unless many landmarks fit one
        of them, in any unit: a scale that is not exact fits fewer landmarks.

        Raises:
            JaxmarkError: if the suspect has no extent.
        """
        size = diagonal(suspect)
        if not len(self.landmarks.places):
            return
        largest = {factor: _LARGEST_SCENE if factor == 1 else _LARGEST for factor in _UNITS}
        usual = [factor for factor in _UNITS if _SMALLEST <= factor * size * self.scale <= largest[factor]]
        found: list[Posed] = []
        for factor in usual:
            found += self._in_scales(suspect, [factor * self.scale])
            found = _distinct(sorted(found, key=lambda one: -one.fitting), suspect)[:_POSES]
            if found and found[0].fitting >= _ENOUGH:
                break
        if usual:
            yield found
        if found and found[0].fitting >= _ENOUGH:
            return
        count = int(np.floor(np.log(_LARGEST / _SMALLEST) / np.log(_RATIO))) + 1
        yield self._in_scales(suspect, [_LARGEST / size / _RATIO**index for index in range(count)])

    def _in_scales(self, suspect: Mesh, scales: list[float]) -> list[Posed]:
        """Find the likeliest poses of a suspect with about the given scales, each smaller than the one before."""
        # The landmarks of a scale have the widths of another scale, so that each width is needed once.
        count = len(_WIDTHS) + len(scales) - 1
        try:
            found = find_landmarks(suspect, [_WIDTHS[0] / scales[0] * _RATIO**index for index in range(count)])
        except JaxmarkError:
            return []  # a surface with more folds than any shape in its own pose
        rough: list[_Rough] = []
        for index, scale in enumerate(scales):
            chosen = found.pick((found.kinds >= 2 * index) & (found.kinds < 2 * (index + len(_WIDTHS))))
            chosen = chosen._replace(kinds=chosen.kinds - 2 * index).clearest(_COMPARED)
            for mirrored, inside_out in product((False, True), repeat=2):
                flip = Pose(scale * np.diag([-1.0 if mirrored else 1.0, 1, 1]), np.zeros(3))
                seen = chosen.seen(flip, inside_out=inside_out)
                rough += [_Rough(*one, seen, flip, inside_out) for one in self._match(seen)]
        rough.sort(key=lambda one: -one.fitting)
        candidates = [posed for one in rough[:_REFINED] if (posed := self._refine(one)) is not None]
        likely = [one for one in candidates if one.fitting >= max(other.fitting for other in candidates) / 2]
        return _distinct(sorted(likely, key=lambda one: -one.fitting), suspect)[:_POSES]

    def _match(self, suspect: Landmarks) -> list[tuple[int, Pose]]:
        """Find poses that map many landmarks of a suspect near those of the hint, which have about the same scale."""
        ours, poses = self.landmarks, []
        # A half turn about the normal makes up for the arbitrary sign of the tangents.
        half_turn = np.diag([-1.0, -1, 1])
        for kind in np.intersect1d(suspect.kinds, ours.kinds):
            first, second = np.flatnonzero(suspect.kinds == kind), np.flatnonzero(ours.kinds == kind)
            first, second = (index.ravel() for index in np.meshgrid(first, second))
            for turn in (np.eye(3), half_turn):
                matrix = ours.frames[second] @ turn @ np.swapaxes(suspect.frames[first], 1, 2)
                shift = ours.places[second] - np.einsum("nab,nb->na", matrix, suspect.places[first])
                poses.append((matrix, shift))
        if not poses:
            return []
        matrix, shift = map(np.concatenate, zip(*poses, strict=True))
        rough = self._fitting(suspect, matrix, shift)
        best = np.argsort(-rough, kind="stable")[:_REFINED]
        return [(int(rough[index]), Pose(matrix[index], shift[index])) for index in best]

    def _fitting(
        self,
        suspect: Landmarks,
        matrix: Float64[np.ndarray, "poses 3 3"],
        shift: Float64[np.ndarray, "poses 3"],
    ) -> Int64[np.ndarray, " poses"]:
        """Count the landmarks of a suspect that each pose maps near a landmark of their kind."""
        near, corner = self._near
        side = near.shape[1]
        counts = []
        chunk = max(_CHUNK // max(len(suspect.places), 1), 1)
        for start in range(0, len(matrix), chunk):
            placed = Pose(matrix[start : start + chunk], shift[start : start + chunk])(suspect.places)
            cube = np.floor((placed - corner) / _GRID).astype(np.int64)
            inside = ((cube >= 0) & (cube < side)).all(axis=-1)
            cube = np.where(inside[..., None], cube, 0)
            counts.append((near[suspect.kinds, cube[..., 0], cube[..., 1], cube[..., 2]] & inside).sum(axis=1))
        return np.concatenate(counts)

    @cached_property
    def _near(self) -> tuple[Bool[np.ndarray, "kinds side side side"], Float64[np.ndarray, " 3"]]:
        """A mask of cubes near the landmarks of each kind, and the corner at which the cubes begin."""
        places = self.landmarks.places
        corner = places.min(axis=0, initial=np.inf) - _NEAR
        side = int(np.ceil((places.max(initial=-np.inf, axis=0) + _NEAR - corner).max() / _GRID))
        centres = corner + _GRID * (np.indices((side, side, side)).reshape(3, -1).T + 0.5)
        near = [np.isfinite(tree.query(centres, distance_upper_bound=_NEAR)[0]) for tree, _ in self._trees.values()]
        return np.reshape(near, (len(near), side, side, side)), corner

    @cached_property
    def _trees(self) -> dict[int, tuple[KDTree, Points]]:
        """The landmarks of each kind."""
        ours, kinds = self.landmarks, range(2 * len(_WIDTHS))
        return {kind: (KDTree(places), places) for kind in kinds for places in [ours.places[ours.kinds == kind]]}

    def _refine(self, rough: "_Rough") -> Posed | None:
        """Fit a pose to the landmarks that it maps near those of the hint, nearer from step to step."""
        pose, suspect, fitting = rough.pose, rough.suspect, 0
        for reach in _CLOSER:
            pairs, fitting = [], 0
            for kind, (tree, places) in self._trees.items():
                own = suspect.places[suspect.kinds == kind]
                distance, nearest = tree.query(pose(own), distance_upper_bound=reach)
                near = np.isfinite(distance)
                pairs.append((own[near], places[np.asarray(nearest)[near]]))
                fitting += len(np.unique(np.asarray(nearest)[near]))
            if fitting < _FEWEST:
                return None
            source, target = map(np.concatenate, zip(*pairs, strict=True))
            pose = similarity(source, target)
            if not 1 / _MOST_SCALING < pose.scale < _MOST_SCALING:
                return None
        return Posed(rough.flip.then(pose), rough.inside_out, fitting)


def _distinct(candidates: list[Posed], suspect: Mesh) -> list[Posed]:
    """Drop poses that put the suspect where an earlier one puts it."""
    vertices = np.asarray(suspect.vertices, np.float64)
    ends = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    corners = np.stack([ends[list(corner), range(3)] for corner in product((0, 1), repeat=3)])
    kept: list[Posed] = []
    for one in candidates:
        if all(np.abs(one.pose(corners) - other.pose(corners)).max() > _SAME for other in kept):
            kept.append(one)
    return kept
