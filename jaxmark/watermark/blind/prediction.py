"""What an attack leaves of a blind mark, by what it does to the mesh before it is marked."""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64
from numpy.typing import ArrayLike

from jaxmark.watermark.blind.scheme import Look


class Left(NamedTuple):
    """What one way of looking at a suspect shows of the values that were there before."""

    kept: int  # anchors that were there before
    shown: int  # anchors in all
    spread: float  # root mean square change of the values of those that were there, after the best small change

    def energy(self, step: float, alpha: float) -> float:
        """Predicted nρ² of a mark that went the part `alpha` of the way to a lattice of this step.

        Of the n anchors that are shown, those that were there before have the mean cosine
        sinc(1 - α) exp(-2 (πσ/step)²), where σ is their spread; the others have none.
        """
        cosine = float(np.sinc(1 - min(alpha, 1.0))) * math.exp(-2 * (math.pi * self.spread / step) ** 2)
        return (self.kept * cosine) ** 2 / max(self.shown, 1)


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


def best_energy(ways: Iterable[Left], step: float, alpha: float) -> float:
    """Predicted nρ² with the best of all ways of looking, as the reader finds it; 0 if there is none."""
    return max((way.energy(step, alpha) for way in ways), default=0.0)


def _named(
    names: Int64[np.ndarray, "anchors parts"], good: Bool[np.ndarray, " anchors"], values: ArrayLike
) -> dict[tuple[int, ...], float]:
    """The values of what counts and has a name that nothing else has."""
    some, first, count = np.unique(names[good], axis=0, return_index=True, return_counts=True)
    there = np.asarray(values)[good][first]
    return {tuple(some[one].tolist()): float(there[one]) for one in np.flatnonzero(count == 1)}
