"""Registration of a remeshed suspect by its surface: as a whole, as a part, or one component at a time."""

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
from jaxmark.errors import AlignmentError, available
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

# A heavily distorted suspect is accepted up to this residual (in diagonals), if its coverage is at least this, and no
# pose leaves a smaller residual.
_ROUGH_DISTANCE, _ROUGH_COVERAGE = 0.01, 0.5
_MAX_COMPONENTS = 4  # components of a suspect that are tried one by one, the largest ones
_FULL_COVERAGE = 0.95  # coverage from which on no further pieces are searched for
# The heights of vertices are measured in suspects with at most this fraction of the original's vertices: a simplified
# surface is accurate at its vertices only.
_FEW_VERTICES = 0.5


def align_surfaces(
    original: Original, suspect: PreparedSuspect, reflections: Sequence[bool], *, by_affine: bool, in_parts: bool
) -> Alignment:
    """Align a suspect's surface: as the whole original; with `in_parts` else as a part, else one component at a time.

    Raises:
        AlignmentError: if no pose brings the suspect's surface near the original's.
    """
    surface = Surface(Mesh(original.positions, original.points.faces))
    whole = Surface(suspect.welded)
    parts = [Surface(part) for part in components(suspect.welded, _MAX_COMPONENTS) if area(part) > 0]
    parts = parts if len(parts) > 1 else []
    further = [(whole, register_part), *((part, register_whole) for part in parts)] if in_parts else []
    failed: list[Alignment] = []
    for part, register in ((whole, register_whole), *further):
        if (pose := register(surface, part, reflections)) is None:
            continue
        result = _align_in_pose(original, surface, part, pose, by_affine=by_affine)
        result = result._replace(as_whole=part is whole and register is register_whole)
        if (coverage := result.coverage(original)) >= MIN_COVERAGE and result.residual <= FAR_DISTANCE:
            return _with_pieces(original, surface, parts, result, pose) if coverage < _FULL_COVERAGE else result
        failed.append(result)
    size, coverage = np.inf, 0.0
    if failed:
        result = min(failed, key=lambda result: result.residual)
        size, coverage = result.residual, result.coverage(original)
        if coverage >= _ROUGH_COVERAGE and size <= _ROUGH_DISTANCE:
            return result
    raise AlignmentError(
        "The suspect could not be aligned: "
        + (
            f"the distance of its surface from the original's is {100 * size:.2g} % of the diagonal, with a coverage of"
            f" {100 * coverage:.0f} %."
            if coverage
            else "in no pose is its surface near the original's."
        )
        + " If it is of the original, move it into the original's pose and cut off the parts that do not belong to it."
    )


def _with_pieces(
    original: Original, surface: Surface, parts: list[Surface], alignment: Alignment, pose: Pose
) -> Alignment:
    """Extend an alignment by other components of the suspect that moved apart, each with its own map."""
    for part in parts:
        posed = pose(np.asarray(part.mesh.vertices)[used_vertices(part.mesh)])
        if np.median(np.linalg.norm(surface.closest(posed)[0] - posed, axis=1)) <= FAR_DISTANCE:
            continue  # this component is aligned by the common pose already
        if (own_pose := register_part(surface, part)) is None:
            continue
        piece = _align_in_pose(original, surface, part, own_pose, by_affine=True)
        new = (piece.weights > 0) & (alignment.weights == 0)
        if piece.residual <= FAR_DISTANCE and new.sum() >= MIN_PIECE_SHARE * original.used.sum():
            both = {
                name: np.where(new[:, None], getattr(piece, name), getattr(alignment, name))
                for name in ("displacement", "normals")
            }
            alignment = alignment._replace(weights=np.where(new, piece.weights, alignment.weights), **both)
    return alignment


def _align_in_pose(original: Original, surface: Surface, suspect: Surface, pose: Pose, *, by_affine: bool) -> Alignment:
    """Align a suspect's surface in a pose; for each point, only the displacement along the normal is known."""
    x = np.asarray(surface.mesh.vertices)
    closest, face, mask = _closest(original, x, suspect, pose)
    if by_affine and mask.any():
        pose = refine(suspect, x[mask], vertex_normals(surface.mesh)[mask], pose, by_affine=True)
        closest, face, mask = _closest(original, x, suspect, pose)
    displacement = np.where(mask[:, None], closest - x, 0)
    size = rms(displacement[mask])
    posed = suspect.mesh._replace(vertices=pose(np.asarray(suspect.mesh.vertices)))
    # Closest points lie along the suspect's normals, which on coarse suspects differ from the original's.
    normals = face_normals(posed)[face]
    nuisance = replay_smoothing(surface, posed, face, closest, normals, mask) if size <= _ROUGH_DISTANCE else None
    heights = None
    few = len(posed.vertices) <= _FEW_VERTICES * original.used.sum()
    # The errors of heights are estimated from simplifications of the original, which need fast_simplification.
    if few and size <= _ROUGH_DISTANCE and available("fast_simplification"):
        heights = measure_heights(surface, posed, round(len(posed.faces) * area(surface.mesh) / area(posed)))
    pose = pose.then(file_pose(original))
    return Alignment(displacement, mask.astype(float), normals, nuisance, "surface", pose, size, heights=heights)


def _closest(
    original: Original, x: Points, suspect: Surface, pose: Pose
) -> tuple[Points, Int64[np.ndarray, " points"], Bool[np.ndarray, " points"]]:
    """Find the closest point of a posed suspect to each point, its face, and a mask of the points that are covered."""
    closest, face = suspect.closest(x, pose)
    known = original.used & ~on_rim(suspect.mesh, face, pose.inverse()(closest))
    error = np.linalg.norm(closest - x, axis=1)
    return closest, face, known & agreeing(error, known) if known.any() else known
