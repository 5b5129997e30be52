"""What is left of a blind mark after what moves its values, and whether a payload can be read from that."""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64
from numpy.typing import ArrayLike

from jaxmark.watermark.blind.scheme import Look

_ORDERS, _PLACES = 24, 192  # of a wrapped normal's series, and places around the circle where it is taken
_SHARPEST, _TINY = 0.995, 1e-12  # mean cosine of the narrowest, and what its values are at least


def mean_cosine(spread: float, step: float, alpha: float) -> float:
    """Mean cosine ρ of what values are off that went the part `alpha` of the way to a lattice, and then moved.

    What is off is uniform over the rest of the way, and then Gaussian: ρ = sinc(1 - α) exp(-2 (πσ/step)²).
    """
    return float(np.sinc(1 - min(alpha, 1.0))) * math.exp(-2 * (math.pi * spread / step) ** 2)


class Margin(NamedTuple):
    """By how much the information in some values exceeds what a payload needs, in nats; negative if it does not."""

    surplus: float  # on average
    deviation: float  # standard deviation

    @property
    def sure(self) -> float:
        """The surplus in standard deviations, by which it is how likely that a message reads."""
        return self.surplus / self.deviation


def margin(count: int, cosine: float, bits: float) -> Margin:
    """By how much the information in so many values exceeds what a payload needs.

    Each value carries a sign, and its phase is off by a wrapped normal with this mean cosine. That a message of k bits
    reads takes about nC - k ≥ √(nV) Q⁻¹(error), C and V being mean and variance of a value's information density
    (Polyanskiy, Poor, Verdú, "Channel coding rate in the finite blocklength regime", IEEE Trans. Inf. Theory 56, 2010).

    Args:
        count: number of values.
        cosine: mean cosine of what their phases are off, in [0, 1].
        bits: of message and tag.
    """
    order = np.arange(1, _ORDERS)
    terms = 2 * min(cosine, _SHARPEST) ** order**2
    waves = np.cos(order * np.linspace(0, 2 * np.pi, _PLACES, endpoint=False)[:, None])
    right, wrong = np.maximum(1 + waves @ terms, _TINY), np.maximum(1 + waves @ (terms * (-1.0) ** order), _TINY)
    density, share = np.log(2 * right / (right + wrong)), right / right.sum()
    mean = float(share @ density)
    variance = float(share @ (density - mean) ** 2)
    # One more keeps the result finite where nothing is left to chance.
    return Margin(count * mean - bits * math.log(2), math.sqrt(count * variance + 1))


class Left(NamedTuple):
    """What one way of looking at a suspect shows of the values that were there before."""

    kept: int  # anchors that were there before
    shown: int  # anchors in all
    spread: float  # root mean square change of the values of those that were there, after the best small change

    def cosine(self, step: float, alpha: float) -> float:
        """Predicted mean cosine of all that are shown, of a mark that went the part `alpha` of the way to a lattice."""
        return self.kept / max(self.shown, 1) * mean_cosine(self.spread, step, alpha)


def compare(before: Look, after: Look) -> Iterator[Left]:
    """Compare what an attacked mesh shows with what it showed before, for each way in which it may lie."""
    known = _named(before.names[0], before.good, before.values)
    for names, mirrored in zip(after.names, after.mirrored, strict=True):
        there = _named(names, after.good, np.arange(len(names)))
        rows = [int(there[name]) for name in there.keys() & known.keys() if not mirrored]
        slopes = np.asarray(after.changes, np.float64)[rows]
        freedom = len(rows) - slopes.shape[1]
        if freedom > 0:
            moved = np.array([float(after.values[one]) - known[tuple(names[one].tolist())] for one in rows])
            off = moved + slopes @ np.linalg.lstsq(slopes, -moved, rcond=None)[0]
            yield Left(len(rows), int(after.good.sum()), math.sqrt(float(off @ off) / freedom))


def best_margin(ways: Iterable[Left], step: float, alpha: float, bits: float) -> Margin:
    """The margin with the best of all ways of looking, as the reader finds it."""
    return max((margin(way.shown, way.cosine(step, alpha), bits) for way in ways), default=margin(0, 0.0, bits))


def _named(
    names: Int64[np.ndarray, "anchors parts"], good: Bool[np.ndarray, " anchors"], values: ArrayLike
) -> dict[tuple[int, ...], float]:
    """The values of what counts and has a name that nothing else has."""
    some, first, count = np.unique(names[good], axis=0, return_index=True, return_counts=True)
    there = np.asarray(values)[good][first]
    return {tuple(some[one].tolist()): float(there[one]) for one in np.flatnonzero(count == 1)}
