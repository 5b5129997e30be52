"""Factors that take the Gibbs oscillation off a Chebyshev series that is cut off."""

from typing import Literal

import numpy as np
from jaxtyping import Float64

from jaxmark.errors import JaxmarkError

Damping = Literal["none", "jackson", "lanczos"]


def damping_factors(name: Damping, terms: int) -> Float64[np.ndarray, " terms"]:
    """One factor g_k per term, g_0 = 1.

    `"jackson"` is Jackson's kernel (Weiße et al., Rev. Mod. Phys. 78, 2006, eq. 71): a series of a non-negative
    function stays non-negative, and 1/terms of its angle is what it is blurred by. `"lanczos"`: σ-factors
    sinc(k/terms). `"none"`: 1.

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
