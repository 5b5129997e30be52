"""Bernstein polynomials: non-negative bands without any oscillation, and the widest (Sohn et al., section 3.3)."""

import numpy as np
from jaxtyping import Float64
from scipy import stats

from jaxmark.bands.scaling import nodes, scaling
from jaxmark.errors import JaxmarkError


def bernstein(bands: int) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of C(n, j) (λ/2)^j (1 - λ/2)^(n - j), n = bands - 1, one band a row.

    A partition of unity, each band within [0, 1], with its peak at λ = 2j/n. It is about √(λ(2 - λ)/n) wide: bands
    twice as narrow take four times the degree, where other families take twice.

    Args:
        bands: how many, at least 1.

    Returns:
        `[bands, bands]`, by increasing frequency.

    Raises:
        JaxmarkError: if `bands` is below 1.
    """
    if bands < 1:
        raise JaxmarkError(f"bernstein needs at least one band, got {bands}.")
    # Nowhere above 1, so that interpolating is exact to rounding.
    return stats.binom.pmf(np.arange(bands)[:, None], bands - 1, nodes(bands) / 2) @ scaling(bands)
