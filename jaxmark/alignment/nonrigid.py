"""Undo bends, by a map of its own for the surroundings of each recognised point; on the host, without the key.

A character in another pose, or a part that was bent, moves as rigid or sheared pieces that pass into each other. Around
each point the suspect is an affine map of the original, nearly, and what such a map cannot explain is the mark, turned
and stretched with its surroundings, and noise.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy import sparse

from jaxmark.geometry.pose import Points
from jaxmark.spectral.laplacian import Laplacian

_STEPS = 20  # halfway to the neighbours' mean: surroundings of about a hundred points
_RIDGE = 1e-3  # of the variance around a point, by which a rotation is preferred where planes do not tell
_LEAST_VARIANCE = 1e-12  # in squared diagonals, of which rounding makes no singular matrix
_FLAT = 1e-3  # volume of a unit cube after a map that can be undone
_LEAST_ENERGY = 0.25  # of the median, which is added: no place gains much weight by being quiet


class DeformedPoints(NamedTuple):
    """Where the points of an original are in a suspect that no single map brings back."""

    places: Points  # after a single map, in diagonals
    known: Bool[np.ndarray, " points"]  # mask of the points that were recognised


class Undeformed(NamedTuple):
    """A suspect without its bends."""

    displacement: Points  # in diagonals; 0 where nothing is known
    weights: Float64[np.ndarray, " points"]  # inverse energy around each point; 0 where nothing is known


def undo_deformation(operator: Laplacian, positions: Points, deformed: DeformedPoints) -> Undeformed:
    """Invert an affine map around each point, fitted to its surroundings.

    Its surroundings are weighed by diffusion. Moments of first and second order give the best map by least squares,
    with a ridge towards the best rotation (Kabsch, Acta Crystallographica A 32, 1976), which planes need. Where pieces
    join, no affine map fits: a point counts by the inverse energy of what its surroundings leave.

    Args:
        operator: the Laplacian of the original's points; only its edges count.
        positions: positions of these points, in diagonals.
        deformed: where they are in the suspect.
    """
    x, y, known = positions, deformed.places, deformed.known
    x, y = (np.where(known[:, None], points, 0) for points in (x, y))
    around = _Surroundings(operator, known)
    first = around.mean(np.concatenate([x, y], axis=1))
    centre, image = first[:, :3], first[:, 3:]
    second = around.mean(np.concatenate([_products(x, x), _products(x, y)], axis=1)).reshape(len(x), 2, 3, 3)
    variance, change = second[:, 0] - _outer(centre, centre), second[:, 1] - _outer(centre, image)
    u, _, vt = np.linalg.svd(change)
    signs = np.ones((len(x), 3, 1))
    signs[:, 2, 0] = np.sign(np.linalg.det(u @ vt))
    rotation = u @ (signs * vt)
    ridge = (_RIDGE * np.trace(variance, axis1=1, axis2=2) + _LEAST_VARIANCE)[:, None, None]
    # y - image = (x - centre) @ linear, nearly
    linear = np.linalg.solve(variance + ridge * np.eye(3), change + ridge * rotation)
    sound = known & (np.abs(np.linalg.det(linear)) > _FLAT)
    linear[~sound] = np.eye(3)
    back = centre + np.linalg.solve(linear.transpose(0, 2, 1), (y - image)[..., None])[..., 0]
    displacement = np.where(sound[:, None], back - x, 0)
    energy = around.mean(np.sum(displacement**2, axis=1, keepdims=True))[:, 0]
    middle = np.median(energy[sound]) if sound.any() else 0.0
    return Undeformed(displacement, np.where(sound, 1 / (energy / (middle or 1.0) + _LEAST_ENERGY), 0))


class _Surroundings:
    """Means over the known surroundings of each point."""

    def __init__(self, operator: Laplacian, known: Bool[np.ndarray, " points"]) -> None:
        count = len(known)
        pairs = np.asarray(operator.edges)
        pairs = pairs[(pairs < count).all(axis=1)]
        pairs = pairs[known[pairs].all(axis=1)]
        links = sparse.coo_array((np.ones(len(pairs)), tuple(pairs.T)), (count, count)).tocsr()
        links = links + links.T
        degree = np.asarray(links.sum(axis=1)).ravel()
        self._halfway = sparse.diags_array(0.5 / np.maximum(degree, 1)) @ links
        self._stays = np.where(degree > 0, 0.5, 1)[:, None]

    def mean(self, values: Float64[np.ndarray, "points columns"]) -> Float64[np.ndarray, "points columns"]:
        """The mean of each column around each point."""
        for _ in range(_STEPS):
            values = self._stays * values + self._halfway @ values
        return values


def _outer(x: Points, y: Points) -> Float64[np.ndarray, "points 3 3"]:
    return x[:, :, None] * y[:, None, :]


def _products(x: Points, y: Points) -> Float64[np.ndarray, "points 9"]:
    return _outer(x, y).reshape(len(x), 9)
