"""Robust fits of affine maps from recognised points of a suspect to the original, if some points are lost or edited."""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.alignment.result import rms
from jaxmark.geometry.pose import Points, Pose, affine, similarity

# A point is masked if its residual exceeds both FAR_DISTANCE (in diagonals) and _FAR_MULTIPLE times the 40 % quantile
# of all residuals. A suspect whose RMS residual exceeds FAR_DISTANCE is only accepted if no other alignment fits
# better.
FAR_DISTANCE, _FAR_MULTIPLE = 0.005, 10.0
_MAX_TRIMMING_ROUNDS = 30  # rounds of fitting a map to the half of the points with the smallest residuals
_MAX_AGREEING_ROUNDS = 10  # rounds of fitting a map to the points that agree with it
_MAX_FIT_POINTS = 50_000  # random points to which a map is fitted before it is refined by all points
_MIN_PIECE_POINTS, MIN_PIECE_SHARE = 100, 0.01  # least points, and least coverage, of a piece with its own map

Mask = Bool[np.ndarray, " points"]
Distances = Float64[np.ndarray, " points"]


def agreeing(error: Distances, among: Mask | slice = slice(None)) -> Mask:
    """Return a mask of the points that agree: whose residuals are small, compared with those of some points."""
    return error <= max(FAR_DISTANCE, _FAR_MULTIPLE * np.quantile(error[among], 0.4))


def fit_whole(x: Points, y: Points, sound: Mask, spread: Distances) -> tuple[Pose, Mask]:
    """Fit the map from y to x on which most points agree.

    Args:
        x: the original's points.
        y: the suspect's.
        sound: mask of the recognised points with usable coordinates.
        spread: difference of each point's movement from the median movement.

    Returns:
        The map, and a mask of the points that agree with it.
    """
    pose, near = _fit(x[sound], y[sound], np.ones(sound.sum(), bool))
    # If all points agree, no other start gives another map.
    if not near.all():
        fits = (pose, near), _fit(x[sound], y[sound], agreeing(spread[sound]))
        pose, near = min(fits, key=lambda fit: np.quantile(_distance(fit[0](y[sound]), x[sound]), 0.4))
    mask = np.zeros(len(x), bool)
    mask[sound] = near
    return pose, mask


def fit_pieces(
    x: Points, y: Points, label: Int64[np.ndarray, " points"]
) -> list[tuple[Int64[np.ndarray, " agreeing"], Pose]]:
    """Fit a separate map to each piece, the largest first; returns the points that agree with it, and the map.

    Args:
        x: the original's points.
        y: the suspect's.
        label: the number of each point's piece, or -1.
    """
    fits = []
    size = np.bincount(label[label >= 0], minlength=1)
    for piece in np.argsort(-size, kind="stable")[: np.sum(size >= min_piece_points(x))]:
        points = np.flatnonzero(label == piece)
        back, near = _fit(x[points], y[points], np.ones(len(points), bool))
        if 2 * near.sum() >= len(points) and rms((back(y[points]) - x[points])[near]) <= FAR_DISTANCE:
            fits.append((points[near], back))
    return fits


def min_piece_points(x: Points) -> float:
    """Return the least number of points of a piece with its own map."""
    return max(_MIN_PIECE_POINTS, MIN_PIECE_SHARE * len(x))


def _fit(x: Points, y: Points, near: Mask) -> tuple[Pose, Mask]:
    """Fit an affine map from y to x to the points that agree with it; each round determines these points again."""
    if len(x) <= _MAX_FIT_POINTS:
        return _fit_to_all(x, y, near)
    # The map is fitted to a sample of the points, and refined in two rounds with all points.
    chosen = np.sort(np.random.default_rng(0).permutation(len(x))[:_MAX_FIT_POINTS])
    pose = _fit_to_all(x[chosen], y[chosen], near[chosen])[0]
    near = agreeing(_distance(pose(y), x))
    for _ in range(2):
        pose = _map(x, y, near)
        before, near = near, agreeing(_distance(pose(y), x))
        if np.array_equal(near, before):
            break
    return pose, near


def _fit_to_all(x: Points, y: Points, near: Mask) -> tuple[Pose, Mask]:
    # The first rounds are least trimmed squares, so that points with large residuals do not bias the fit.
    for _ in range(_MAX_TRIMMING_ROUNDS):
        error = _distance(_map(x, y, near)(y), x)
        before, near = near, error <= np.quantile(error, 0.5)
        if np.array_equal(near, before):
            break
    rounds = 0
    while True:
        pose = _map(x, y, near)
        before, near = near, agreeing(_distance(pose(y), x))
        rounds += 1
        if rounds == _MAX_AGREEING_ROUNDS or np.array_equal(near, before):
            return pose, near


def _map(x: Points, y: Points, near: Mask) -> Pose:
    """Fit a similarity to the points that agree, and then an affine map to the residual of the similarity."""
    nearly = similarity(y[near], x[near], mirrored=None)
    return nearly.then(affine(nearly(y[near]), x[near]))


def _distance(x: Points, y: Points) -> Distances:
    difference = x - y
    return np.sqrt(np.einsum("pc,pc->p", difference, difference))
