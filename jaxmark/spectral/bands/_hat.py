"""Hat functions: best approximations of bands with local support (named as further work by Sohn et al., Fig. 15-16)."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float64

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.bands._minimax import minimax


def hat(knots: Float[np.ndarray, " bands"], degree: int) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of polynomials close to piecewise linear hats, one knot a row: a partition of unity.

    Hat j is 1 at its knot and 0 from the neighbouring knots on; the first and the last stay 1 to the ends of [0, 2].
    Best approximations of the hats themselves would not sum to 1. Instead the sums of hats from j on, ramps from 0 to
    1, have best approximations p_j, and band j is f_j = p_j - p_{j+1}, which deviates by no more than both together.
    Deviations fall as 1/degree: about 0.28/(degree · width) for hats of a width (in λ, from knot to knot) in the
    middle of [0, 2]. They are ripples of equal height all over [0, 2].

    Args:
        knots: λ `[bands]`, two or more, ascending in [0, 2].
        degree: degree of the polynomials.

    Returns:
        `[bands, degree + 1]`, by increasing frequency.

    Raises:
        JaxmarkError: if the knots do not ascend within [0, 2].
    """
    if len(knots) < 2 or knots[0] < 0 or knots[-1] > 2 or not (np.diff(knots) > 0).all():
        raise JaxmarkError(f"hat needs two knots or more that ascend within [0, 2], got {knots}.")
    ramps = np.zeros((len(knots) + 1, degree + 1))
    ramps[0, 0] = 1
    for j, ends in enumerate(pairwise(knots), 1):
        ramps[j] = minimax(lambda x, ends=ends: np.interp(x, ends, (0, 1)), degree, kinks=ends).coefficients
    return -np.diff(ramps, axis=0)
