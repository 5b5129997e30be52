"""Comparison of point clouds by nearest points, in a given pose; on the host, without the key.

A copy in which points were removed, added or shuffled still has many of the original's own points: mutually nearest
points are assumed to be the same point. A resampled cloud has none of the original's points, but it has the surface.
Its displacement along the normal is measured by planes through the nearest points of both clouds, which do not depend
on where the surface was sampled.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from jaxmark.geometry.clouds import Cloud, planes, spacings
from jaxmark.geometry.mesh import weld
from jaxmark.geometry.pose import Points, Pose, similarity

_REACH = 0.8  # largest distance of partners, in units of the local spacing
_SPACING_POINTS = 3  # number of nearest points whose mean distance is the local spacing
_CLOSE = 0.25  # largest distance of a close point, in local spacings; points of another sampling are rarely as close
_CHANCE = 1.67  # expected number of points of an equally dense sampling within distance c is 1.67 c² (c in spacings)
_MIN_EXCESS = 1.3  # least ratio of the number of close points to the number that another sampling would have by chance
_SEEN = 3.0  # distance, in spacings, within which the suspect covers a point
_MIN_SURVIVING = 0.01  # least fraction of the original's points that are close, if its own points survive
_MAX_ROUNDS = 8  # rounds of pairing points and fitting the pose to the pairs
_MOST_SPARSE = 1e3  # ratio of spacings that counts as the largest
_FIRST_REACH, _APPROACHES = 8.0, 30  # first reach, in spacings, and number of rounds, of the coarse fit
_MIN_PAIRS = 10  # least number of pairs to which a pose is fitted
_PLANE_POINTS = 12  # number of points of the sparser cloud to which a plane is fitted
_MAX_PLANE_POINTS = 60  # largest such number for the denser cloud, whose planes should be equally wide
_MAX_GAP = 4.0  # largest distance of a plane's points, in spacings of the sparser cloud; larger gaps are holes


Others = Float64[np.ndarray, "others 3"]  # points of a suspect


class Partners(NamedTuple):
    """The points of a suspect that are assumed to be the original's points."""

    place: Int64[np.ndarray, " points"]  # index of each point's partner in the suspect
    known: Bool[np.ndarray, " points"]  # whether the point has a partner
    surviving: bool  # whether so many pairs are so close that the suspect must have the original's own points


class Heights(NamedTuple):
    """The heights of a suspect's surface above the original's, at each of the original's points."""

    height: Float64[np.ndarray, " points"]  # along the normal
    normals: Points  # normals of the original's surface, with arbitrary signs
    known: Bool[np.ndarray, " points"]  # whether the suspect has a surface near the point


def find_partners(x: Points, y: Others, reach: float = _REACH) -> Partners:
    """Find the points of a suspect that are mutually nearest to those of the original.

    Args:
        x: the original's points.
        y: the suspect's points, in the original's pose.
        reach: largest distance of partners, in units of the local spacing.
    """
    spacing = spacings(x, _SPACING_POINTS)
    distance, place = (np.asarray(part) for part in KDTree(y).query(x))
    mutual = np.asarray(KDTree(x).query(y[place])[1]) == np.arange(len(x))
    close, covered = float(np.mean(distance <= _CLOSE * spacing)), float(np.mean(distance <= _SEEN * spacing))
    # For random points on a surface, the mean distance to the three nearest points is 0.73 times the square root of the
    # area per point, so that 1.67 c² other points are expected within c times that distance.
    chance = covered * -np.expm1(-_CHANCE * _CLOSE**2 * len(y) / max(covered * len(x), 1))
    surviving = close >= max(_MIN_SURVIVING, _MIN_EXCESS * chance)
    return Partners(place, mutual & (distance <= reach * spacing), bool(surviving))


def settle(x: Points, y: Others, pose: Pose) -> tuple[Pose, Partners]:
    """Refine a pose by mutually nearest points, until the pairs stay the same.

    Args:
        x: the original's points.
        y: the suspect's points, in the suspect's coordinates.
        pose: approximate map from the suspect's coordinates to the original's.
    """
    partners = find_partners(x, pose(y))
    if not partners.surviving:  # the pose may be wrong by some spacings, so that few points are near their own
        coarse = _approach(x, y, pose)
        nearer = find_partners(x, coarse(y))
        if nearer.surviving:
            pose, partners = coarse, nearer
    for _ in range(_MAX_ROUNDS):
        known = np.flatnonzero(partners.known)
        if len(known) < _MIN_PAIRS:
            break
        posed = pose(y[partners.place[known]])
        pose = pose.then(similarity(posed, x[known]))
        before, partners = partners, find_partners(x, pose(y))
        if np.array_equal(before.known, partners.known) and np.array_equal(before.place, partners.place):
            break
    return pose, partners


def _approach(x: Points, y: Others, pose: Pose) -> Pose:
    """Fit a pose to mutually nearest points, whose largest distance decreases from round to round."""
    for reach in np.geomspace(_FIRST_REACH, _REACH, _APPROACHES):
        partners = find_partners(x, pose(y), reach)
        known = np.flatnonzero(partners.known)
        if len(known) < _MIN_PAIRS:
            break
        pose = pose.then(similarity(pose(y[partners.place[known]]), x[known]))
    return pose


def find_heights(x: Cloud, y: Others) -> Heights:
    """Measure the heights of a suspect's surface above the original's, at each of the original's points.

    Both surfaces are approximated by planes through nearest points. The planes are about equally wide, so that the
    effects of curvature and roughness cancel.

    Args:
        x: the original's points.
        y: the suspect's points, in the original's pose.
    """
    other = Cloud(y[weld(y).first])  # copies of a point are no neighbours
    ratio = min(x.spacing / max(other.spacing, 1e-300), _MOST_SPARSE) ** 2
    count, other_count = (
        int(np.clip(round(_PLANE_POINTS * by), _PLANE_POINTS, _MAX_PLANE_POINTS))
        for by in (1 / max(ratio, 1e-9), ratio)
    )
    points = x.points
    # Each of the original's points is one of its own nearest points. Two more points compensate for the narrower plane.
    before, after = planes(x.tree, points, count + 2), planes(other.tree, points, other_count)
    normals = before.normals
    turned = np.sum(normals * after.normals, axis=1)
    first = np.sum((before.centres - points) * normals, axis=1)
    second = np.sum((after.centres - points) * after.normals, axis=1) * np.sign(turned)
    known = (after.reach <= _MAX_GAP * max(x.spacing, other.spacing)) & (np.abs(turned) > 0.7)
    return Heights(second - first, normals, known)
