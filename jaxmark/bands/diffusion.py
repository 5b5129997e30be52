"""Diffusion scales: the host smoothed by 1, 2, 4 … steps.

Every smoothing leaves the host changed by a slowly varying function of λ, and those are well approximated by a few
exponentials with rates that double: far better than by as many polynomials.
"""

import math

import numpy as np
from jaxtyping import Float64


def diffusion(scales: int, terms: int) -> Float64[np.ndarray, "scales terms"]:
    """Chebyshev coefficients of (1 - λ/2)^s for s = 1, 2, 4 … 2^(scales - 1), one a row.

    With λ - 1 = cos θ this is sin^2s(θ/2), a cosine series with binomial coefficients: 4^-s C(2s, s) for k = 0, and
    2(-1)^k 4^-s C(2s, s - k).

    Args:
        scales: how many.
        terms: degree + 1 at which the series are cut off; beyond 4√s what is left is below 1e-6.
    """
    coefficients = np.zeros((scales, terms))
    for row in range(scales):
        s = 2**row
        for k in range(min(terms, s + 1)):
            logarithm = math.lgamma(2 * s + 1) - math.lgamma(s - k + 1) - math.lgamma(s + k + 1) - s * math.log(4)
            coefficients[row, k] = (-1) ** k * (2 if k else 1) * math.exp(logarithm)
    return coefficients
