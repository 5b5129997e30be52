"""From a suspect mesh to the displacement of each point of the original; host side, free of the key.

An affine attack moves the mark with the host. It is inverted by least squares before anything else, on the points that
agree with it: what lies far off was cut away, replaced or lost, and is masked.
"""

import numpy as np
from jaxtyping import Bool, Float64

from jaxmark.mesh import Mesh
from jaxmark.original import Original, residual

# A point is masked if it is off by more than this, and by more than so many times what 40 % of the points are off.
_FAR = 0.005
_OFF = 10.0
_TRIMS = 30
_ROUNDS = 10
_ROUNDING = 1e-12  # of sums over all points; a smaller residual is none


def align(original: Original, suspect: Mesh) -> tuple[Float64[np.ndarray, "points 3"], Float64[np.ndarray, " points"]]:
    """Bring a suspect back to the original by the best affine map, and see how far each point is still off.

    Args:
        original: from `prepare`.
        suspect: a mesh with the original's connectivity.

    Returns:
        The displacements in diagonals, and weights: 1, or 0 where a point is masked or no face uses it.

    Raises:
        JaxmarkError: if the suspect does not share the original's connectivity.
    """
    moved = residual(original, suspect)
    x = np.asarray(original.positions, np.float64)
    # A coordinate of 1e200 would spoil every sum; such a point is lost in any case.
    spread = np.abs(moved - np.median(moved[original.used], axis=0)).max(axis=1)
    sound = original.used & (spread <= 1e6 * max(np.quantile(spread[original.used], 0.6), 1e-6))
    x, y = x[sound], x[sound] + moved[sound]
    fits = [_fit(x, y, agreeing) for agreeing in (np.ones(len(x), bool), _agreeing(spread[sound]))]
    error, agreeing = min(fits, key=lambda fit: np.quantile(np.linalg.norm(fit[0], axis=1), 0.4))
    if np.abs(error[agreeing]).max() < _ROUNDING:
        error = np.zeros_like(error)
    displacement, weights = np.zeros(moved.shape), np.zeros(len(moved))
    displacement[sound] = np.where(agreeing[:, None], error, 0)
    weights[sound] = agreeing
    return displacement, weights


def _fit(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> tuple[Float64[np.ndarray, "points 3"], Bool[np.ndarray, " points"]]:
    """What is left of y - x after the affine map that fits the agreeing points, which it finds anew in each round."""
    # Least trimmed squares first: what is far off must not draw the fit towards itself.
    for _ in range(_TRIMS):
        error = np.linalg.norm(_affine(x, _similar(x, y, agreeing), agreeing) - x, axis=1)
        before, agreeing = agreeing, error <= np.quantile(error, 0.5)
        if np.array_equal(agreeing, before):
            break
    rounds = 0
    while True:
        error = _affine(x, _similar(x, y, agreeing), agreeing) - x
        before, agreeing = agreeing, _agreeing(np.linalg.norm(error, axis=1))
        rounds += 1
        if rounds == _ROUNDS or np.array_equal(agreeing, before):
            return error, agreeing


def _agreeing(error: Float64[np.ndarray, " points"]) -> Bool[np.ndarray, " points"]:
    return error <= max(_FAR, _OFF * np.quantile(error, 0.4))


def _similar(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> Float64[np.ndarray, "points 3"]:
    """The points y by the similarity that fits x best (Umeyama, IEEE PAMI 13, 1991, eq. 39-42)."""
    to, back = x[agreeing].mean(axis=0), y[agreeing].mean(axis=0)
    target, source = x[agreeing] - to, y[agreeing] - back
    u, size, vt = np.linalg.svd(target.T @ source)
    proper = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])  # a rotation, no reflection
    turn = u * proper @ vt
    scale = (size * proper).sum() / max((source**2).sum(), np.finfo(float).tiny)
    return to + scale * (y - back) @ turn.T


def _affine(
    x: Float64[np.ndarray, "points 3"], y: Float64[np.ndarray, "points 3"], agreeing: Bool[np.ndarray, " points"]
) -> Float64[np.ndarray, "points 3"]:
    """The points y by the affine map that fits x best."""
    to, back = x[agreeing].mean(axis=0), y[agreeing].mean(axis=0)
    source, difference = y[agreeing] - back, x[agreeing] - to - (y[agreeing] - back)
    variance, axes = np.linalg.eigh(source.T @ source)
    # Along an axis in which the shape is flat, the map would be fitted to the mark itself; there it stays as it is.
    inverse = np.where(variance > 1e-4 * variance[2], 1 / np.maximum(variance, 1e-300), 0)
    change = difference.T @ source @ (axes * inverse) @ axes.T
    return to + (y - back) @ (np.eye(3) + change).T
