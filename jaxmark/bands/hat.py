"""Hat functions: bands with local support, approximated best (the further work that Sohn et al. name, Fig. 15-16)."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float64

from jaxmark.bands.minimax import minimax
from jaxmark.errors import JaxmarkError


def hat(knots: Float[np.ndarray, " bands"], degree: int) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of polynomials close to piecewise linear hats, one knot a row: a partition of unity.

    Hat j is 1 at its knot and 0 from the neighbouring knots on; the first and the last stay 1 to the ends of [0, 2].
    Best approximations of the hats would not sum to 1, so what is approximated best is their sums from j on, ramps
    from 0 to 1: with p_j for them, f_j = p_j - p_{j+1}, which no more than the two deviations is off.
    Deviations fall as 1/degree: about 0.28/(degree · width) for hats of a width (in λ, from knot to knot) in the
    middle of [0, 2]. They are spread over all of [0, 2], as equal ripples are.

    Args:
        knots: λ `[bands]`, two or more, ascending in [0, 2].
        degree: of the polynomials.

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
