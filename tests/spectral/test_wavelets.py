"""Wavelet banks, against the formulas of the papers, written out once more for one value and one band."""

import math

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from scipy import optimize

from jaxmark.errors import JaxmarkError
from jaxmark.spectral import bands

pytestmark = pytest.mark.core

GRID = 1 - np.cos(np.linspace(0, np.pi, 1501))
CUBIC = np.linalg.solve([[1, 1, 1, 1], [1, 2, 4, 8], [0, 1, 2, 3], [0, 1, 4, 12]], [1, 1, 2, -1])[::-1]
PEAK = -optimize.minimize_scalar(lambda x: -np.polyval(CUBIC, x), bounds=(1, 2), method="bounded").fun


def mexican_hat(count: int, span: float, j: int, value: float) -> float:
    """PyGSP's formulas: scales between 2/lmin and 1/lmax, logarithmically, with lmin = lmax/span."""
    smallest = 2 / span
    if j == 0:
        return 1.2 * math.exp(-1) * math.exp(-((value / 0.4 / smallest) ** 4))
    scale = log_scale(count, span, j)
    return scale * value * math.exp(-scale * value)


def abspline(count: int, span: float, j: int, value: float) -> float:
    """Hammond et al. with α = β = 2, x_1 = 1, x_2 = 2, the cubic by its four conditions."""
    if j == 0:
        return PEAK * math.exp(-((value / (0.6 * 2 / span)) ** 4))
    x = log_scale(count, span, j) * value
    return x**2 if x < 1 else float(np.polyval(CUBIC, x)) if x < 2 else 4 / x**2


def log_scale(count: int, span: float, j: int) -> float:
    """The scale of wavelet j, 2/lmin for the first and 1/lmax for the last."""
    first, last = math.log(2 / (2 / span)), math.log(1 / 2)
    return math.exp(first + (last - first) * (j - 1) / max(count - 2, 1))


def meyer(count: int, span: float, j: int, value: float) -> float:
    """Leonardi and Van De Ville's kernels, whose largest scale is 4/(3 lmax)."""

    def v(x: float) -> float:
        return x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)

    x = 4 / (3 * 2) * 2 ** (count - 1 - max(j, 1)) * value
    if x < 2 / 3:
        return float(j == 0)
    if x < 4 / 3:
        angle = math.pi / 2 * v(1.5 * x - 1)
        return math.cos(angle) if j == 0 else math.sin(angle)
    return math.cos(math.pi / 2 * v(0.75 * x - 1)) if j > 0 and x < 8 / 3 else 0.0


def itersine(count: int, span: float, j: int, value: float) -> float:
    """Of overlap two: bands of width w = 4/(count - 1), shifted by half of it."""
    width = 4 / (count - 1)
    x = value / width - j / 2
    return math.sin(math.pi / 2 * math.cos(math.pi * x) ** 2) if abs(x) < 0.5 else 0.0


KERNELS = {"mexican_hat": mexican_hat, "abspline": abspline, "meyer": meyer, "itersine": itersine}
SPANNED = ["mexican_hat", "abspline"]
# How far the polynomials of the default degree may be off, as the docstrings say.
CLOSE = {"mexican_hat": 3e-5, "abspline": 4e-3, "meyer": 2e-3, "itersine": 3e-3}


@pytest.mark.parametrize("count", [2, 3, 8])
@pytest.mark.parametrize(("name", "span"), [*((name, 20.0) for name in KERNELS), *((name, 100.0) for name in SPANNED)])
def test_banks_are_their_kernels(name, count, span):
    """As closely as documented by default, and better by a higher degree."""
    options = {"span": span} if name in SPANNED else {}
    kernels = np.array([[KERNELS[name](count, span, j, value) for value in GRID] for j in range(count)])

    def miss(family: np.ndarray) -> float:
        return float(np.abs(chebyshev.chebval(GRID - 1, family.T) - kernels).max())

    family = getattr(bands, name)(count, **options)
    assert len(family) == count
    assert miss(family) < CLOSE[name]
    finer = getattr(bands, name)(count, 3 * family.shape[1], **options)
    assert finer.shape == (count, 3 * family.shape[1] + 1)
    assert miss(finer) < max(1e-12, CLOSE[name] / 6)


@pytest.mark.parametrize("name", ["meyer", "itersine"])
@pytest.mark.parametrize("count", [2, 5, 10])
def test_tight_frames_keep_energy(name, count):
    """The squares sum to 1 for the kernels, so that they do nearly for the polynomials, at any number of bands."""
    family = getattr(bands, name)(count)
    power = (chebyshev.chebval(GRID - 1, family.T) ** 2).sum(axis=0)
    np.testing.assert_allclose(power, 1, atol=4e-3)


@pytest.mark.parametrize("name", KERNELS)
def test_frequencies_rise(name):
    """Each band's centre of gravity is above the one before."""
    power = chebyshev.chebval(GRID - 1, getattr(bands, name)(6).T) ** 2
    assert (np.diff(power @ GRID / power.sum(axis=1)) > 0).all()


@pytest.mark.parametrize("name", [*SPANNED, "meyer"])
def test_wavelets_keep_no_constants(name):
    """g(0) = 0 for all but the low-pass, as far as the polynomials go."""
    at_zero = chebyshev.chebval(-1.0, getattr(bands, name)(5).T)
    np.testing.assert_allclose(at_zero[1:], 0, atol=CLOSE[name])
    assert at_zero[0] > 0.4


def test_refusals():
    for call in (
        lambda: bands.mexican_hat(1),
        lambda: bands.abspline(4, span=0.5),
        lambda: bands.meyer(1),
        lambda: bands.itersine(0),
    ):
        with pytest.raises(JaxmarkError):
            call()
