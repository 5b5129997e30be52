"""Paired comparison of two methods on the same suspects: McNemar's test, and Newcombe's interval."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import bdtr, ndtri

from jaxmark.errors import JaxmarkError


class Paired(NamedTuple):
    """The paired comparison of two methods on the same meshes, samples and attacks."""

    both: int  # pairs in which both methods succeed
    first: int  # pairs in which only the first method succeeds
    second: int  # pairs in which only the second method succeeds
    neither: int  # pairs in which no method succeeds
    p: float  # two-sided p-value of the hypothesis that both methods succeed equally often
    difference: float  # success rate of the first method minus that of the second
    low: float  # lower end of the difference's confidence interval
    high: float  # upper end of the interval


def compare_paired(first: Sequence[bool], second: Sequence[bool], confidence: float = 0.95) -> Paired:
    """Compare the successes of two methods on the same suspects.

    The p-value is that of McNemar's exact test, a binomial test on the discordant pairs. The interval is method 10 of
    Newcombe, "Improved confidence intervals for the difference between binomial proportions based on paired data",
    Statistics in Medicine 17, 1998: it combines Wilson's intervals of both rates and their correlation.

    Args:
        first: whether the first method succeeds, for each suspect.
        second: whether the second method succeeds, in the same order.
        confidence: confidence of the interval, in (0, 1).

    Raises:
        JaxmarkError: if the numbers of suspects differ, or are 0.
    """
    if len(first) != len(second) or not len(first):
        raise JaxmarkError(f"A paired comparison needs pairs, got {len(first)} and {len(second)} successes.")
    x, y = np.asarray(first, bool), np.asarray(second, bool)
    a, b, c, d = (int(np.sum(cell)) for cell in (x & y, x & ~y, ~x & y, ~x & ~y))
    p = min(2 * float(bdtr(min(b, c), b + c, 0.5)), 1.0) if b + c else 1.0
    count, z = len(x), float(ndtri((1 + confidence) / 2))
    rate1, rate2, difference = (a + b) / count, (a + c) / count, (b - c) / count
    (low1, high1), (low2, high2) = _wilson(rate1, count, z), _wilson(rate2, count, z)
    products, excess = (a + b) * (c + d) * (a + c) * (b + d), a * d - b * c
    # A positive correlation is corrected for continuity.
    phi = (max(excess - count / 2, 0) if excess > 0 else excess) / math.sqrt(products) if products else 0.0

    def joined(x: float, y: float) -> float:
        return math.sqrt(max(x * x - 2 * phi * x * y + y * y, 0.0))

    low = difference - joined(rate1 - low1, high2 - rate2)
    return Paired(a, b, c, d, p, difference, low, difference + joined(high1 - rate1, rate2 - low2))


def _wilson(rate: float, count: int, z: float) -> tuple[float, float]:
    """Compute the score interval of a rate (Wilson 1927)."""
    middle, reach = rate + z * z / (2 * count), z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    return (middle - reach) / (1 + z * z / count), (middle + reach) / (1 + z * z / count)
