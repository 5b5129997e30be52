"""Two methods on the same suspects: McNemar's test, and the interval of the difference of their rates."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from scipy.special import bdtr, ndtri

from jaxmark.errors import JaxmarkError


class Paired(NamedTuple):
    """How two methods differ on the same meshes, seeds and attacks."""

    both: int
    first: int  # where only the first succeeds
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
    pairs = [(bool(a), bool(b)) for a, b in zip(first, second, strict=True)]
    both, one, other, neither = (
        pairs.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False))
    )
    discordant, count = one + other, len(pairs)
    p = min(2 * float(bdtr(min(one, other), discordant, 0.5)), 1.0) if discordant else 1.0
    low, high = _newcombe(both, one, other, neither, confidence)
    return Paired(both, one, other, neither, p, (one - other) / count, low, high)


def _newcombe(both: int, one: int, other: int, neither: int, confidence: float) -> tuple[float, float]:
    count, z = both + one + other + neither, float(ndtri((1 + confidence) / 2))
    rates = (both + one) / count, (both + other) / count
    (low1, high1), (low2, high2) = (_wilson(rate, count, z) for rate in rates)
    products = (both + one) * (other + neither) * (both + other) * (one + neither)
    excess = both * neither - one * other
    # The correlation is corrected for continuity where it is positive.
    phi = 0.0 if not products else (max(excess - count / 2, 0) if excess > 0 else excess) / math.sqrt(products)
    difference = rates[0] - rates[1]

    def reach(a: float, b: float) -> float:
        return math.sqrt(max(a * a - 2 * phi * a * b + b * b, 0.0))

    return (
        difference - reach(rates[0] - low1, high2 - rates[1]),
        difference + reach(high1 - rates[0], rates[1] - low2),
    )


def _wilson(rate: float, count: int, z: float) -> tuple[float, float]:
    """Wilson's score interval of a rate, 1927."""
    middle, reach = rate + z * z / (2 * count), z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count * count))
    return (middle - reach) / (1 + z * z / count), (middle + reach) / (1 + z * z / count)
