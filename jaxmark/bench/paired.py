"""Paired comparison of two methods on the same suspects: McNemar's test, and Newcombe's interval."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import bdtr, ndtri

from jaxmark.errors import JaxmarkError


class Paired(NamedTuple):
    """The difference of two methods on the same meshes, samples and attacks."""

    both: int
    first: int  # pairs where only the first succeeds
    second: int
    neither: int
    p: float  # two-sided, that the discordant pairs fall so unequally if both are as good
    difference: float  # of the rates, the first's less the second's
    low: float
    high: float


def compare_paired(first: Sequence[bool], second: Sequence[bool], confidence: float = 0.95) -> Paired:
    """Compare successes of two methods, pair by pair.

    The p-value is McNemar's, exact: the discordant pairs are tosses of a fair coin. The interval is the tenth of
    Newcombe, "Improved confidence intervals for the difference between binomial proportions based on paired data",
    Statistics in Medicine 17, 1998: Wilson's intervals of both rates, joined by their correlation.

    Args:
        first: successes of the first method.
        second: those of the second, in the same order.
        confidence: of the interval, in (0, 1).

    Raises:
        JaxmarkError: if the numbers of pairs differ, or are 0.
    """
    if len(first) != len(second) or not len(first):
        raise JaxmarkError(f"A paired comparison needs pairs, got {len(first)} and {len(second)} successes.")
    one, other = np.asarray(first, bool), np.asarray(second, bool)
    a, b, c, d = (int(np.sum(cell)) for cell in (one & other, one & ~other, ~one & other, ~one & ~other))
    p = min(2 * float(bdtr(min(b, c), b + c, 0.5)), 1.0) if b + c else 1.0
    count, z = len(one), float(ndtri((1 + confidence) / 2))
    rate1, rate2, difference = (a + b) / count, (a + c) / count, (b - c) / count
    (low1, high1), (low2, high2) = _wilson(rate1, count, z), _wilson(rate2, count, z)
    products, excess = (a + b) * (c + d) * (a + c) * (b + d), a * d - b * c
    # The correlation is corrected for continuity where it is positive.
    phi = (max(excess - count / 2, 0) if excess > 0 else excess) / math.sqrt(products) if products else 0.0

    def joined(x: float, y: float) -> float:
        return math.sqrt(max(x * x - 2 * phi * x * y + y * y, 0.0))

    low = difference - joined(rate1 - low1, high2 - rate2)
    return Paired(a, b, c, d, p, difference, low, difference + joined(high1 - rate1, rate2 - low2))


def _wilson(rate: float, count: int, z: float) -> tuple[float, float]:
    """Compute Wilson's score interval of a rate, 1927."""
    middle, reach = rate + z * z / (2 * count), z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    return (middle - reach) / (1 + z * z / count), (middle + reach) / (1 + z * z / count)
