"""Registration of point clouds, or to a point cloud: by mutually nearest points, or by local planes."""

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
from jaxmark.errors import AlignmentError
from jaxmark.geometry.clouds import Cloud
from jaxmark.geometry.mesh import used_vertices
from jaxmark.geometry.pose import Pose
from jaxmark.geometry.surfaces import Surface

_MIN_IN_PLACE = 0.5  # least coverage if a cloud's points are assumed to be in order, or in the pose of the file
_SAMPLES_PER_POINT = 2  # points sampled from a suspect's surface for each point of the original cloud


def align_cloud_in_order(original: Original, suspect: PreparedSuspect) -> Alignment | None:
    """Align a cloud by the order of its points; returns None if the order seems to be another one."""
    if not original.in_order or len(suspect.mesh.vertices) != len(original.mesh.vertices):
        return None
    result = align_in_order(original, suspect.mesh._replace(faces=original.mesh.faces))
    return result if result.residual <= FAR_DISTANCE and result.coverage(original) >= _MIN_IN_PLACE else None


def align_cloud(original: Original, suspect: PreparedSuspect, align: Align, reflections: Sequence[bool]) -> Alignment:
    """Align a suspect by its points only, because suspect or original has no faces.

    Raises:
        JaxmarkError: if no pose brings the suspect's points near the original's.
    """
    points = np.asarray(suspect.mesh.vertices, np.float64)[used_vertices(suspect.mesh)]
    if not np.ptp(points, axis=0).any():
        raise AlignmentError("All points of the suspect are at one place, so that it has no shape to align.")
    if not suspect.is_cloud:
        sampled = Surface(suspect.mesh).sample(_SAMPLES_PER_POINT * int(original.used.sum())).points
        points = np.concatenate([points, sampled])
    target, source = Cloud(original.positions[original.used]), Cloud(points)
    least, fitting = np.inf, []
    for pose, in_place in _poses(original, target, source, align, reflections):
        result = _align_in_pose(original, target, source, pose, by_affine=align == "affine")
        by_planes = result.method == "surface"
        if result.coverage(original) < (_MIN_IN_PLACE if in_place and by_planes else MIN_COVERAGE):
            continue
        least = min(least, result.residual)
        # A flat cloud is near itself in many poses. The search ends early only if the original's own points are
        # recognised, or if the distance of the surfaces is less than the distance between neighbouring points.
        if result.residual <= (target.spacing if by_planes else FAR_DISTANCE):
            return result
        if result.residual <= FAR_DISTANCE:
            fitting.append(result)
    if fitting:
        return min(fitting, key=lambda result: result.residual)
    distance = f" (at best at a distance of {100 * least:.2g} % of the diagonal)" if least < np.inf else ""
    raise AlignmentError(
        f"The suspect could not be aligned: in no pose are its points near the original's{distance}. If it is"
        " of the original, move it into the original's pose and cut off the parts that do not belong to it."
    )


def _poses(
    original: Original, target: Cloud, source: Cloud, align: Align, reflections: Sequence[bool]
) -> Iterator[tuple[Pose, bool]]:
    """Yield candidate poses of a cloud, and whether each is the pose of its file, which most attacks do not change."""
    if align == "auto" and False in reflections:
        yield file_pose(original).inverse(), True
    # Nearest points of two sparse clouds are further apart than their surfaces, even in the right pose.
    settings = replace(SETTINGS, whole_distance=max(SETTINGS.whole_distance, 2 * target.spacing))
    dense = source.without_strays()
    for register in (register_whole, register_part):
        if (pose := register(target, dense, reflections, settings=settings)) is not None:
            yield pose, False


def _align_in_pose(original: Original, target: Cloud, source: Cloud, pose: Pose, *, by_affine: bool) -> Alignment:
    """Align a suspect in an approximate pose, by the original points that survive in it or, without any, by planes."""
    used, size = np.flatnonzero(original.used), len(original.used)
    settled, partners = settle(target.points, source.points, pose)
    if partners.surviving and partners.known.sum() >= max(4, MIN_COVERAGE * len(used)):
        y, known = np.zeros((size, 3)), np.zeros(size, bool)
        y[used], known[used] = settled(source.points[partners.place]), partners.known
        return align_points(original, y, known, np.zeros((0, 3), np.int64), "points", settled)
    pose = refine(source, *target.anchors(), pose, by_affine=by_affine)
    heights = find_heights(target, pose(source.points))
    displacement, normals, mask = np.zeros((size, 3)), np.zeros((size, 3)), np.zeros(size, bool)
    displacement[used], normals[used] = heights.height[:, None] * heights.normals, heights.normals
    mask[used] = heights.known
    if mask.any():
        mask &= agreeing(np.linalg.norm(displacement, axis=1), mask)
    displacement[~mask] = 0
    pose = pose.then(file_pose(original))
    return Alignment(displacement, mask.astype(float), normals, None, "surface", pose, rms(displacement[mask]))
