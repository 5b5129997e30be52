"""The choice of roots for a mark of the scheme `rooted`, and the part of the surface that each root owns.

A reader must find at least one root on a part, and with it enough anchors to recognise it: one hundred anchors are
recognised nearly always, thirty never. Therefore roots are few, stable, and spread so that halves of the shape have
some. The choice depends on the original alone. All lengths are in widths of the narrow Gaussian.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.anchors import SPACING
from jaxmark.watermark.blind.landmarks import Landmarks
from jaxmark.watermark.blind.lattices import RIM, CutSurface, Frames, Lattices, find_roots

CLASSES = 2  # largest number of roots of one kind
REGION = 30.0  # distance from its root up to which a region reaches
_MOST = 12  # largest number of roots
_NOISE, _GRID = 0.004, 0.5  # test changes: noise over the mean distance to the centre, and rounding, in widths
_OFF, _TILT, _TURN = 0.3, 3.0, 5.0  # distance, and degrees of normal and tangent, up to which a landmark is the same
_TYPICAL = (0.15, 2.0, 3.0)  # the same, with which a root is half as good as without any change
_CUTS, _POINTS = 64, 2000  # planes by which the shape is halved for a test, and points of the surface that are counted
_FAR = 8.0  # least distance of a root from a cut
_NEVER, _ALWAYS = 30, 100  # numbers of anchors with which a root is never, and nearly always, recognised
_ENOUGH = 60  # anchors of one half of which more are of half as much use
_FEWEST = 60  # least number of anchors of a region, if there are several
_GAIN = 1.003  # factor of the expected use for which a further root is taken
_GAP = 2.5  # least distance of anchors of different roots


class Regions(NamedTuple):
    """The roots of a mark, and the anchors of each."""

    kinds: Int64[np.ndarray, " roots"]
    classes: Int64[np.ndarray, " roots"]  # the number of the root among those of its kind
    lattices: Lattices

    @property
    def names(self) -> Int64[np.ndarray, "anchors 5"]:
        """The names of anchors: kind and class of the root, and indices of the lattice point."""
        return names_of(self.kinds, self.classes, self.lattices)


def names_of(
    kinds: Int64[np.ndarray, " frames"], classes: Int64[np.ndarray, " frames"], lattices: Lattices
) -> Int64[np.ndarray, "anchors 5"]:
    """Return the names of anchors of frames that are taken for roots of these kinds and classes."""
    roots = np.stack([kinds, classes], axis=1)[lattices.frame]
    return np.concatenate([roots, lattices.cells], axis=1)


def make_regions(mesh: Mesh, surface: CutSurface) -> Regions:
    """Choose the roots of an original, whose mesh is in widths, and divide its anchors among them.

    Raises:
        JaxmarkError: if the surface is too large.
    """
    landmarks = find_roots(mesh)
    roots = _choose(landmarks, _stability(mesh, landmarks), surface)
    while True:
        regions = _divide(surface, landmarks.pick(np.array(roots, np.int64)))
        sizes = np.bincount(regions.lattices.frame, minlength=len(roots))
        if len(roots) <= 1 or sizes.min() >= _FEWEST:
            return regions
        del roots[int(sizes.argmin())]


def _stability(mesh: Mesh, landmarks: Landmarks) -> Float64[np.ndarray, " landmarks"]:
    """Measure how well landmarks are found again after small changes of the mesh, from 0 to 1 for no change.

    The changes are noise and, in a random pose, rounding of coordinates, which is about as rough as remeshing.
    """
    rng = np.random.default_rng(0)
    vertices = np.asarray(mesh.vertices, np.float64)
    radius = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1).mean()
    score, changed = np.zeros(len(landmarks.places)), []
    for _ in range(2):
        changed.append(vertices + _NOISE * radius * rng.uniform(-1, 1, vertices.shape))
        turn = Rotation.random(rng=rng).as_matrix()
        changed.append(np.round(vertices @ turn / _GRID) * _GRID @ turn.T)
    for moved in changed:
        found = find_roots(Mesh(moved, mesh.faces))
        for kind in np.intersect1d(landmarks.kinds, found.kinds):
            ours, theirs = np.flatnonzero(landmarks.kinds == kind), found.pick(found.kinds == kind)
            own = landmarks.pick(ours)
            distance, nearest = KDTree(theirs.places).query(own.places)
            theirs = theirs.pick(np.asarray(nearest))
            tilt, turn = _degrees(own.normals, theirs.normals), _degrees(own.tangents, theirs.tangents)
            turn = np.minimum(turn, 180 - turn)
            square = sum((one / typical) ** 2 for one, typical in zip((distance, tilt, turn), _TYPICAL, strict=True))
            score[ours] += ((distance < _OFF) & (tilt < _TILT) & (turn < _TURN)) / (1 + square) / len(changed)
    return score


def _degrees(
    first: Float64[np.ndarray, "points 3"], second: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, " points"]:
    return np.degrees(np.arccos(np.clip(np.sum(first * second, axis=1), -1, 1)))


def _choose(landmarks: Landmarks, stability: Float64[np.ndarray, " landmarks"], surface: CutSurface) -> list[int]:
    """Choose the roots with which most anchors are expected to be read from halves of the shape, one by one."""
    points = surface.points[np.random.default_rng(0).permutation(len(surface.points))[:_POINTS]]
    each = surface.area / len(points) / SPACING**2  # number of anchors that a point stands for
    directions = _directions(_CUTS)
    height = points @ directions.T
    middle = np.median(height, axis=0)
    kept, is_inside = height > middle + RIM, landmarks.places @ directions.T > middle + _FAR
    distance = np.linalg.norm(points[:, None] - landmarks.places, axis=2)

    def expected(roots: list[int]) -> float:
        near = distance[:, roots]
        owner = np.where(near.min(axis=1) < REGION, near.argmin(axis=1), -1)
        left = each * np.stack([kept[owner == index].sum(axis=0) for index in range(len(roots))])
        found = stability[roots][:, None] * is_inside[roots] * np.clip((left - _NEVER) / (_ALWAYS - _NEVER), 0, 1)
        return float(np.mean(1 - np.exp(-(found * left).sum(axis=0) / _ENOUGH)))

    def with_one_more(roots: list[int]) -> tuple[float, list[int]]:
        used = np.bincount(landmarks.kinds[roots], minlength=landmarks.kinds.max() + 1)
        fitting = np.flatnonzero((stability > 0) & (used[landmarks.kinds] < CLASSES))
        larger = [[*roots, one] for one in fitting.tolist() if one not in roots]
        return max(((expected(some), some) for some in larger), default=(0.0, roots))

    reached, roots = 0.0, []
    while len(roots) < _MOST and len(landmarks.places):
        value, larger = with_one_more(roots)
        if value == 0 or value < _GAIN * reached:
            break
        reached, roots = value, larger
    # The first roots were chosen without the others, so that each is chosen again.
    for root in tuple(roots):
        value, other = with_one_more([one for one in roots if one != root])
        if value > reached:
            reached, roots = value, other
    return roots


def _directions(count: int) -> Float64[np.ndarray, "count 3"]:
    """Spread directions evenly over the sphere, by the golden section."""
    index = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)


def _divide(surface: CutSurface, roots: Landmarks) -> Regions:
    """Give each anchor near the roots to the nearest root, and leave a gap between regions."""
    lattices = surface.lattices(Frames.of(roots), REGION)
    distance = np.linalg.norm(lattices.places[:, None] - roots.places, axis=2)
    lattices = lattices.pick(distance.argmin(axis=1) == lattices.frame) if len(roots.places) else lattices
    lattices = lattices.pick(_spaced(lattices))
    classes = [int((roots.kinds[:index] == kind).sum()) for index, kind in enumerate(roots.kinds)]
    return Regions(roots.kinds, np.array(classes, np.int64), lattices)


def _spaced(lattices: Lattices) -> Bool[np.ndarray, " anchors"]:
    """Mark the anchors to keep: of two of different roots that are too close, the one that is nearer to its root."""
    distances, keep = lattices.distances, np.ones(len(lattices.frame), bool)
    for one, other in sorted(KDTree(lattices.places).query_pairs(_GAP)):
        if lattices.frame[one] != lattices.frame[other] and keep[one] and keep[other]:
            keep[one if distances[one] > distances[other] else other] = False
    return keep
