"""Affine maps that bring a suspect's recognised points onto the original's, where some points are lost or edited."""

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.alignment.result import rms
from jaxmark.geometry.pose import Points, Pose, affine, similarity

# A point is masked if it is off by more than the distance (in diagonals), and by more than the multiple of the 40 %
# quantile of all points' distances. A suspect whose residual exceeds the distance is aligned if nothing fits better.
FAR_DISTANCE, _FAR_MULTIPLE = 0.005, 10.0
_MAX_TRIMMING_ROUNDS = 30  # rounds of fitting a map to the better half of the points
_MAX_AGREEING_ROUNDS = 10  # rounds of fitting a map to the points that agree with it
_MAX_FIT_POINTS = 50_000  # random points by which a map is found before all points refine it
_MIN_PIECE_POINTS, MIN_PIECE_SHARE = 100, 0.01  # a piece with a map of its own shows this much of the original

Mask = Bool[np.ndarray, " points"]
Distances = Float64[np.ndarray, " points"]


def agreeing(error: Distances, among: Mask | slice = slice(None)) -> Mask:
    """Return a mask of the points that are not far off, compared with some of them."""
    return error <= max(FAR_DISTANCE, _FAR_MULTIPLE * np.quantile(error[among], 0.4))


def fit_whole(x: Points, y: Points, sound: Mask, spread: Distances) -> tuple[Pose, Mask]:
    """Fit the map from y to x on which most points agree.

    Args:
        x: the original's points.
        y: the suspect's.
        sound: mask of the points that were recognised.
        spread: how far each was moved beyond the most usual movement.

    Returns:
        The map, and a mask of the points that agree with it.
    """
    pose, near = _fit(x[sound], y[sound], np.ones(sound.sum(), bool))
    # If all points agree, another start finds no other map.
    if not near.all():
        fits = (pose, near), _fit(x[sound], y[sound], agreeing(spread[sound]))
        pose, near = min(fits, key=lambda fit: np.quantile(_distance(fit[0](y[sound]), x[sound]), 0.4))
    found = np.zeros(len(x), bool)
    found[sound] = near
    return pose, found


def fit_pieces(
    x: Points, y: Points, label: Int64[np.ndarray, " points"]
) -> list[tuple[Int64[np.ndarray, " agreeing"], Pose]]:
    """Fit a map of its own to each piece, the largest first; returns the points that agree on it, and the map.

    Points are labelled with the number of their piece, or -1.
    """
    found = []
    size = np.bincount(label[label >= 0], minlength=1)
    for piece in np.argsort(-size, kind="stable")[: np.sum(size >= min_piece_points(x))]:
        points = np.flatnonzero(label == piece)
        back, near = _fit(x[points], y[points], np.ones(len(points), bool))
        if 2 * near.sum() >= len(points) and rms((back(y[points]) - x[points])[near]) <= FAR_DISTANCE:
            found.append((points[near], back))
    return found


def min_piece_points(x: Points) -> float:
    """Return how many points a piece with a map of its own has at least."""
    return max(_MIN_PIECE_POINTS, MIN_PIECE_SHARE * len(x))


def _fit(x: Points, y: Points, near: Mask) -> tuple[Pose, Mask]:
    """Fit an affine map that brings y onto x to the points that agree with it, which are found again in each round."""
    if len(x) <= _MAX_FIT_POINTS:
        return _fit_to_all(x, y, near)
    # A sample finds the map; two rounds with all points make it exact.
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
    # Least trimmed squares come first, because points that are far off must not draw the fit towards themselves.
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
    """Fit a similarity to the points that agree, and an affine map to what the similarity leaves."""
    nearly = similarity(y[near], x[near], mirrored=None)
    return nearly.then(affine(nearly(y[near]), x[near]))


def _distance(x: Points, y: Points) -> Distances:
    difference = x - y
    return np.sqrt(np.einsum("pc,pc->p", difference, difference))
