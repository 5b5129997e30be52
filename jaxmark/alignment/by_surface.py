"""Align a suspect of foreign connectivity by its surface: as a whole, as a part, or one component at a time."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int64

from jaxmark.alignment.by_vertices import MIN_COVERAGE
from jaxmark.alignment.fitting import FAR_DISTANCE, MIN_PIECE_SHARE, agreeing
from jaxmark.alignment.heights import measure_heights
from jaxmark.alignment.original import Original
from jaxmark.alignment.registration import refine, register_part, register_whole
from jaxmark.alignment.replay import replay_smoothing
from jaxmark.alignment.result import Alignment, file_pose, rms
from jaxmark.alignment.suspect import PreparedSuspect
from jaxmark.errors import JaxmarkError, available
from jaxmark.geometry.mesh import (
    Mesh,
    area,
    components,
    face_normals,
    used_vertices,
    vertex_normals,
)
from jaxmark.geometry.pose import Points, Pose
from jaxmark.geometry.surfaces import Surface, on_rim

# Little more than the shape may be left of a surface. Where no pose leaves less, it is read up to this residual if so
# much of the original is seen.
_ROUGH_DISTANCE, _ROUGH_COVERAGE = 0.01, 0.5
_MAX_COMPONENTS = 4  # largest components of a suspect that are tried one by one
_FULL_COVERAGE = 0.95  # share of the original from which on no further pieces are looked for
_FEW_VERTICES = 0.5  # of the original's: with so many or less, a surface is right at its vertices, and chords between


def align_surfaces(
    original: Original, suspect: PreparedSuspect, reflections: Sequence[bool], *, by_affine: bool
) -> Alignment:
    """Align a suspect's surface: as the whole of the original, else as a part of it, else one component at a time.

    Raises:
        JaxmarkError: if no pose brings its surface near the original's.
    """
    surface = Surface(Mesh(original.positions, original.points.faces))
    whole = Surface(suspect.welded)
    parts = [Surface(part) for part in components(suspect.welded)[:_MAX_COMPONENTS] if area(part) > 0]
    parts = parts if len(parts) > 1 else []
    failed: list[Alignment] = []
    for part, register in ((whole, register_whole), (whole, register_part), *((p, register_whole) for p in parts)):
        if (pose := register(surface, part, reflections)) is None:
            continue
        found = _align_in_pose(original, surface, part, pose, by_affine=by_affine)
        if (coverage := found.coverage(original)) >= MIN_COVERAGE and found.residual <= FAR_DISTANCE:
            return _with_pieces(original, surface, parts, found, pose) if coverage < _FULL_COVERAGE else found
        failed.append(found)
    size, coverage = np.inf, 0.0
    if failed:
        found = min(failed, key=lambda one: one.residual)
        size, coverage = found.residual, found.coverage(original)
        if coverage >= _ROUGH_COVERAGE and size <= _ROUGH_DISTANCE:
            return found
    raise JaxmarkError(
        "The suspect could not be aligned: "
        + (
            f"its surface lies {100 * size:.2g} % of the diagonal from the original's where {100 * coverage:.0f} % of"
            " the original are seen."
            if coverage
            else "in no pose is its surface near the original's."
        )
        + " Bring it into the original's pose and cut off what does not belong to it."
    )


def _with_pieces(original: Original, surface: Surface, parts: list[Surface], found: Alignment, pose: Pose) -> Alignment:
    """Complete an alignment by other components of the suspect that moved apart, each by a map of its own."""
    for part in parts:
        posed = pose(np.asarray(part.mesh.vertices)[used_vertices(part.mesh)])
        if np.median(np.linalg.norm(surface.closest(posed)[0] - posed, axis=1)) <= FAR_DISTANCE:
            continue  # this component is aligned by the common pose already
        if (own_pose := register_part(surface, part)) is None:
            continue
        piece = _align_in_pose(original, surface, part, own_pose, by_affine=True)
        new = (piece.weights > 0) & (found.weights == 0)
        if piece.residual <= FAR_DISTANCE and new.sum() >= MIN_PIECE_SHARE * original.used.sum():
            both = {
                name: np.where(new[:, None], getattr(piece, name), getattr(found, name))
                for name in ("displacement", "normals")
            }
            found = found._replace(weights=np.where(new, piece.weights, found.weights), **both)
    return found


def _align_in_pose(original: Original, surface: Surface, suspect: Surface, pose: Pose, *, by_affine: bool) -> Alignment:
    """Align a suspect's surface in a pose; of each point, only the displacement along the surface's normal is known."""
    x = np.asarray(surface.mesh.vertices)
    closest, face, seen = _closest(original, x, suspect, pose)
    if by_affine and seen.any():
        pose = refine(suspect, x[seen], vertex_normals(surface.mesh)[seen], pose, by_affine=True)
        closest, face, seen = _closest(original, x, suspect, pose)
    displacement = np.where(seen[:, None], closest - x, 0)
    size = rms(displacement[seen])
    posed = suspect.mesh._replace(vertices=pose(np.asarray(suspect.mesh.vertices)))
    # Closest points lie along the suspect's normals, which on coarse suspects differ from the original's.
    normals = face_normals(posed)[face]
    nuisance = replay_smoothing(surface, posed, face, closest, normals, seen) if size <= _ROUGH_DISTANCE else None
    heights = None
    few = len(posed.vertices) <= _FEW_VERTICES * original.used.sum()
    if few and size <= _ROUGH_DISTANCE and available("fast_simplification"):  # which tells what errors heights have
        heights = measure_heights(surface, posed, round(len(posed.faces) * area(surface.mesh) / area(posed)))
    pose = pose.then(file_pose(original))
    return Alignment(displacement, seen.astype(float), normals, nuisance, "surface", pose, size, heights=heights)


def _closest(
    original: Original, x: Points, suspect: Surface, pose: Pose
) -> tuple[Points, Int64[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
    """Find the point and the face where a posed suspect comes closest to each point, and a mask of points it shows."""
    closest, face = suspect.closest(x, pose)
    known = original.used & ~on_rim(suspect.mesh, face, pose.inverse()(closest))
    error = np.linalg.norm(closest - x, axis=1)
    return closest, face, known & agreeing(error, known) if known.any() else known
