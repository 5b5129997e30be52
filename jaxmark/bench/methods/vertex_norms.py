"""Cho, Prost, Jung, "An oblivious watermarking for 3-D polygonal meshes using distribution of vertex norms", 2007.

IEEE Transactions on Signal Processing 55 (1), 142-155. The distances of vertices to their centre are sorted into bins
of equal width, one per bit. In each bin, distances are mapped to the unit interval and raised to a power. The power is
chosen so that their mean (method I) or their variance (method II) is above or below that of a uniform distribution, by
the strength. The reader compares mean or variance with that of the uniform distribution.

This implementation fills gaps of the publication as follows.

- Powers are found by bisection, instead of in steps of 0.001.
- The mark moves the centre. Fixed-point iteration finds the centre that the reader will compute.
- Vertices at the same position count as one.
- A key permutes and flips the bits.
- There is no detector. The score is the margin that three bits in four exceed; it does not depend on the key.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.bench.method import Bits, Method, Reading
from jaxmark.bench.methods.primitives import decode_margins, make_surface, scatter
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Points

ANCHOR = "bit error rates of SMI 2010 at both of its limits, within 0.1 in the mean (benchmarks/robustness/anchors.py)"
SOURCE = "Cho, Prost, Jung, IEEE Transactions on Signal Processing 55 (1), 2007"
_MAX_ROUNDS, _TOLERANCE = 30, 1e-12  # rounds of the centre's iteration; its last step over the largest distance
_BISECTIONS = 50  # bisections for a power
_POWERS = (1 / 64, 64.0)  # range of powers

Values = Float64[np.ndarray, " points"]
PerBin = Float64[np.ndarray, " bins"]


class Bins(NamedTuple):
    """Distances sorted into bins, and mapped to the unit interval in each bin."""

    place: Int64[np.ndarray, " points"]  # the bin of each point
    inside: Values  # 0 at the smallest distance of the bin, 1 at the largest
    low: PerBin
    high: PerBin

    def mean(self, values: Values) -> PerBin:
        """Compute the mean of values in each bin; it is 0 in an empty bin."""
        count = np.bincount(self.place, minlength=len(self.low))
        return np.bincount(self.place, values, len(self.low)) / np.maximum(count, 1)


class Statistic(NamedTuple):
    """The statistic of a bin that carries a bit: its mean or its variance."""

    name: str
    anchor: str
    uniform: float  # the value for the uniform distribution
    raised: Callable[[Values, Values], Values]  # raises values in the unit interval to powers
    of: Callable[[Bins, Values], PerBin]  # computes the statistic


def _raise_about_middle(inside: Values, power: Values) -> Values:
    """Raise the distance of values from the middle of the unit interval to a power (eq. 13)."""
    centred = 2 * inside - 1
    return (1 + np.sign(centred) * np.abs(centred) ** power) / 2


def _variance(bins: Bins, inside: Values) -> PerBin:
    return bins.mean((2 * inside - 1) ** 2)


# The mean of a uniform variable's power k is 1/(k + 1) (eq. 7), the variance of one about 0 is 1/(2k + 1) (eq. 14).
MEAN = Statistic("cho", ANCHOR, 1 / 2, np.power, Bins.mean)
VARIANCE = Statistic("cho-variance", "", 1 / 3, _raise_about_middle, _variance)


def _method(statistic: Statistic, bits: int) -> Method:
    def embed(mesh: Mesh, message: Bits, key: bytes, strength: float) -> Mesh:
        surface, written = make_surface(mesh), scatter(message, key, statistic.name)
        points = marked = np.asarray(surface.mesh.vertices)
        centre = points.mean(axis=0)
        for _ in range(_MAX_ROUNDS):
            marked = _mapped(points, centre, statistic, written, strength)
            before, centre = centre, marked.mean(axis=0)
            if np.linalg.norm(centre - before) <= _TOLERANCE * np.abs(points - centre).max():
                break
        return surface.moved(marked)

    def read(suspect: Mesh, key: bytes, original: Mesh | None = None) -> Reading:
        points = np.asarray(make_surface(suspect).mesh.vertices)
        bins = _bins(np.linalg.norm(points - points.mean(axis=0), axis=1), bits)
        margin = statistic.of(bins, bins.inside) - statistic.uniform
        return decode_margins(np.where(bins.high > bins.low, margin, 0), key, statistic.name)

    return Method(statistic.name, embed, read, True, bits, (1e-4, 0.3), SOURCE, statistic.anchor)


# Method I uses means, and method II variances. The strength of method I is the shift of a bin's mean, over the bin's
# width. The strength of method II is the shift of the variance, for a bin from -1 to 1.
cho, cho_variance = partial(_method, MEAN), partial(_method, VARIANCE)


def _bins(distance: Values, count: int) -> Bins:
    """Sort distances into bins (eq. 3-5); refuse points that all have the same distance to their centre."""
    least, most = distance.min(), distance.max()
    if not most > least:
        raise JaxmarkError(
            "All points have the same distance to their centre, so that the method cannot mark this mesh."
        )
    place = np.minimum(((distance - least) / (most - least) * count).astype(np.int64), count - 1)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, place, distance)
    np.maximum.at(high, place, distance)
    low[np.isinf(low)] = high[np.isinf(high)] = 0
    return Bins(place, (distance - low[place]) / np.where(high > low, high - low, 1)[place], low, high)


def _mapped(
    points: Points, centre: Float64[np.ndarray, " 3"], statistic: Statistic, written: Bits, strength: float
) -> Points:
    """Change the distances of points to a centre, in each bin by its power, so that the bins carry the bits."""
    arm = points - centre
    distance = np.linalg.norm(arm, axis=1)
    bins = _bins(distance, len(written))
    # A statistic decreases with the power. It is not changed if it is beyond its target already.
    now = statistic.of(bins, bins.inside)
    up, down = statistic.uniform + strength, statistic.uniform - strength
    target = np.where(written, np.maximum(now, up), np.minimum(now, down))
    low, high = np.log(np.full((2, len(written)), np.array(_POWERS)[:, None]))
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        above = statistic.of(bins, statistic.raised(bins.inside, np.exp(middle)[bins.place])) > target
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    power = np.where(target == now, 1.0, np.exp((low + high) / 2))
    inside = statistic.raised(bins.inside, power[bins.place])
    new_distance = bins.low[bins.place] + (bins.high - bins.low)[bins.place] * inside
    return centre + arm * (new_distance / np.where(distance > 0, distance, 1))[:, None]
