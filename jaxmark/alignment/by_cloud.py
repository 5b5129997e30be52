"""Align suspects where they or the original are point clouds: by mutually nearest points, or by planes through them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from jaxmark.alignment.by_vertices import MIN_COVERAGE, align_in_order, align_points
from jaxmark.alignment.fitting import FAR_DISTANCE, agreeing
from jaxmark.alignment.nearest import find_heights, settle
from jaxmark.alignment.original import Original
from jaxmark.alignment.registration import SETTINGS, refine, register_part, register_whole
from jaxmark.alignment.result import Align, Alignment, file_pose, rms
from jaxmark.alignment.suspect import PreparedSuspect
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.clouds import Cloud
from jaxmark.geometry.mesh import used_vertices
from jaxmark.geometry.pose import Pose
from jaxmark.geometry.surfaces import Surface

_MIN_IN_PLACE = 0.5  # share of a cloud's points that must be in order, or near their place in the file
_SAMPLES_PER_POINT = 2  # points sampled from a surface for each of an original cloud, which they are compared with


def align_cloud_in_order(original: Original, suspect: PreparedSuspect) -> Alignment | None:
    """Align a cloud by the order of its points; None if they seem to be in another order."""
    if not original.in_order or len(suspect.mesh.vertices) != len(original.mesh.vertices):
        return None
    found = align_in_order(original, suspect.mesh._replace(faces=original.mesh.faces))
    return found if found.residual <= FAR_DISTANCE and found.coverage(original) >= _MIN_IN_PLACE else None


def align_cloud(original: Original, suspect: PreparedSuspect, align: Align, reflections: Sequence[bool]) -> Alignment:
    """Align a suspect by its points: the faces of either mesh tell nothing about the other one.

    Raises:
        JaxmarkError: if no pose brings its points near the original's.
    """
    points = np.asarray(suspect.mesh.vertices, np.float64)[used_vertices(suspect.mesh)]
    if not suspect.is_cloud:
        sampled = Surface(suspect.mesh).sample(_SAMPLES_PER_POINT * int(original.used.sum())).points
        points = np.concatenate([points, sampled])
    target, source = Cloud(original.positions[original.used]), Cloud(points)
    least, fitting = np.inf, []
    for pose, in_place in _poses(original, target, source, align, reflections):
        found = _align_in_pose(original, target, source, pose, by_affine=align == "affine")
        by_planes = found.method == "surface"
        if found.coverage(original) < (_MIN_IN_PLACE if in_place and by_planes else MIN_COVERAGE):
            continue
        least = min(least, found.residual)
        # A flat cloud lies near itself in many poses: other ones are tried unless its own points are found, or its
        # surface is nearer than points are to each other.
        if found.residual <= (target.spacing if by_planes else FAR_DISTANCE):
            return found
        if found.residual <= FAR_DISTANCE:
            fitting.append(found)
    if fitting:
        return min(fitting, key=lambda one: one.residual)
    raise JaxmarkError(
        "The suspect could not be aligned: in no pose are its points near the original's"
        + (f", but {100 * least:.2g} % of the diagonal away" if least < np.inf else "")
        + ". Bring it into the original's pose and cut off what does not belong to it."
    )


def _poses(
    original: Original, target: Cloud, source: Cloud, align: Align, reflections: Sequence[bool]
) -> Iterator[tuple[Pose, bool]]:
    """Poses of a cloud to try, and whether they are where its file has it: most attacks leave it there."""
    if align == "auto" and False in reflections:
        yield file_pose(original).inverse(), True
    # Clouds of few points are further apart than surfaces, wherever both lie.
    settings = replace(SETTINGS, whole_distance=max(SETTINGS.whole_distance, 2 * target.spacing))
    dense = source.without_strays()
    for register in (register_whole, register_part):
        if (pose := register(target, dense, reflections, settings=settings)) is not None:
            yield pose, False


def _align_in_pose(original: Original, target: Cloud, source: Cloud, pose: Pose, *, by_affine: bool) -> Alignment:
    """Align a suspect in a pose, nearly, by the points that survive in it; if there are none, by planes."""
    used, size = np.flatnonzero(original.used), len(original.used)
    settled, partners = settle(target.points, source.points, pose)
    if partners.surviving and partners.known.sum() >= max(4, MIN_COVERAGE * len(used)):
        y, known = np.zeros((size, 3)), np.zeros(size, bool)
        y[used], known[used] = settled(source.points[partners.place]), partners.known
        return align_points(original, y, known, np.zeros((0, 3), np.int64), "points", settled)
    pose = refine(source, *target.anchors(), pose, by_affine=by_affine)
    heights = find_heights(target, pose(source.points))
    displacement, normals, seen = np.zeros((size, 3)), np.zeros((size, 3)), np.zeros(size, bool)
    displacement[used], normals[used] = heights.height[:, None] * heights.normals, heights.normals
    seen[used] = heights.known
    if seen.any():
        seen &= agreeing(np.linalg.norm(displacement, axis=1), seen)
    displacement[~seen] = 0
    pose = pose.then(file_pose(original))
    return Alignment(displacement, seen.astype(float), normals, None, "surface", pose, rms(displacement[seen]))
