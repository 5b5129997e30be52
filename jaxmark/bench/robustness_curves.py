"""Robustness curves: the share of marks that survive over the distortion by the attack, and the areas under them.

In the manner of WAVES (An et al., "Benchmarking the robustness of image watermarks", ICML 2024): an attack that ruins
the mesh does not count against a method, and one that is invisible counts in full.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.optimize import isotonic_regression

#: The metrics of cost, and the ends of their axes: from hardly measurable to a shape that nobody wants.
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
    marked: bool = True  # False where no mark could be made, which is lost at any cost


class Score(NamedTuple):
    """The share of the cost axes, 0 to 1, over which a mark survives, and its 95 % interval."""

    value: float
    low: float
    high: float
    areas: Mapping[str, float]  # by metric
    points: int


def axis(metric: str) -> Values:
    """Return the costs at which curves are evaluated."""
    return np.geomspace(*RANGES[metric], _PLACES)


def curve(points: Sequence[Point], metric: str, weights: Weights | None = None) -> Values | None:
    """Fit a falling curve over `axis(metric)` by isotonic regression, every attack counting alike.

    It is constant beyond the least and the largest cost. The curve is lowered to the share of
    suspects for which a mark could be made: a method gains nothing by refusing.

    Args:
        points: suspects.
        metric: of `RANGES`.
        weights: how often each point counts.

    Returns:
        The share of marks that survive, at each cost; None if no cost is known.
    """
    times = np.ones(len(points)) if weights is None else weights
    known = np.array([one.costs.get(metric) is not None for one in points], bool) & (times > 0)
    if not known.any():
        return None
    low, high = RANGES[metric]
    some, weight = [one for one, there in zip(points, known, strict=True) if there], times[known]
    kind = np.unique([one.attack for one in some], return_inverse=True)[1]
    share = weight / np.bincount(kind, weight)[kind]
    # Ties have one value, whatever their order.
    distinct, group = np.unique(np.clip([one.costs[metric] or 0.0 for one in some], low, high), return_inverse=True)
    total = np.bincount(group, share)
    mean = np.bincount(group, share * [one.success for one in some]) / total
    fitted = isotonic_regression(mean, weights=total, increasing=False).x
    marked = float(times @ [one.marked for one in points] / times.sum())
    return marked * np.interp(np.log(axis(metric)), np.log(distinct), fitted)


def score(points: Sequence[Point]) -> Score | None:
    """Average the areas under the curves over all metrics, with an interval by bootstrap; None without points.

    Meshes and seeds are drawn with replacement, all suspects of a pair together (500 times). One mesh has no bearing on
    others: its interval is from 0 to 1.
    """
    areas = _areas(points, None)
    if not areas:
        return None
    places = [np.unique(field, return_inverse=True)[1] for field in zip(*(one[:2] for one in points), strict=True)]
    random, values = np.random.default_rng(0), []
    for _ in range(_RESAMPLES):
        weights = np.ones(len(points))
        for place in places:
            count = place.max() + 1
            weights *= np.bincount(random.integers(count, size=count), minlength=count)[place]
        if drawn := _areas(points, weights):
            values.append(np.mean(list(drawn.values())))
    alone = len({one.mesh for one in points if one.marked}) == 1
    low, high = (0.0, 1.0) if alone else np.quantile(values, [0.025, 0.975])
    return Score(float(np.mean(list(areas.values()))), float(low), float(high), areas, len(points))


def _areas(points: Sequence[Point], weights: Weights | None) -> dict[str, float]:
    curves = {metric: curve(points, metric, weights) for metric in RANGES}
    return {metric: float(np.mean(one)) for metric, one in curves.items() if one is not None}
