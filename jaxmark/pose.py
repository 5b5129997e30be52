"""Maps of space, fitted by least squares; host side."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

Points = Float64[np.ndarray, "points 3"]
PointSets = Float64[np.ndarray, "... points 3"]


class Pose(NamedTuple):
    """The map x ↦ matrix · x + shift, or a map for each of many sets of points."""

    matrix: Float64[np.ndarray, "... 3 3"]
    shift: Float64[np.ndarray, "... 3"]

    def __call__(self, points: PointSets) -> PointSets:
        """Where points go."""
        return points @ np.swapaxes(self.matrix, -1, -2) + self.shift[..., None, :]

    def then(self, other: "Pose") -> "Pose":
        """This map, and after it the other."""
        return Pose(other.matrix @ self.matrix, other.matrix @ self.shift + other.shift)

    def inverse(self) -> "Pose":
        """The map back."""
        matrix = np.linalg.inv(self.matrix)
        return Pose(matrix, -matrix @ self.shift)


IDENTITY = Pose(np.eye(3), np.zeros(3))


def similarity(source: PointSets, target: PointSets) -> Pose:
    """The scale, rotation and shift that bring points closest to others (Umeyama, IEEE PAMI 13, 1991, eq. 39-42)."""
    back, to = source.mean(axis=-2, keepdims=True), target.mean(axis=-2, keepdims=True)
    u, size, vt = np.linalg.svd(np.swapaxes(target - to, -1, -2) @ (source - back))
    proper = np.ones(size.shape)
    proper[..., 2] = np.sign(np.linalg.det(u @ vt))  # a rotation, no reflection
    spread = np.maximum(((source - back) ** 2).sum(axis=(-1, -2)), np.finfo(float).tiny)
    scale = (size * proper).sum(axis=-1) / spread
    turn = scale[..., None, None] * ((u * proper[..., None, :]) @ vt)
    return Pose(turn, (to - back @ np.swapaxes(turn, -1, -2))[..., 0, :])


def affine(source: Points, target: Points) -> Pose:
    """The affine map that brings points closest to others that lie nearby."""
    back, to = source.mean(axis=0), target.mean(axis=0)
    centred, difference = source - back, (target - to) - (source - back)
    variance, axes = np.linalg.eigh(centred.T @ centred)
    # Along an axis in which the shape is flat, the map would be fitted to the mark itself; there it stays as it is.
    inverse = np.where(variance > 1e-4 * variance[2], 1 / np.maximum(variance, 1e-300), 0)
    matrix = np.eye(3) + difference.T @ centred @ (axes * inverse) @ axes.T
    return Pose(matrix, to - matrix @ back)
