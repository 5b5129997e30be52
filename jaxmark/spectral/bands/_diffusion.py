"""Diffusion scales: low-passes that smooth the host by 1, 2, 4 … steps.

Any smoothing changes the host by a slowly varying function of λ. A few exponentials with rates that double approximate
such functions well, far better than as many polynomials do.
"""

import math

import numpy as np
from jaxtyping import Float64


def diffusion(scales: int, terms: int) -> Float64[np.ndarray, "scales terms"]:
    """Chebyshev coefficients of (1 - λ/2)^s for s = 1, 2, 4 … 2^(scales - 1), one a row.

    With λ - 1 = cos θ this is sin^2s(θ/2), a cosine series with binomial coefficients: 4^-s C(2s, s) for k = 0, and
    2(-1)^k 4^-s C(2s, s - k).

    Args:
        scales: number of scales.
        terms: number of terms, degree + 1, at which the series are truncated; beyond 4√s the rest is below 1e-6.

    Returns:
        `[scales, terms]`, from the least smoothing on.
    """
    coefficients = np.zeros((scales, terms))
    for row in range(scales):
        s = 2**row
        for k in range(min(terms, s + 1)):
            logarithm = math.lgamma(2 * s + 1) - math.lgamma(s - k + 1) - math.lgamma(s + k + 1) - s * math.log(4)
            coefficients[row, k] = (-1) ** k * (2 if k else 1) * math.exp(logarithm)
    return coefficients
