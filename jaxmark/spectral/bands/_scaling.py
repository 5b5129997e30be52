"""Scaling functions: kernel polynomials at the zeros of a Chebyshev polynomial (Sohn et al., section 3.4).

Band j of n + 1 is K_n(·; ξ_j) = Σ_k T_k(·)T_k(ξ_j), scaled, with the zero ξ_j = cos((2j + 1)π/(2n + 2)) of T_{n+1}.
"""

from typing import Literal

import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.bands.damping import Damping, damping_factors


def scaling(
    bands: int,
    *,
    kernel: Literal["halved", "printed"] = "halved",
    damping: Damping = "none",
) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of the scaling functions, one band a row, of degree bands - 1.

    Rows are ordered by *increasing* frequency. The paper counts from the highest band, because the eigenvalues of Δ̃
    rise with frequency and its ξ_j fall with j.

    Args:
        bands: number of bands, at least 1.
        kernel: `"printed"` is the paper's, scaled by 1/bands: the k = 0 term counts in full, so that a band is not zero
            at the other nodes but 1/2 of the scale 1/bands. `"halved"` halves that term and scales by 2/bands, which
            gives the Lagrange basis at the nodes. Both are partitions of unity.
        damping: name of the `damping_factors` that the terms are multiplied by, against the Gibbs oscillation; they
            keep the partition of unity.

    Returns:
        `[bands, bands]`.

    Raises:
        JaxmarkError: if `bands` is below 1 or a name is unknown.
    """
    if bands < 1:
        raise JaxmarkError(f"scaling needs at least one band, got {bands}.")
    k = np.arange(bands)
    # Frequency ascends as j descends.
    angles = (2 * np.arange(bands)[::-1] + 1) * np.pi / (2 * bands)
    coefficients = np.cos(np.outer(angles, k)) * damping_factors(damping, bands)
    match kernel:
        case "printed":
            return coefficients / bands
        case "halved":
            return coefficients * np.where(k == 0, 1, 2) / bands
    raise JaxmarkError(f"kernel must be 'halved' or 'printed', got {kernel!r}.")


def nodes(bands: int) -> Float64[np.ndarray, " bands"]:
    """The zeros λ of T_bands(λ - 1), ascending.

    At each of them one scaling function of the halved kernel is 1 and all others are 0, so that
    `values @ scaling(bands)` is the Chebyshev series of degree bands - 1 that interpolates the values at the nodes.
    """
    return 1 - np.cos((np.arange(bands) + 0.5) * np.pi / bands)
