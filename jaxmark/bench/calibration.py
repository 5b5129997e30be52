"""Calibration of readers by counted false positives: thresholds, rates, and tests of proven bounds.

A null is the score of a suspect without a mark of the key: of an unmarked mesh, attacked or not, of a mark of another
method, or of a mark of another key. Every null has its own key. Therefore nulls are independent, given the suspects,
and intervals are exact.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.special import betaincinv

from jaxmark.bench.method import Method
from jaxmark.confidence import clopper_pearson

RATE = 0.01  # default false-positive rate at which methods are compared
_LEVELS = (-0.5, -1.0, -1.5, -2.0, -3.0, -4.0, -5.0, -6.0, -8.0, -10.0)  # log10 of probabilities to test a bound at
_CONFIDENCE = 0.999  # one-sided, for all levels together: confidence at which a bound or a stated rate is violated
Scores = Float64[np.ndarray, " _"]


class Threshold(NamedTuple):
    """A score above which a suspect counts as marked, and its expected false-positive rate."""

    value: float
    rate: float
    low: float  # 95 % interval of the rate
    high: float
    reached: bool  # whether there are enough nulls for the requested rate


class Count(NamedTuple):
    """The number of suspects that a rule accepts, with the exact 95 % interval of the rate."""

    hits: int
    trials: int
    low: float
    high: float


class Level(NamedTuple):
    """The test of a bound at one level: the number of nulls whose stated probability is at most that level."""

    log10_p: float
    hits: int
    trials: int
    violated: bool


def threshold(nulls: Scores, rate: float = RATE) -> Threshold:
    """Choose a threshold from nulls so that the expected false-positive rate is at most `rate`.

    If scores are exchangeable, the fraction of further scores above the k-th largest of n nulls has the distribution
    Beta(k, n + 1 - k), for any continuous distribution of the scores (Wilks, "Determination of sample sizes for setting
    tolerance limits", 1941). Its mean is k/(n + 1). Ties make the rate smaller.
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
    """Test a proven bound: compare the stated probabilities of nulls (log10) with their counted frequency."""
    levels, confidence = [], 1 - 2 * (1 - _CONFIDENCE) / len(_LEVELS)
    for level in _LEVELS:
        hits = int(np.sum(nulls <= level))
        low = float(clopper_pearson(hits, len(nulls), confidence).low)
        levels.append(Level(level, hits, len(nulls), low > 10**level))
    return levels


class Calibration(NamedTuple):
    """The calibration of a reader by its false positives."""

    threshold: Threshold
    kinds: Mapping[str, Count]  # nulls above the threshold, by kind
    points: Sequence[tuple[float, float]]  # the ROC of nulls and of the method's marks after all attacks
    area: float  # the area under the ROC
    own: Count | None  # nulls at the method's own threshold; None if it has none
    stated: float  # the false-positive rate that the method states for its own threshold
    bound: Sequence[Level]  # the tests of the method's bound; empty if it proves none

    @property
    def verdicts(self) -> list[str]:
        """The problems of the reader, one sentence each."""
        sentences, own = [], self.own
        if not self.threshold.reached:
            sentences.append("There are too few nulls for the requested rate: the threshold is above all of them.")
        if own and own.trials and clopper_pearson(own.hits, own.trials, 2 * _CONFIDENCE - 1).low > self.stated:
            sentences.append(
                f"ITS OWN THRESHOLD IS TOO LOW: {own.hits} of {own.trials} nulls exceed it, but the stated rate is"
                f" {self.stated:g}."
            )
        return sentences + [
            f"THE PROVEN BOUND IS VIOLATED: {level.hits} of {level.trials} nulls have a stated probability of at most"
            f" 10^{level.log10_p:g}."
            for level in self.bound
            if level.violated
        ]


def calibrate(
    method: Method, nulls: Mapping[str, Sequence[tuple[float, float | None]]], marks: Scores, rate: float = RATE
) -> Calibration:
    """Calibrate a reader by nulls and by the scores of its own marks.

    Args:
        method: the method.
        nulls: pairs of score and log10 p, by kind of null.
        marks: scores of the method's own marks.
        rate: false-positive rate of the threshold.
    """
    scores = {kind: np.array([score for score, _ in some], float) for kind, some in nulls.items()}
    every = np.concatenate(list(scores.values()))
    # A reader with a proven bound may return None, or refuse a suspect; this counts as a probability of 1.
    stated = [p for some in nulls.values() for _, p in some]
    proves = any(p is not None for p in stated)
    chosen = threshold(every, rate)
    points = roc(every, marks) if len(marks) else [(0.0, 0.0), (1.0, 1.0)]
    return Calibration(
        chosen,
        {kind: count(some > chosen.value) for kind, some in scores.items()},
        points,
        area_under(points),
        None if method.threshold is None else count(every >= method.threshold),
        method.rate,
        check_bound(np.array([0.0 if p is None else p for p in stated], float)) if proves else [],
    )
