"""Non-rigid registration: a separate affine map for the neighbourhood of each recognised point.

A character in another pose, or a bent part, moves in rigid or sheared pieces with smooth transitions. Near each point,
the suspect is approximately an affine map of the original. The residual of this map is noise and the mark, which is
transformed with its neighbourhood. All computations run on the host, without the key.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy import sparse

from jaxmark.geometry.pose import Points
from jaxmark.spectral.laplacian import Laplacian

_STEPS = 20  # diffusion steps, each halfway to the neighbours' mean: neighbourhoods of about a hundred points
_RIDGE = 1e-3  # weight of the rotation in the fit, relative to the variance around a point; it decides in flat regions
_LEAST_VARIANCE = 1e-12  # in squared diagonals; added to the variance, so that no matrix is singular
_FLAT = 1e-3  # least absolute determinant of a map that is inverted
_LEAST_ENERGY = 0.25  # fraction of the median energy that is added to each energy, to limit the weights


class DeformedPoints(NamedTuple):
    """The positions of an original's points in a suspect that no single affine map aligns."""

    places: Points  # positions after the best single map, in diagonals
    known: Bool[np.ndarray, " points"]  # mask of the points that were recognised


class Undeformed(NamedTuple):
    """The displacements of an original's points after non-rigid registration."""

    displacement: Points  # in diagonals; 0 for unknown points
    weights: Float64[np.ndarray, " points"]  # inverse energy of the residual around each point; 0 for unknown points


def undo_deformation(operator: Laplacian, positions: Points, deformed: DeformedPoints) -> Undeformed:
    """Invert the affine map of each point's neighbourhood.

    The points of a neighbourhood are weighted by diffusion. Their first and second moments give the affine map, by
    least squares with a ridge towards the best rotation (Kabsch, Acta Crystallographica A 32, 1976), which flat
    neighbourhoods need. Where pieces meet, no affine map fits. Therefore each point is weighted by the inverse energy
    of the residual in its neighbourhood.

    Args:
        operator: the Laplacian of the original's points; only its edges are used.
        positions: positions of the original's points, in diagonals.
        deformed: positions of the points in the suspect.
    """
    x, y, known = positions, deformed.places, deformed.known
    x, y = (np.where(known[:, None], points, 0) for points in (x, y))
    around = _Neighbourhoods(operator, known)
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


class _Neighbourhoods:
    """The neighbourhoods of all points, restricted to known points."""

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
        """Compute the weighted mean of each column over the neighbourhood of each point."""
        for _ in range(_STEPS):
            values = self._stays * values + self._halfway @ values
        return values


def _outer(x: Points, y: Points) -> Float64[np.ndarray, "points 3 3"]:
    return x[:, :, None] * y[:, None, :]


def _products(x: Points, y: Points) -> Float64[np.ndarray, "points 9"]:
    return _outer(x, y).reshape(len(x), 9)
