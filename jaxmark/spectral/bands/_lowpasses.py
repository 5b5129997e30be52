"""Low-passes: heat kernels e^{-tλ}, and diffusion scales that smooth by 1, 2, 4 … steps.

Any smoothing changes the host by a slowly varying function of λ. A few exponentials with rates that double approximate
such functions well, far better than as many polynomials do.
"""

# `help` then shows the names of type aliases, such as ArrayLike, and not all that they stand for.
from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike
from scipy import special

from jaxmark.errors import JaxmarkError


def diffusion(scales: int, terms: int) -> Float64[np.ndarray, "scales terms"]:
    """Compute the Chebyshev coefficients of (1 - λ/2)^s for s = 1, 2, 4 … 2^(scales - 1), one row each.

    With λ - 1 = cos θ this is sin^2s(θ/2), a cosine series with binomial coefficients: 4^-s C(2s, s) for k = 0, and
    2(-1)^k 4^-s C(2s, s - k).

    Args:
        scales: number of scales.
        terms: number of terms, degree + 1, at which the series are truncated; beyond 4√s the rest is below 1e-6.
    """
    coefficients = np.zeros((scales, terms))
    for row in range(scales):
        s = 2**row
        for k in range(min(terms, s + 1)):
            logarithm = math.lgamma(2 * s + 1) - math.lgamma(s - k + 1) - math.lgamma(s + k + 1) - s * math.log(4)
            coefficients[row, k] = (-1) ** k * (2 if k else 1) * math.exp(logarithm)
    return coefficients


def heat(times: ArrayLike, degree: int | None = None) -> Float64[np.ndarray, "times terms"]:
    """Compute the Chebyshev coefficients of e^{-tλ}, one row per time t: e^{-t}I_0(t), and 2(-1)^k e^{-t}I_k(t).

    I_k are modified Bessel functions. All times together, `band_components(operator, heat(times), x)`, cost as many
    products as the longest. `spectral.heat` has derivatives with respect to t.

    Args:
        times: t `[times]`, one or more, finite and not negative, in any order, which rows keep. With λ in [0, 2], a
            time of 1 or so is one step of smoothing.
        degree: degree at which the series are truncated; by default at rounding, which is at 42 for t = 10, 284 for
            10³, 2724 for 10⁵.
    """
    t = np.asarray(times, np.float64)
    if t.ndim != 1 or len(t) == 0:
        raise JaxmarkError(f"heat needs times [times], one or more, got {t.shape}.")
    k = np.arange(1 + (heat_degree(t) if degree is None else degree))
    return np.where(k == 0, 1, 2) * (-1.0) ** k * special.ive(k, t[:, None])


def heat_degree(times: ArrayLike, error: float = float(np.finfo(np.float64).eps)) -> int:
    """Return a degree at which the truncated series of e^{-tλ} has an error below `error`, for all of the times.

    All |c_k| but the first are the probabilities that two Poisson counts of mean t/2 differ by k, one way or the other,
    so that the rest of the series is at most P(|difference| > degree), which Bernstein's inequality bounds by
    2 exp(-n²/(2t + 2n/3)) with n = degree + 1. This grows as √(2t log(2/error)).
    """
    t = np.asarray(times, np.float64)
    if not (np.isfinite(t) & (t >= 0)).all():
        raise JaxmarkError(f"heat flows for times that are finite and not negative, got {times}.")
    digits = math.log(2 / error)
    return math.ceil(digits / 3 + math.sqrt(digits**2 / 9 + 2 * float(t.max()) * digits))
