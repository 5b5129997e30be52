"""What survives, over what the attack itself costs the shape: curves, the areas under them, and one score a league.

In the manner of WAVES (An et al., "Benchmarking the robustness of image watermarks", ICML 2024): an attack that ruins
the mesh is no merit of the attacker, one that nobody sees no excuse of the method.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.optimize import isotonic_regression

#: The metrics of cost, and where their axes begin and end: from hardly measurable to a shape that nobody wants.
RANGES: Mapping[str, tuple[float, float]] = {"mrms": (1e-4, 1e-2), "dame": (5e-3, 0.5), "msdm2": (0.05, 0.8)}
_PLACES, _RESAMPLES = 64, 500


class Point(NamedTuple):
    """One suspect: what the attack cost, and whether the mark survived."""

    mesh: str
    seed: int
    attack: str
    costs: Mapping[str, float | None]
    success: bool
    marked: bool = True  # False where no mark could be made, which is lost at any cost


class Score(NamedTuple):
    """A share of the cost axes, 0 to 1, over which a mark survives, and its 95 % interval."""

    value: float
    low: float
    high: float
    areas: Mapping[str, float]  # by metric
    points: int


class Curve(NamedTuple):
    """How often marks survive at a cost."""

    cost: Float64[np.ndarray, " places"]
    success: Float64[np.ndarray, " places"]


def curve(points: Sequence[Point], metric: str, weights: Float64[np.ndarray, " points"] | None = None) -> Curve | None:
    """The falling curve that fits best, every attack counting alike; None if no cost is known.

    Beyond the least and the largest cost that there is, it goes on as it is there. Where some suspects have no mark, as
    none could be made, the curve of the others is lowered to their share: a method gains nothing by refusing.

    Args:
        points: suspects.
        metric: of `RANGES`.
        weights: how often each point counts.
    """
    times = np.ones(len(points)) if weights is None else weights
    known = [
        (one, float(w)) for one, w in zip(points, times, strict=True) if one.costs.get(metric) is not None and w > 0
    ]
    if not known:
        return None
    low, high = RANGES[metric]
    sizes: dict[str, float] = {}
    for one, weight in known:
        sizes[one.attack] = sizes.get(one.attack, 0.0) + weight
    cost = np.array([np.clip(one.costs[metric] or 0.0, low, high) for one, _ in known])
    share = np.array([weight / sizes[one.attack] for one, weight in known])
    distinct, group = np.unique(cost, return_inverse=True)  # ties have one value, whatever their order
    weight = np.bincount(group, share)
    mean = np.bincount(group, share * [one.success for one, _ in known]) / weight
    fitted = isotonic_regression(mean, weights=weight, increasing=False).x
    axis = np.geomspace(low, high, _PLACES)
    marked = float(times @ [one.marked for one in points] / times.sum())
    return Curve(axis, marked * np.interp(np.log(axis), np.log(distinct), fitted))


def score(points: Sequence[Point]) -> Score | None:
    """The mean of the areas under the curves over all metrics, with an interval by bootstrap; None without points.

    Meshes and seeds are drawn again with replacement, all suspects of a pair together (500 times). One mesh says
    nothing of others: its interval is from 0 to 1.
    """
    found = _areas(points, None)
    if not found:
        return None
    meshes, seeds = sorted({one.mesh for one in points}), sorted({one.seed for one in points})
    at = np.array([[meshes.index(one.mesh), seeds.index(one.seed)] for one in points]).T
    random, values = np.random.default_rng(0), []
    for _ in range(_RESAMPLES):
        times = [
            np.bincount(random.integers(len(some), size=len(some)), minlength=len(some)) for some in (meshes, seeds)
        ]
        areas = _areas(points, (times[0][at[0]] * times[1][at[1]]).astype(float))
        if areas:
            values.append(np.mean(list(areas.values())))
    alone = len({one.mesh for one in points if one.marked}) == 1  # nothing is known of others
    low, high = (0.0, 1.0) if alone else np.quantile(values, [0.025, 0.975])
    return Score(float(np.mean(list(found.values()))), float(low), float(high), found, len(points))


def _areas(points: Sequence[Point], weights: Float64[np.ndarray, " points"] | None) -> dict[str, float]:
    curves = {metric: curve(points, metric, weights) for metric in RANGES}
    return {metric: float(np.mean(one.success)) for metric, one in curves.items() if one is not None}
