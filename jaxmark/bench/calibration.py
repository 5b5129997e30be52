"""False positives of readers, counted: thresholds, rates, and tests of proven bounds.

Nulls are scores of suspects without a mark of the key: unmarked meshes, attacked or not, marks of other methods, and of
other keys. Every null has a key of its own, so that given the suspects they are independent, and intervals exact.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.special import betaincinv

from jaxmark.bench.method import Method
from jaxmark.confidence import clopper_pearson

RATE = 0.01  # of false positives, at which methods are compared by default
_LEVELS = (-0.5, -1.0, -1.5, -2.0, -3.0, -4.0, -5.0, -6.0, -8.0, -10.0)  # log10, at which a bound is tested
_CONFIDENCE = 0.999  # one-sided, over all levels, before a bound or a stated rate is called violated
Scores = Float64[np.ndarray, " _"]


class Threshold(NamedTuple):
    """A score above which a suspect counts as marked, and its expected false-positive rate."""

    value: float
    rate: float
    low: float  # 95 % interval of the rate
    high: float
    reached: bool  # whether there are enough nulls for the rate that was asked for


class Count(NamedTuple):
    """Suspects that a rule accepts, with the exact 95 % interval of its rate."""

    hits: int
    trials: int
    low: float
    high: float


class Level(NamedTuple):
    """A bound at one level: how many nulls it calls less probable than that."""

    log10_p: float
    hits: int
    trials: int
    violated: bool


def threshold(nulls: Scores, rate: float = RATE) -> Threshold:
    """Choose the threshold whose expected false-positive rate is at most `rate`, from nulls alone.

    The share of further scores above the k-th largest of n nulls, all exchangeable, has the distribution
    Beta(k, n + 1 - k), for any distribution of the scores (Wilks, "Determination of sample sizes for setting tolerance
    limits", 1941). Its mean is k/(n + 1). Ties make the rate smaller.
    """
    ordered, count = np.sort(nulls)[::-1], len(nulls)
    place = max(int(np.floor(rate * (count + 1) + 1e-9)), 1)
    low, high = betaincinv(place, count + 1 - place, [0.025, 0.975])
    expected = place / (count + 1)
    return Threshold(float(ordered[place - 1]), expected, float(low), float(high), expected <= rate)


def count(accepted: Sequence[bool] | np.ndarray) -> Count:
    """Count acceptances; without trials the interval is [0, 1]."""
    if not len(accepted):
        return Count(0, 0, 0.0, 1.0)
    hits = int(np.sum(accepted))
    low, high = clopper_pearson(hits, len(accepted))
    return Count(hits, len(accepted), float(low), float(high))


def roc(nulls: Scores, marks: Scores) -> list[tuple[float, float]]:
    """Compute false- and true-positive rates at every threshold, from (0, 0) to (1, 1)."""
    edges = np.unique(np.concatenate([nulls, marks]))[::-1]
    return [(0.0, 0.0), *((float(np.mean(nulls >= edge)), float(np.mean(marks >= edge))) for edge in edges)]


def area_under(points: Sequence[tuple[float, float]]) -> float:
    """Compute the area under an ROC: the probability that a mark scores above a null, ties counted as a half."""
    false, true = np.transpose(points)
    return float(np.trapezoid(true, false))


def check_bound(nulls: Scores) -> list[Level]:
    """Compare a proven bound, log10 of probabilities of nulls, with how often it is passed."""
    levels, confidence = [], 1 - 2 * (1 - _CONFIDENCE) / len(_LEVELS)
    for level in _LEVELS:
        hits = int(np.sum(nulls <= level))
        low = float(clopper_pearson(hits, len(nulls), confidence).low)
        levels.append(Level(level, hits, len(nulls), low > 10**level))
    return levels


class Calibration(NamedTuple):
    """The counted false positives of a reader."""

    threshold: Threshold
    kinds: Mapping[str, Count]  # nulls above the threshold, by kind
    points: Sequence[tuple[float, float]]  # the ROC against its own marks after all attacks
    area: float
    own: Count | None  # nulls at the method's own threshold, where it has one
    stated: float  # the rate that the method states for that
    bound: Sequence[Level]  # empty where the method proves nothing

    @property
    def verdicts(self) -> list[str]:
        """Sentences on what does not hold."""
        said, own = [], self.own
        if not self.threshold.reached:
            said.append("Too few nulls for the rate that was asked for: the threshold is above all of them.")
        if own and own.trials and clopper_pearson(own.hits, own.trials, 2 * _CONFIDENCE - 1).low > self.stated:
            said.append(
                f"ITS OWN THRESHOLD IS TOO LOW: {own.hits} of {own.trials} nulls pass, where a rate of"
                f" {self.stated:g} is stated."
            )
        return said + [
            f"THE PROVEN BOUND IS VIOLATED: {level.hits} of {level.trials} nulls are said to be less probable"
            f" than 10^{level.log10_p:g}."
            for level in self.bound
            if level.violated
        ]


def calibrate(
    method: Method, nulls: Mapping[str, Sequence[tuple[float, float | None]]], marks: Scores, rate: float = RATE
) -> Calibration:
    """Calibrate a reader by nulls, which are pairs of a score and log10 p by kind, and by scores of its own marks."""
    scores = {kind: np.array([score for score, _ in some], float) for kind, some in nulls.items()}
    every = np.concatenate(list(scores.values()))
    # A reader that proves something returns None, or refuses, where it proves nothing.
    stated = [p for some in nulls.values() for _, p in some]
    proves = any(p is not None for p in stated)
    found = threshold(every, rate)
    points = roc(every, marks) if len(marks) else [(0.0, 0.0), (1.0, 1.0)]
    return Calibration(
        found,
        {kind: count(some > found.value) for kind, some in scores.items()},
        points,
        area_under(points),
        None if method.threshold is None else count(every >= method.threshold),
        method.rate,
        check_bound(np.array([0.0 if p is None else p for p in stated], float)) if proves else [],
    )
