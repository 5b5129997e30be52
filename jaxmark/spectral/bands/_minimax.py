"""Best uniform approximations by polynomials: Remez's exchange algorithm, and hat functions, which are made of them."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from numbers import Integral
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int64
from numpy.polynomial import chebyshev

from jaxmark.errors import JaxmarkError

_POINTS_PER_RIPPLE = 32  # grid points, which miss at most 0.1 % of a ripple's height
_MAX_EXCHANGES = 200


class Interpolation(NamedTuple):
    """A polynomial that interpolates a function on [0, 2]."""

    coefficients: Float64[np.ndarray, " terms"]  # its Chebyshev series, for `jaxmark.spectral.chebyshev.filter`
    error: float  # largest error on a grid that is 32 times as fine as the points of interpolation


def fit(function: Callable[[np.ndarray], np.ndarray], degree: int) -> Interpolation:
    """Interpolate a function g(λ) at the zeros of T_{degree + 1}(λ - 1), so that `filter` computes g(Δ)x.

    The error is at most 2 + 2/π log(degree + 1) times that of the best polynomial, which `minimax` finds, and falls
    geometrically with the degree if the function is analytic on [0, 2] (Trefethen, "Approximation Theory and
    Approximation Practice", 2013, ch. 8 and 15).

    Args:
        function: maps λ `[points]` in [0, 2] to values `[points]`.
        degree: degree of the polynomial, at least 0.

    Raises:
        JaxmarkError: if the degree is no whole number of at least 0, or the function is not real and finite there, or
            returns another shape.
    """
    if not isinstance(degree, Integral) or degree < 0:
        raise JaxmarkError(f"fit needs a degree that is a whole number of at least 0, got {degree!r}.")
    points = 1 + np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    grid = 1 - np.cos(np.linspace(0, np.pi, _POINTS_PER_RIPPLE * (degree + 1) + 1))
    found = [function(where) for where in (points, grid)]
    if any(np.iscomplexobj(values) for values in found):
        raise JaxmarkError("fit needs a function with real values; fit real and imaginary part one by one.")
    values, fine = (np.asarray(values, np.float64) for values in found)
    if values.shape != points.shape or not (np.isfinite(values).all() and np.isfinite(fine).all()):
        raise JaxmarkError("fit needs a function with one finite value for each λ in [0, 2].")
    coefficients = 2 / (degree + 1) * chebyshev.chebvander(points - 1, degree).T @ values
    coefficients[0] /= 2
    return Interpolation(coefficients, float(np.abs(chebyshev.chebval(grid - 1, coefficients) - fine).max()))


class Minimax(NamedTuple):
    """A best approximation p of a function f on [0, 2]; by Chebyshev's theorem, the alternation of f - p proves it."""

    coefficients: Float64[np.ndarray, " terms"]  # Chebyshev series of p
    deviation: float  # max |f - p|
    reference: Float64[np.ndarray, " alternations"]  # degree + 2 points of [0, 2] where f - p is ±deviation alternately


def minimax(
    function: Callable[[np.ndarray], np.ndarray], degree: int, *, kinks: Sequence[float] | np.ndarray = ()
) -> Minimax:
    """Find the polynomial of a given degree that deviates least from a continuous function on [0, 2].

    By Remez's second algorithm: on degree + 2 points, the best approximation solves a linear system. The points move to
    where its error is largest, until the error is nowhere larger than on them. By de la Vallée Poussin's theorem, the
    error on the points bounds the deviation of any polynomial from below. Reference: Trefethen, "Approximation Theory
    and Approximation Practice", 2013, ch. 10.

    Args:
        function: maps λ `[points]` to values `[points]`.
        degree: degree of the polynomial, at least 0.
        kinks: points where the function is not smooth; the error may be extremal there, so they belong to the grid.

    Returns:
        The approximation, which is best on a grid of the kinks and 32 points per ripple.

    Raises:
        JaxmarkError: if the exchange does not converge.
    """
    size = degree + 2
    grid = np.union1d(1 - np.cos(np.linspace(0, np.pi, _POINTS_PER_RIPPLE * size + 1)), kinks)
    values, polynomials = function(grid), chebyshev.chebvander(grid - 1, degree)
    reference = np.searchsorted(grid, 1 - np.cos(np.linspace(0, np.pi, size))).clip(max=len(grid) - 1)
    smallest = 1e-13 * max(1.0, float(np.abs(values).max()))
    for _ in range(_MAX_EXCHANGES):
        system = np.column_stack([polynomials[reference], (-1.0) ** np.arange(size)])
        *coefficients, level = np.linalg.solve(system, values[reference])
        error = values - polynomials @ coefficients
        deviation = float(np.abs(error).max())
        if deviation <= abs(level) * (1 + 1e-9) + smallest:
            return Minimax(np.array(coefficients), deviation, grid[reference])
        reference = _exchange(error, size)
    raise JaxmarkError(f"minimax did not settle at degree {degree} in {_MAX_EXCHANGES} rounds; take another degree.")


def _exchange(error: Float64[np.ndarray, " points"], size: int) -> Int64[np.ndarray, " size"]:
    """Find the points where the error is largest between its changes of sign, and drop the smallest beyond `size`."""
    starts = np.flatnonzero(np.diff(np.sign(error), prepend=0))
    places = [
        start + int(np.argmax(np.abs(run))) for start, run in zip(starts, np.split(error, starts[1:]), strict=True)
    ]
    heights = list(np.abs(error[places]))
    while len(places) > size:
        least = int(np.argmin(heights))
        if least in (0, len(places) - 1) or len(places) == size + 1:
            drop = [0 if heights[0] < heights[-1] else len(places) - 1]
        else:  # drop a neighbour, too, so that the signs still alternate
            drop = [least, least - 1 if heights[least - 1] < heights[least + 1] else least + 1]
        for place in sorted(drop, reverse=True):
            del places[place], heights[place]
    return np.array(places)


def hat(knots: Float[np.ndarray, " bands"], degree: int) -> Float64[np.ndarray, "bands terms"]:
    """Compute polynomials close to piecewise linear hats, one row per knot: a partition of unity.

    Hat j is 1 at its knot and 0 from the neighbouring knots on; the first and the last stay 1 to the ends of [0, 2].
    Such local bands are further work of Sohn et al. (Fig. 15-16). Best approximations of the hats themselves would not
    sum to 1. Instead the sums of hats from j on, ramps from 0 to 1, have best approximations p_j, and band j is
    f_j = p_j - p_{j+1}, which deviates by no more than both together. Deviations fall as 1/degree: about
    0.28/(degree · width) for hats of a width (in λ, from knot to knot) in the middle of [0, 2]. They are ripples of
    equal height all over [0, 2].

    Args:
        knots: λ `[bands]`, two or more, ascending in [0, 2].
        degree: degree of the polynomials.
    """
    if len(knots) < 2 or knots[0] < 0 or knots[-1] > 2 or not (np.diff(knots) > 0).all():
        raise JaxmarkError(f"hat needs two knots or more that ascend within [0, 2], got {knots}.")
    ramps = np.zeros((len(knots) + 1, degree + 1))
    ramps[0, 0] = 1
    for j, ends in enumerate(pairwise(knots), 1):
        ramps[j] = minimax(lambda x, ends=ends: np.interp(x, ends, (0, 1)), degree, kinks=ends).coefficients
    return -np.diff(ramps, axis=0)
