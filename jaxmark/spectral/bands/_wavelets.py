"""Banks of graph wavelets: one low-pass and band-passes of growing frequency, as interpolated kernels.

The kernels are those of PyGSP 0.6 for a largest eigenvalue of 2, so that a bank here is its filter of the same name.
The low-pass is the first row.
"""

import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.bands._partitions import nodes, scaling

Kernel = Callable[[np.ndarray], np.ndarray]


def mexican_hat(bands: int, degree: int | None = None, *, span: float = 20.0) -> Float64[np.ndarray, "bands terms"]:
    """Compute the coefficients of Mexican hat wavelets sλ e^{-sλ}, one row per scale s, after those of a low-pass.

    The scales fall from `span` to 1/2 in equal ratios, so that wavelets peak from λ = 1/span to 2. The low-pass is
    1.2/e · exp(-(λ span/0.8)⁴). Reference: Hammond, Vandergheynst, Gribonval, "Wavelets on graphs via spectral graph
    theory", 2011; the kernels are PyGSP's.

    Args:
        bands: number of filters, at least 2: the low-pass, and bands - 1 wavelets.
        degree: degree of the polynomials; by default 30√span, where they are within 3e-5 of the kernels. At half of it
            they are off by 2e-3.
        span: largest λ over the smallest that a wavelet resolves, PyGSP's `lpfactor`; at least 1.
    """

    def low(x: np.ndarray) -> np.ndarray:
        return 1.2 / math.e * np.exp(-((x / 0.8) ** 4))

    return _scaled("mexican_hat", bands, degree, span, low, lambda x: x * np.exp(-x))


def abspline(bands: int, degree: int | None = None, *, span: float = 20.0) -> Float64[np.ndarray, "bands terms"]:
    """Compute the coefficients of spline wavelets g(sλ), one row per scale s, after those of a low-pass.

    g(x) is x² up to 1, 4/x² from 2 on, and between them the cubic -5 + 11x - 6x² + x³ that joins them smoothly. The
    low-pass is γ exp(-(λ span/1.2)⁴) with γ = max g. Scales, reference and arguments are those of `mexican_hat`. With
    the default degree the polynomials are within 4e-3 of the kernels, of 1.38 at the peak. At half of it they are off
    by 2e-2; the error falls slowly, for g has kinks in its second derivative.
    """

    def low(x: np.ndarray) -> np.ndarray:
        return (1 + 2 / math.sqrt(27)) * np.exp(-((x / 1.2) ** 4))

    def wavelet(x: np.ndarray) -> np.ndarray:
        cubic = -5 + 11 * x - 6 * x**2 + x**3
        return np.select([x <= 1, x < 2], [x**2, cubic], 4 / np.maximum(x, 2) ** 2)

    return _scaled("abspline", bands, degree, span, low, wavelet)


def meyer(bands: int, degree: int | None = None) -> Float64[np.ndarray, "bands terms"]:
    """Compute the coefficients of Meyer wavelets, one row per octave, after those of a low-pass: a tight frame.

    The squares of the kernels sum to 1: what falls as cos² in one band rises as sin² in the next. With v = 1, 2, 4 …
    from the lowest, band j rises from 2/3 to 4/3 and falls from 4/3 to 8/3 of x = 2^(bands - 1 - j) λ/1.5. Reference:
    Leonardi, Van De Ville, "Wavelet frames on graphs defined by fMRI functional connectivity", 2011.

    Args:
        bands: number of filters, at least 2: the low-pass, and bands - 1 wavelets.
        degree: degree of the polynomials; by default 16 · 2^(bands/2), where they are within 2e-3 of the kernels, and
            the squares within 4e-3 of 1. At half of it both are off by a tenth.
    """
    scales = 2 / 3 * 2.0 ** np.arange(bands - 2, -1, -1)[:, None]

    def kernels(values: np.ndarray) -> np.ndarray:
        x = np.vstack([scales[0] * values, scales * values])
        rise, fall = np.sin(np.pi / 2 * _step(1.5 * x - 1)), np.cos(np.pi / 2 * _step(0.75 * x - 1))
        rise[0], fall[0] = 1, np.cos(np.pi / 2 * _step(1.5 * x[0] - 1))
        return rise * fall

    return _interpolate("meyer", bands, kernels, math.ceil(16 * 2 ** (bands / 2)) if degree is None else degree)


def itersine(bands: int, degree: int | None = None) -> Float64[np.ndarray, "bands terms"]:
    """Compute the coefficients of itersine filters, which are equally wide and half overlapping: a tight frame.

    Filter j is sin(π/2 cos²(πx)) of x = (bands - 1)λ/4 - j/2 where |x| ≤ 1/2, and 0 elsewhere, so that the squares sum
    to 1. The iterated sine is a window of time-frequency analysis; as graph filters they are Perraudin's, in PyGSP.

    Args:
        bands: number of filters, at least 2.
        degree: degree of the polynomials; by default 16 · bands, where they are within 3e-3 of the kernels, and the
            squares within 1e-3 of 1. The error falls as the square of the degree, for the kernels have kinks in their
            second derivative.
    """

    def kernels(values: np.ndarray) -> np.ndarray:
        x = (bands - 1) / 4 * values - np.arange(bands)[:, None] / 2
        return np.where(np.abs(x) <= 0.5, np.sin(np.pi / 2 * np.cos(np.pi * x) ** 2), 0)

    return _interpolate("itersine", bands, kernels, 16 * bands if degree is None else degree)


def _step(x: np.ndarray) -> np.ndarray:
    """Evaluate Meyer's polynomial x⁴(35 - 84x + 70x² - 20x³) from 0 to 1; it is constant before and after."""
    x = x.clip(0, 1)
    return x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)


def _scaled(
    name: str, bands: int, degree: int | None, span: float, low: Kernel, wavelet: Kernel
) -> Float64[np.ndarray, "bands terms"]:
    """Compute a low-pass, and wavelets at scales from `span` to 1/2."""
    if not span >= 1:
        raise JaxmarkError(f"{name}(span=...) must be at least 1, got {span}.")

    def kernels(values: np.ndarray) -> np.ndarray:
        scales = np.geomspace(span, 0.5, bands - 1)[:, None]
        return np.vstack([low(span * values), wavelet(scales * values)])

    return _interpolate(name, bands, kernels, math.ceil(30 * math.sqrt(span)) if degree is None else degree)


def _interpolate(name: str, bands: int, kernels: Kernel, degree: int) -> Float64[np.ndarray, "bands terms"]:
    if bands < 2:
        raise JaxmarkError(f"{name} needs at least two bands, got {bands}.")
    return kernels(nodes(degree + 1)) @ scaling(degree + 1)
