"""The result of a registration: `Alignment`, a suspect aligned with an original."""

from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.alignment.heights import VertexHeights
from jaxmark.alignment.nonrigid import DeformedPoints, undo_deformation
from jaxmark.alignment.observation import Observation
from jaxmark.alignment.original import Original
from jaxmark.geometry.pose import Points, Pose

Align = Literal["auto", "same", "similarity", "affine"]
Method = Literal["same", "connectivity", "points", "surface"]


class Alignment(NamedTuple):
    """A suspect aligned with an original."""

    displacement: Float64[np.ndarray, "points 3"]  # displacement of the original's points, in diagonals
    weights: Float64[np.ndarray, " points"]  # 1; 0 for points that are masked or that no face uses
    normals: Float64[np.ndarray, "points 3"] | None  # if given, only displacements along these unit vectors are known
    nuisance: Float[np.ndarray, "points columns"] | None  # displacements by smoothing, if they explain the suspect
    method: Method  # how vertices were recognised: by order, by connectivity, as nearest points, or not at all
    pose: Pose  # from the suspect's coordinates to the original's, as in their files
    residual: float  # root mean square displacement of the points with weight 1, in diagonals
    seconds: float = 0.0  # duration of the alignment
    align: Align = "auto"  # the way of registration that was requested
    heights: VertexHeights | None = None  # heights of the suspect's vertices above the original, if there are few
    deformed: DeformedPoints | None = None  # recognised points, if no single affine map aligns them
    as_whole: bool = False  # whether a surface was registered as the whole original

    def facts(self) -> dict[str, Any]:
        """Return the facts of the registration for reports, as values for JSON."""
        return {"method": self.method, "pose": self.pose.facts(), "residual": self.residual, "seconds": self.seconds}

    def coverage(self, original: Original) -> float:
        """Compute the fraction of the original's points that are registered to the suspect."""
        return float(np.sum(self.weights > 0) / original.used.sum())

    def observation(self, original: Original) -> Observation:
        """Convert to an observation for detectors: displacements in diagonals, padded, in the original's dtype."""

        def array(value: np.ndarray | None) -> Array | None:
            return None if value is None else original.to_traced(value)

        known = original.to_traced(self.displacement), original.to_traced(self.weights)
        return Observation(*known, array(self.normals), array(self.nuisance))

    def undeformed(self, original: Original, deformed: DeformedPoints) -> "Alignment":
        """Align by non-rigid registration, see `nonrigid.undo_deformation`."""
        displacement, weights = undo_deformation(
            original.operator, np.asarray(original.positions, np.float64), deformed
        )
        residual = rms(displacement[weights > 0])
        return self._replace(
            displacement=displacement, weights=weights, nuisance=None, residual=residual, deformed=None
        )


def rms(x: Points) -> float:
    """Compute the root mean square length; infinite for no vectors."""
    return float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) if len(x) else np.inf


def file_pose(original: Original) -> Pose:
    """Return the map from positions in diagonals to coordinates of the original's file."""
    return Pose(original.diagonal * np.eye(3), np.asarray(original.points.vertices)[original.used].mean(axis=0))
