"""How sure a share is that was counted: intervals of confidence."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike
from scipy.special import betaincinv  # scipy.stats takes long to import

from jaxmark.errors import JaxmarkError


class Interval(NamedTuple):
    """Bounds of probabilities, each in [0, 1]."""

    low: Float64[np.ndarray, "*places"]
    high: Float64[np.ndarray, "*places"]


def clopper_pearson(successes: ArrayLike, trials: ArrayLike, confidence: float = 0.95) -> Interval:
    """The exact interval of a probability by how often something happened (Clopper, Pearson, Biometrika 26, 1934).

    It covers the truth at least as often as it says, for any number of trials; half of what it may miss lies on each
    side, so that one end alone is a bound of confidence (1 + confidence)/2.

    Args:
        successes: how often it happened, whole numbers, of any shape.
        trials: how often it was tried, at least 1 each; broadcast with them.
        confidence: probability that the interval covers the truth, in (0, 1).

    Raises:
        JaxmarkError: if a count or the confidence is out of range.
    """
    counts, total = np.broadcast_arrays(np.asarray(successes, np.float64), np.asarray(trials, np.float64))
    if not ((counts == np.floor(counts)) & (total == np.floor(total)) & (counts >= 0) & (counts <= total)).all():
        raise JaxmarkError("An interval needs whole numbers of trials, and of successes from 0 to as many.")
    if not ((total >= 1).all() and 0 < confidence < 1):
        raise JaxmarkError(f"An interval needs one trial or more, and a confidence in (0, 1), got {confidence:g}.")
    missed, failures = (1 - confidence) / 2, total - counts
    # The quantiles of beta distributions; where one has no mass the interval reaches to the end.
    low = np.where(counts > 0, betaincinv(np.maximum(counts, 1), failures + 1, missed), 0.0)
    high = np.where(failures > 0, betaincinv(counts + 1, np.maximum(failures, 1), 1 - missed), 1.0)
    return Interval(low, high)
