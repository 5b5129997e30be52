"""Bernstein polynomials: non-negative bands without any oscillation, but wide ones (Sohn et al., section 3.3)."""

import numpy as np
from jaxtyping import Float64
from scipy import special

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.bands._scaling import nodes, scaling


def bernstein(bands: int) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of C(n, j) (λ/2)^j (1 - λ/2)^(n - j), n = bands - 1, one band a row.

    The bands are a partition of unity within [0, 1]. Band j has its peak at λ = 2j/n and is about √(λ(2 - λ)/n) wide:
    bands half as wide take four times the degree, where other families take twice the degree.

    Args:
        bands: number of bands, at least 1.

    Returns:
        `[bands, bands]`, by increasing frequency.

    Raises:
        JaxmarkError: if `bands` is below 1.
    """
    if bands < 1:
        raise JaxmarkError(f"bernstein needs at least one band, got {bands}.")
    # The values are nowhere above 1, so that interpolation is exact up to rounding.
    j, at, n = np.arange(bands)[:, None], nodes(bands) / 2, bands - 1
    logarithm = -special.betaln(n - j + 1, j + 1) - np.log(n + 1) + special.xlogy(j, at) + special.xlog1py(n - j, -at)
    return np.exp(logarithm) @ scaling(bands)
