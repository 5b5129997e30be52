"""Compare point clouds by nearest points, in a pose; on the host, without the key.

A copy of which points were lost, added or shuffled still has many of the original's own: those that are each other's
nearest are taken for the same. What was sampled anew has none of them, but the surface: planes through the nearest
points of both clouds show how far it moved across itself, whatever either cloud's points do along it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from jaxmark.geometry.clouds import Cloud, planes, spacings
from jaxmark.geometry.pose import Points, Pose, similarity

_REACH = 0.8  # of the local spacing, beyond which a nearest point is taken for another one
_SPACING_POINTS = 3  # nearest points whose mean distance is the local spacing
_CLOSE = 0.25  # of the local spacing; within it, points of another sampling are rare
_CHANCE = 1.67  # times the square of that share: how often another point of an equally dense sampling is so close
_MIN_EXCESS = 1.3  # of points so close, over how many another sampling of the same surface would have
_SEEN = 3.0  # spacings within which a suspect shows a point, or another one in its place
_MIN_SURVIVING = 0.01  # share of the original's points that must be so close
_MAX_ROUNDS = 8  # of pairing points and moving the suspect onto its partners
_FIRST_REACH, _APPROACHES = 8.0, 30  # spacings, and rounds, of coming nearer
_MIN_PAIRS = 10  # that a pose is fitted to
_PLANE_POINTS = 12  # of the sparser cloud, that a plane is fitted to
_MAX_PLANE_POINTS = 60  # of the denser one, whose plane is about as wide
_MAX_GAP = 4.0  # spacings of the sparser cloud, beyond which a place is a hole


Others = Float64[np.ndarray, "others 3"]  # points of a suspect


class Partners(NamedTuple):
    """Points of a suspect that are taken for the original's."""

    place: Int64[np.ndarray, " points"]  # index of each point's partner in the suspect
    known: Bool[np.ndarray, " points"]  # whether it has one
    surviving: bool  # whether so many lie so close that the suspect must have the original's own points


class Heights(NamedTuple):
    """How far a suspect's surface is above the original's."""

    height: Float64[np.ndarray, " points"]  # along the normal
    normals: Points  # of the original's surface, of either side
    known: Bool[np.ndarray, " points"]  # whether the suspect has a surface there


def find_partners(x: Points, y: Others, reach: float = _REACH) -> Partners:
    """Find the points of a suspect that are mutually nearest to those of the original.

    Args:
        x: the original's points.
        y: the suspect's, in the original's pose.
        reach: times the local spacing, the distance of partners at most.
    """
    apart = spacings(x, _SPACING_POINTS)
    distance, place = (np.asarray(part) for part in KDTree(y).query(x))
    mutual = np.asarray(KDTree(x).query(y[place])[1]) == np.arange(len(x))
    close, seen = float(np.mean(distance <= _CLOSE * apart)), float(np.mean(distance <= _SEEN * apart))
    # Random points on a surface have their three nearest at 0.73 of the root of a point's area in the mean, so that
    # 1.67 c² others lie within the share c of that distance.
    chance = seen * -np.expm1(-_CHANCE * _CLOSE**2 * len(y) / max(seen * len(x), 1))
    surviving = close >= max(_MIN_SURVIVING, _MIN_EXCESS * chance)
    return Partners(place, mutual & (distance <= reach * apart), bool(surviving))


def settle(x: Points, y: Others, pose: Pose) -> tuple[Pose, Partners]:
    """Improve a pose by the points that are mutually nearest, until these stay the same.

    Args:
        x: the original's points.
        y: the suspect's, in coordinates of its own.
        pose: from the suspect's coordinates to the original's, nearly.
    """
    partners = find_partners(x, pose(y))
    if not partners.surviving:  # unless few points are near their own, the pose may be off by some spacings
        found = _approach(x, y, pose)
        nearer = find_partners(x, found(y))
        if nearer.surviving:
            pose, partners = found, nearer
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
    """Move a suspect onto the points that are mutually nearest, first far ones, then ever nearer ones."""
    for reach in np.geomspace(_FIRST_REACH, _REACH, _APPROACHES):
        partners = find_partners(x, pose(y), reach)
        known = np.flatnonzero(partners.known)
        if len(known) < _MIN_PAIRS:
            break
        pose = pose.then(similarity(pose(y[partners.place[known]]), x[known]))
    return pose


def find_heights(x: Cloud, y: Others) -> Heights:
    """Measure how far a suspect's surface is above the original's at each of the original's points.

    Both surfaces are planes through nearest points, about as wide, so that what bends or roughens both cancels.

    Args:
        x: the original's points.
        y: the suspect's, in the original's pose.
    """
    other = Cloud(y)
    ratio = (x.spacing / max(other.spacing, 1e-300)) ** 2
    mine, theirs = (
        int(np.clip(round(_PLANE_POINTS * by), _PLANE_POINTS, _MAX_PLANE_POINTS))
        for by in (1 / max(ratio, 1e-9), ratio)
    )
    points = x.points
    # Each of the original's points is among its own nearest, which makes a plane narrower by about two of them.
    before, after = planes(x.tree, points, mine + 2), planes(other.tree, points, theirs)
    normals = before.normals
    turned = np.sum(normals * after.normals, axis=1)
    first = np.sum((before.centres - points) * normals, axis=1)
    second = np.sum((after.centres - points) * after.normals, axis=1) * np.sign(turned)
    known = (after.reach <= _MAX_GAP * max(x.spacing, other.spacing)) & (np.abs(turned) > 0.7)
    return Heights(second - first, normals, known)
