"""Robustness curves: the fraction of marks that survive, as a function of the attack's distortion, and their areas.

The scores follow WAVES (An et al., "Benchmarking the robustness of image watermarks", ICML 2024): an attack that
destroys the mesh does not count against a method, and an invisible attack counts in full.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.optimize import isotonic_regression

#: The metrics of distortion, and the ends of their axes: from hardly measurable to useless meshes.
RANGES: Mapping[str, tuple[float, float]] = {"mrms": (1e-4, 1e-2), "dame": (5e-3, 0.5), "msdm2": (0.05, 0.8)}
_PLACES, _RESAMPLES = 64, 500
Weights = Float64[np.ndarray, " points"]
Values = Float64[np.ndarray, " places"]


class Point(NamedTuple):
    """One suspect: the distortion by the attack, and whether the mark survived."""

    mesh: str
    seed: int
    attack: str
    costs: Mapping[str, float | None]
    success: bool
    marked: bool = True  # False if no mark could be made; it then counts as lost at any distortion


class Score(NamedTuple):
    """The mean area under the robustness curves, from 0 to 1, and its 95 % interval."""

    value: float
    low: float
    high: float
    areas: Mapping[str, float]  # by metric
    points: int


def axis(metric: str) -> Values:
    """Return the distortions at which curves are evaluated."""
    return np.geomspace(*RANGES[metric], _PLACES)


def curve(points: Sequence[Point], metric: str, weights: Weights | None = None) -> Values | None:
    """Fit a decreasing curve over `axis(metric)` by isotonic regression; every attack has the same weight.

    The curve is constant below the least and above the largest distortion. It is multiplied by the fraction of suspects
    for which a mark could be made, so that a method gains nothing by refusing meshes.

    Args:
        points: suspects.
        metric: a metric of `RANGES`.
        weights: weights of the points; all 1 by default.

    Returns:
        The fraction of marks that survive, at each distortion; None if no distortion is known.
    """
    times = np.ones(len(points)) if weights is None else weights
    known = np.array([point.costs.get(metric) is not None for point in points], bool) & (times > 0)
    if not known.any():
        return None
    low, high = RANGES[metric]
    some, weight = [point for point, is_known in zip(points, known, strict=True) if is_known], times[known]
    kind = np.unique([point.attack for point in some], return_inverse=True)[1]
    share = weight / np.bincount(kind, weight)[kind]
    # Points of equal distortion are averaged first, so that their order has no effect.
    costs = np.clip([point.costs[metric] or 0.0 for point in some], low, high)
    distinct, group = np.unique(costs, return_inverse=True)
    total = np.bincount(group, share)
    mean = np.bincount(group, share * [point.success for point in some]) / total
    fitted = isotonic_regression(mean, weights=total, increasing=False).x
    marked = float(times @ [point.marked for point in points] / times.sum())
    return marked * np.interp(np.log(axis(metric)), np.log(distinct), fitted)


def score(points: Sequence[Point]) -> Score | None:
    """Average the areas under the curves over all metrics, with a bootstrap interval; returns None without points.

    The bootstrap draws meshes and seeds with replacement, 500 times; all suspects of a mesh and seed stay together. If
    there is only one mesh, the interval is from 0 to 1, because one mesh says nothing about others.
    """
    areas = _areas(points, None)
    if not areas:
        return None
    places = [np.unique(field, return_inverse=True)[1] for field in zip(*(point[:2] for point in points), strict=True)]
    random, values = np.random.default_rng(0), []
    for _ in range(_RESAMPLES):
        weights = np.ones(len(points))
        for place in places:
            count = place.max() + 1
            weights *= np.bincount(random.integers(count, size=count), minlength=count)[place]
        if drawn := _areas(points, weights):
            values.append(np.mean(list(drawn.values())))
    is_single = len({point.mesh for point in points if point.marked}) == 1
    low, high = (0.0, 1.0) if is_single else np.quantile(values, [0.025, 0.975])
    return Score(float(np.mean(list(areas.values()))), float(low), float(high), areas, len(points))


def _areas(points: Sequence[Point], weights: Weights | None) -> dict[str, float]:
    curves = {metric: curve(points, metric, weights) for metric in RANGES}
    return {metric: float(np.mean(values)) for metric, values in curves.items() if values is not None}
