"""An original that is prepared for writing values at anchors: what is measured, and how displacements are smoothed."""

import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import edges
from jaxmark.geometry.surfaces import Moments, surface_moments, volume_moments
from jaxmark.spectral.bands import heat
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.blind.anchors import Anchors, Pieces, look

_LEAST_AREA = 0.2  # lower limit on the area of a vertex, relative to the mean
_SMOOTHING = 0.5  # share of the narrow Gaussian's width by which displacements are smoothed
_LONGEST = 100.0  # largest number of diffusion steps for that
_TERMS = 3.7  # terms of a series over the root of the time of diffusion


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shape:
    """A mesh prepared for measuring the values of its anchors as a function of its vertices; a pytree."""

    matrix: Float[Array, "3 3"]  # linear part of the map to the mesh's own pose
    shift: Float[Array, " 3"]
    faces: Int[Array | np.ndarray, "faces 3"]
    pieces: Pieces
    anchors: Anchors
    width: Float[Array, ""]  # width of the narrow Gaussian
    closed: bool = field(metadata={"static": True})  # whether the mesh encloses a volume

    def measure(self, vertices: Float[Array, "rows 3"]) -> tuple[Float[Array, " anchors"], Float[Array, " nine"]]:
        """Measure the anchors' values, and the centre and covariance of the mesh in its original pose."""
        placed = matmul(vertices, self.matrix.T) + self.shift
        no_shift = jnp.zeros(self.anchors.places.shape, vertices.dtype)
        values = look(self.pieces.of(placed), self.anchors, no_shift, self.width, jnp.zeros_like(self.width)).values
        moments: Moments = (volume_moments if self.closed else surface_moments)(placed[self.faces])
        upper = jnp.triu_indices(3)
        return values, jnp.concatenate([moments.centre, moments.covariance[upper]])


def inverse_areas(original: Original) -> Float[Array, " rows"]:
    """Compute the inverse of the area around each point, relative to the mean."""
    points, faces = original.positions, np.asarray(original.points.faces)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    areas = np.bincount(faces.ravel(), np.repeat(area, 3), len(points))
    mean = areas[original.used].mean()
    return original.to_traced(np.where(original.used, mean / np.maximum(areas, _LEAST_AREA * mean), 0))


def smoothing_of(original: Original, width: float) -> Float64[np.ndarray, " terms"]:
    """Compute the series of a diffusion by a share of the width, which hides the surface's pieces in displacements.

    Diffusion exp(-tΔ) takes t steps along edges on average, which moves a point by √(t/2) edges along each direction.
    """
    ends = original.positions[edges(np.asarray(original.points.faces))]
    edge = float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
    time = min(2 * (_SMOOTHING * width / edge) ** 2, _LONGEST)
    return heat([time], 4 * math.ceil(_TERMS * math.sqrt(time) / 4))[0]
