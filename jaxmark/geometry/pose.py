"""Similarities and affine maps of space, fitted to points by least squares, on the host."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

Points = Float64[np.ndarray, "points 3"]
PointSets = Float64[np.ndarray, "... points 3"]


class Pose(NamedTuple):
    """The map x ↦ matrix · x + shift; leading axes hold one map for each of several sets of points."""

    matrix: Float64[np.ndarray, "... 3 3"]
    shift: Float64[np.ndarray, "... 3"]

    def __call__(self, points: PointSets) -> PointSets:
        """Map points."""
        return points @ np.swapaxes(self.matrix, -1, -2) + self.shift[..., None, :]

    def then(self, other: "Pose") -> "Pose":
        """The composition of this map and, after it, the other."""
        return Pose(other.matrix @ self.matrix, other.matrix @ self.shift + other.shift)

    def inverse(self) -> "Pose":
        """The inverse map."""
        matrix = np.linalg.inv(self.matrix)
        return Pose(matrix, -matrix @ self.shift)


IDENTITY = Pose(np.eye(3), np.zeros(3))


def similarity(source: PointSets, target: PointSets) -> Pose:
    """Fit the scale, rotation and shift that bring `source` closest to `target`, point by point.

    By least squares (Umeyama, IEEE PAMI 13, 1991, eq. 39-42).
    """
    source_mean, target_mean = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    u, size, vt = np.linalg.svd(np.swapaxes(target - target_mean, -1, -2) @ (source - source_mean))
    proper = np.ones(size.shape)
    proper[..., 2] = np.sign(np.linalg.det(u @ vt))  # a rotation, not a reflection
    spread = np.maximum(((source - source_mean) ** 2).sum(axis=(-1, -2)), np.finfo(float).tiny)
    scale = (size * proper).sum(axis=-1) / spread
    matrix = scale[..., None, None] * ((u * proper[..., None, :]) @ vt)
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
