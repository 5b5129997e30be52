"""Similarities and affine maps of space, fitted to points by least squares, on the host."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

Points = Float64[np.ndarray, "points 3"]
PointSets = Float64[np.ndarray, "... points 3"]

_FLAT = 1e-8  # a shape whose variances have a smaller ratio is flat


class Pose(NamedTuple):
    """The map x ↦ matrix · x + shift; leading axes hold one map for each of several sets of points."""

    matrix: Float64[np.ndarray, "... 3 3"]
    shift: Float64[np.ndarray, "... 3"]

    def __call__(self, points: PointSets) -> PointSets:
        """Map points."""
        return points @ np.swapaxes(self.matrix, -1, -2) + self.shift[..., None, :]

    def then(self, other: "Pose") -> "Pose":
        """Compose this map with another map that is applied after it."""
        return Pose(other.matrix @ self.matrix, other.matrix @ self.shift + other.shift)

    def inverse(self) -> "Pose":
        """Return the inverse map."""
        matrix = np.linalg.inv(self.matrix)
        return Pose(matrix, -matrix @ self.shift)

    def facts(self) -> dict[str, list]:
        """Return the map as values for JSON."""
        return {"matrix": self.matrix.tolist(), "shift": self.shift.tolist()}

    @property
    def scale(self) -> float:
        """The factor on lengths; for a single similarity."""
        return float(np.cbrt(abs(np.linalg.det(self.matrix))))

    @property
    def mirrors(self) -> bool:
        """Whether the map is a reflection; for a single map."""
        return bool(np.linalg.det(self.matrix) < 0)


IDENTITY = Pose(np.eye(3), np.zeros(3))


def similarity(source: PointSets, target: PointSets, mirrored: bool | None = False) -> Pose:
    """Fit the scale, rotation and shift that bring `source` closest to `target`, point by point.

    By least squares (Umeyama, IEEE PAMI 13, 1991, eq. 39-42).

    Args:
        source: points, or several sets of them.
        target: as many points.
        mirrored: whether the map is a reflection; None chooses the better fit, and a rotation for flat shapes, which
            fit both.
    """
    source_mean, target_mean = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    u, size, vt = np.linalg.svd(np.swapaxes(target - target_mean, -1, -2) @ (source - source_mean))
    reflection, signs = np.sign(np.linalg.det(u @ vt)), np.ones(size.shape)  # with these signs, u @ vt fits best
    if mirrored is None:
        signs[..., 2] = np.where(size[..., 2] > _FLAT * size[..., 0], 1, reflection)
    else:
        signs[..., 2] = -reflection if mirrored else reflection
    spread = np.maximum(((source - source_mean) ** 2).sum(axis=(-1, -2)), np.finfo(float).tiny)
    scale = (size * signs).sum(axis=-1) / spread
    matrix = scale[..., None, None] * ((u * signs[..., None, :]) @ vt)
    return Pose(matrix, (target_mean - source_mean @ np.swapaxes(matrix, -1, -2))[..., 0, :])


def affine(source: Points, target: Points) -> Pose:
    """Fit the affine map that brings `source` closest to `target`, which lies nearby, point by point."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centred, difference = source - source_mean, (target - target_mean) - (source - source_mean)
    variance, axes = np.linalg.eigh(centred.T @ centred)
    # Along an axis in which the shape is flat, the map would be fitted to the mark itself; there it changes nothing.
    inverse = np.where(variance > 1e-4 * variance[2], 1 / np.maximum(variance, 1e-300), 0)
    matrix = np.eye(3) + difference.T @ centred @ (axes * inverse) @ axes.T
    return Pose(matrix, target_mean - matrix @ source_mean)
