"""Confidence intervals of counted proportions."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike
from scipy.special import betaincinv  # scipy.stats takes long to import

from jaxmark.errors import JaxmarkError


class Interval(NamedTuple):
    """Confidence intervals of probabilities."""

    low: Float64[np.ndarray, "*places"]  # lower bounds in [0, 1]
    high: Float64[np.ndarray, "*places"]  # upper bounds in [0, 1]


def clopper_pearson(successes: ArrayLike, trials: ArrayLike, confidence: float = 0.95) -> Interval:
    """Compute the exact confidence interval of a probability (Clopper, Pearson, Biometrika 26, 1934).

    The interval covers the true probability with a probability of at least `confidence`, for any number of trials. Each
    end fails with at most half of the remaining probability, so that one end alone is a bound with the confidence
    (1 + confidence)/2.

    Args:
        successes: numbers of successful trials, whole, of any shape.
        trials: numbers of all trials, whole, at least 1 each; broadcast against `successes`.
        confidence: least probability that the interval covers the true probability, in (0, 1).

    Returns:
        The bounds, in the broadcast shape.

    Raises:
        JaxmarkError: if a count or the confidence is out of range.
    """
    counts, total = np.broadcast_arrays(np.asarray(successes, np.float64), np.asarray(trials, np.float64))
    if not ((counts == np.floor(counts)) & (total == np.floor(total)) & (counts >= 0) & (counts <= total)).all():
        raise JaxmarkError("An interval needs whole numbers of trials and successes, with at most as many successes.")
    if not ((total >= 1).all() and 0 < confidence < 1):
        raise JaxmarkError(f"An interval needs at least one trial, and a confidence in (0, 1), got {confidence:g}.")
    missed, failures = (1 - confidence) / 2, total - counts
    # Quantiles of beta distributions; without successes the lower bound is 0, without failures the upper bound is 1.
    low = np.where(counts > 0, betaincinv(np.maximum(counts, 1), failures + 1, missed), 0.0)
    high = np.where(failures > 0, betaincinv(counts + 1, np.maximum(failures, 1), 1 - missed), 1.0)
    return Interval(low, high)
