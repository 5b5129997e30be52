"""Scaling functions: kernel polynomials at the zeros of a Chebyshev polynomial (Sohn et al., section 3.4).

Band j of n + 1 is K_n(·; ξ_j) = Σ_k T_k(·)T_k(ξ_j), scaled, with ξ_j = cos((2j + 1)π/(2n + 2)) a zero of T_{n+1}.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float64

from jaxmark.bands.damping import Damping, damping_factors
from jaxmark.errors import JaxmarkError


def scaling(
    bands: int,
    *,
    kernel: Literal["halved", "printed"] = "halved",
    damping: Damping = "none",
) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of the scaling functions, one band a row, of degree bands - 1.

    Rows go by *increasing* frequency: the paper counts from the highest band, because Δ̃'s value rises with frequency
    and its ξ_j falls with j.

    Args:
        bands: how many, at least 1.
        kernel: `"printed"` as the paper has it, scale 1/bands: the k = 0 term counts in full, so a band is not zero
            at the other nodes but 1/2 of the scale 1/bands. `"halved"` halves that term, scale 2/bands: the Lagrange
            basis at the nodes. Both are partitions of unity.
        damping: `damping_factors` on the terms, against the Gibbs oscillation. They keep the partition of unity.

    Returns:
        `[bands, bands]`.

    Raises:
        JaxmarkError: if `bands` is below 1 or a name is unknown.
    """
    if bands < 1:
        raise JaxmarkError(f"scaling needs at least one band, got {bands}.")
    k = np.arange(bands)
    # Descending j is ascending frequency.
    angles = (2 * np.arange(bands)[::-1] + 1) * np.pi / (2 * bands)
    coefficients = np.cos(np.outer(angles, k)) * damping_factors(damping, bands)
    match kernel:
        case "printed":
            return coefficients / bands
        case "halved":
            return coefficients * np.where(k == 0, 1, 2) / bands
    raise JaxmarkError(f"kernel must be 'halved' or 'printed', got {kernel!r}.")


def nodes(bands: int) -> Float64[np.ndarray, " bands"]:
    """λ at the zeros of T_bands(λ - 1), ascending.

    There the scaling functions of the halved kernel are 1 each in turn and 0 otherwise, so that
    `values @ scaling(bands)` is the Chebyshev series of degree bands - 1 through any values there.
    """
    return 1 - np.cos((np.arange(bands) + 0.5) * np.pi / bands)
