"""Damping factors against the Gibbs oscillation of truncated Chebyshev series."""

from typing import Literal

import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError

Damping = Literal["none", "jackson", "lanczos"]


def damping_factors(name: Damping, terms: int) -> Float64[np.ndarray, " terms"]:
    """Factors g_k by which the terms of a truncated Chebyshev series are multiplied; g_0 = 1.

    `"jackson"` is Jackson's kernel (Weiße et al., Rev. Mod. Phys. 78, 2006, eq. 71): the series of a non-negative
    function stays non-negative, and is blurred by about 1/terms in the angle arccos(λ - 1). `"lanczos"` are the
    σ-factors sinc(k/terms). `"none"` is 1 for all terms.

    Raises:
        JaxmarkError: if the name is unknown.
    """
    k = np.arange(terms)
    match name:
        case "none":
            return np.ones(terms)
        case "jackson":
            q = np.pi / (terms + 1)
            return ((terms - k + 1) * np.cos(q * k) + np.sin(q * k) / np.tan(q)) / (terms + 1)
        case "lanczos":
            return np.sinc(k / terms)
    raise JaxmarkError(f"damping must be 'none', 'jackson' or 'lanczos', got {name!r}.")
