"""Registration of a suspect whose vertices are recognised: by their order, or by the connectivity around them."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Int64

from jaxmark.alignment.fitting import FAR_DISTANCE, fit_pieces, fit_whole, min_piece_points
from jaxmark.alignment.nonrigid import DeformedPoints
from jaxmark.alignment.original import Original, residual
from jaxmark.alignment.replay import replay_smoothing_of_points
from jaxmark.alignment.result import Alignment, file_pose, rms
from jaxmark.alignment.suspect import PreparedSuspect
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.connectivity import matching_vertices
from jaxmark.geometry.mesh import Mesh, component_of
from jaxmark.geometry.pose import Points, Pose

MIN_COVERAGE = 0.05  # least coverage of an alignment
_ROUNDING = 1e-12  # rounding error of sums over all points, in diagonals; smaller displacements are set to 0


def align_in_order(original: Original, suspect: Mesh) -> Alignment:
    """Align a suspect whose vertices are those of the original, in the same order.

    Raises:
        JaxmarkError: if the suspect has other faces or another number of vertices, or if the order of the original's
            file differs from the order in which it was marked.
    """
    if not original.in_order:
        raise JaxmarkError(
            "The order of vertices in the original's file differs from the order in which it was marked, so that the"
            " suspect cannot be aligned vertex by vertex; align by 'auto'."
        )
    y = np.asarray(original.positions, np.float64) + residual(original, suspect)
    back = file_pose(original).inverse()
    return align_points(original, y, original.used, np.asarray(original.points.faces), "same", back)


def align_by_connectivity(original: Original, suspect: PreparedSuspect) -> Alignment | None:
    """Align a suspect by vertices whose neighbourhoods have the original's connectivity; None if there are too few."""
    # If no two vertices of a suspect coincide, the welded mesh is the suspect itself.
    copies = len(suspect.welded.vertices) < len(suspect.mesh.vertices)
    for points in (suspect.welded, suspect.mesh) if copies else (suspect.welded,):
        match = matching_vertices(Mesh(original.positions, original.points.faces), points)
        matched = original.used & (match >= 0)
        y = np.asarray(points.vertices)[match]
        size = np.ptp(y[matched], axis=0).max() if matched.any() else 0.0
        if matched.sum() >= max(4, MIN_COVERAGE * original.used.sum()) and size > 0:
            scale = Pose(np.eye(3) / size, np.zeros(3))
            # The suspect's faces between matched points, as indices of the original's points.
            point = np.full(len(points.vertices), -1)
            point[match[matched]] = np.flatnonzero(matched)
            faces = point[np.asarray(points.faces)]
            faces = faces[(faces >= 0).all(axis=1)]
            return align_points(original, scale(y), matched, faces, "connectivity", scale)
    return None


def align_points(
    original: Original,
    y: Points,
    known: Bool[np.ndarray, " points"],
    faces: Int64[np.ndarray, "faces 3"],
    method: Literal["same", "connectivity", "points"],
    before: Pose,
) -> Alignment:
    """Align a suspect by its recognised points.

    Args:
        original: the original.
        y: position of each recognised point in the suspect, after the map `before`.
        known: mask of the points that were recognised.
        faces: the suspect's faces between recognised points.
        method: how the points were recognised.
        before: the map that has been applied to the suspect's coordinates.
    """
    x = np.asarray(original.positions, np.float64)
    moved = y - x
    # Points with huge coordinates, such as 1e200, are left out, because they would dominate every sum.
    spread = np.abs(moved - np.median(moved[known], axis=0)).max(axis=1)
    sound = known & (spread <= 1e6 * max(np.quantile(spread[known], 0.6), 1e-6))
    pose, agreeing = fit_whole(x, y, sound, spread)
    error = np.where(agreeing[:, None], pose(y) - x, 0)
    # Points that do not agree with the map may belong to pieces that moved apart. If the residual is large, all points
    # may.
    far = rms(error[agreeing]) > FAR_DISTANCE
    has_pieces = far or np.sum(sound & ~agreeing) >= min_piece_points(x)
    deformed = DeformedPoints(pose(y), sound) if has_pieces else None
    label = np.where(sound, component_of(Mesh(y, faces)), -1) if has_pieces else np.full(len(x), -1)
    pieces = fit_pieces(x, y, label) if far else []
    if 2 * sum(len(points) for points, _ in pieces) > known.sum():
        agreeing, pose = np.zeros(len(x), bool), pieces[0][1]
    else:
        pieces = fit_pieces(x, y, np.where(agreeing, -1, label))
    for points, back in pieces:
        agreeing[points] = True
        error[points] = back(y[points]) - x[points]
    error = np.where(agreeing[:, None], error, 0)
    if np.abs(error).max() < _ROUNDING:
        error = np.zeros_like(error)
    mesh = Mesh(original.positions, original.points.faces)
    nuisance = replay_smoothing_of_points(original.operator, mesh, error, agreeing)
    pose = before.then(pose).then(file_pose(original))
    size = rms(error[agreeing])
    return Alignment(error, agreeing.astype(float), None, nuisance, method, pose, size, deformed=deformed)
