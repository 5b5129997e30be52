"""Detectors: from a residual to one soft value per bit. Any carrier goes with any detector."""

from collections.abc import Callable

import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float

from jaxmark.carriers import Carrier
from jaxmark.carriers.carrier import Displacement, Strength

Detector = Callable[[Carrier, Displacement, Strength], Float[Array, " bits"]]


def correlate(carrier: Carrier, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """W_i = ⟨residual, Σ_j p_j^(i) x_j⟩_D, the paper's detection value (2.2.2, with the D it leaves out).

    Its sign is the bit, where components are nearly orthogonal.
    """
    return carrier.adjoint(residual, beta)


def decorrelate(carrier: Carrier, residual: Displacement, beta: Strength = 1.0) -> Float[Array, " bits"]:
    """Least-squares amplitudes of the bits: the correlations, with the bits' interference solved out.

    With the embedding's β they are ±1 where nothing was attacked. Directions that the carrier does not span within
    rounding are held at zero by a ridge of 16 eps times the energy of all bits.
    """
    products = carrier.gram(beta)
    ridge = 16 * jnp.finfo(products.dtype).eps * jnp.trace(products)
    # A carrier without energy must give zeros, not the quotient of two.
    ridge = jnp.where(ridge > 0, ridge, 1)
    factor = jsl.cho_factor(products + ridge * jnp.eye(len(products), dtype=products.dtype), lower=True)
    return jsl.cho_solve(factor, carrier.adjoint(residual, beta))
