"""Prediction of the information in the values of a blind mark after an attack, and whether a payload can be read."""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64
from numpy.typing import ArrayLike

from jaxmark.watermark.blind.scheme import Look
from jaxmark.watermark.blind.search import reliability

_ORDERS, _PLACES = 24, 192  # orders of a wrapped normal's series, and number of angles at which it is evaluated
_SHARPEST, _TINY = 0.995, 1e-12  # mean cosine of the narrowest distribution, and lower limit on densities


def mean_cosine(spread: float, step: float, alpha: float) -> float:
    """Compute the mean cosine ρ of phases that were moved by the fraction `alpha` to a lattice, and then attacked.

    The error of a phase is uniform over the rest of the way, plus a Gaussian: ρ = sinc(1 - α) exp(-2 (πσ/step)²).
    """
    return float(np.sinc(1 - min(alpha, 1.0)) * reliability(spread, step))


class Margin(NamedTuple):
    """The surplus of information in some values over the need of a payload, in nats; negative if it is too little."""

    surplus: float  # mean of the surplus
    deviation: float  # standard deviation of the surplus

    @property
    def sure(self) -> float:
        """The surplus in standard deviations, which determines the probability that a message is read."""
        return self.surplus / self.deviation


def margin(count: int, cosine: float, bits: float) -> Margin:
    """Compute by how much the information in values exceeds the need of a payload.

    Each value carries a sign, and the error of its phase has a wrapped normal distribution with this mean cosine. A
    message of k bits is read from n values if about nC - k ≥ √(nV) Q⁻¹(error), where C and V are mean and variance of a
    value's information density (Polyanskiy, Poor, Verdú, "Channel coding rate in the finite blocklength regime", IEEE
    Trans. Inf. Theory 56, 2010).

    Args:
        count: number of values.
        cosine: mean cosine of the phase errors, in [0, 1].
        bits: size of message and tag.
    """
    order = np.arange(1, _ORDERS)
    terms = 2 * min(cosine, _SHARPEST) ** order**2
    waves = np.cos(order * np.linspace(0, 2 * np.pi, _PLACES, endpoint=False)[:, None])
    right, wrong = np.maximum(1 + waves @ terms, _TINY), np.maximum(1 + waves @ (terms * (-1.0) ** order), _TINY)
    density, share = np.log(2 * right / (right + wrong)), right / right.sum()
    mean = float(share @ density)
    variance = float(share @ (density - mean) ** 2)
    # Adding 1 keeps the result finite if the variance is 0.
    return Margin(count * mean - bits * math.log(2), math.sqrt(count * variance + 1))


class Left(NamedTuple):
    """The anchors and values of a mark that are left in a view of an attacked mesh."""

    kept: int  # number of anchors that were there before
    shown: int  # number of all anchors
    spread: float  # root mean square change of the values of kept anchors, after the best small change

    def cosine(self, step: float, alpha: float) -> float:
        """Predict the mean cosine of all anchors, for a mark with the fraction `alpha` of the way to the lattice."""
        return self.kept / max(self.shown, 1) * mean_cosine(self.spread, step, alpha)


def compare(before: Look, after: Look) -> Iterator[Left]:
    """Compare a view of an attacked mesh with the view before the attack, for each turn."""
    known = _named(before.names[0], before.good, before.values)
    for names, mirrored in zip(after.names, after.mirrored, strict=True):
        rows_by_name = _named(names, after.good, np.arange(len(names)))
        rows = [int(rows_by_name[name]) for name in rows_by_name.keys() & known.keys() if not mirrored]
        slopes = np.asarray(after.changes, np.float64)[rows]
        freedom = len(rows) - slopes.shape[1]
        if freedom > 0:
            differences = np.array([float(after.values[row]) - known[tuple(names[row].tolist())] for row in rows])
            residual = differences + slopes @ np.linalg.lstsq(slopes, -differences, rcond=None)[0]
            yield Left(len(rows), int(after.good.sum()), math.sqrt(float(residual @ residual) / freedom))


def best_margin(ways: Iterable[Left], step: float, alpha: float, bits: float) -> Margin:
    """Compute the largest margin of all views, as a reader finds it."""
    return max((margin(way.shown, way.cosine(step, alpha), bits) for way in ways), default=margin(0, 0.0, bits))


def _named(
    names: Int64[np.ndarray, "anchors parts"], good: Bool[np.ndarray, " anchors"], values: ArrayLike
) -> dict[tuple[int, ...], float]:
    """Map names to values, for anchors that count and have a unique name."""
    distinct, first, count = np.unique(names[good], axis=0, return_index=True, return_counts=True)
    selected = np.asarray(values)[good][first]
    return {tuple(distinct[row].tolist()): float(selected[row]) for row in np.flatnonzero(count == 1)}
