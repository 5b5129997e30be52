"""The paper's components: band components f_j(Δ)x of the host itself (Sohn et al., sections 2.2 and 3)."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.chebyshev import cross_moments, filter, gram
from jaxmark.laplacian import Laplacian
from jaxmark.precision import matmul

# A band that holds less than this share of the host's norm holds its neighbours' leakage and rounding noise; scaled up
# to unit norm it would carry nothing else.
_EMPTY = 1e-5


class HostBands(NamedTuple):
    """Band components of the host, per coordinate; writing and reading take one filter each and O(N) memory."""

    operator: Laplacian
    signal: Float[Array, "vertices 3"]  # the host, centred per component
    coefficients: Float[Array, "bands terms"]
    scale: Float[Array, "bands 3"]  # 1 as printed; 1/‖f_j x_c‖_D for unit norm, 0 where the band is empty
    gram: Float[Array, "3 bands bands"]  # of the scaled components

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Float[Array, "vertices 3"]:
        """See `Components`: all bands are one filter per coordinate, with coefficients Cᵀ·amplitudes."""
        return filter(self.operator, matmul(self.coefficients.T, self.scale * amplitudes), self.signal)

    def analyse(self, residual: Float[Array, "vertices 3"]) -> Float[Array, "bands 3"]:
        """See `Components`: all bands need only the moments ⟨residual, T_k(Δ̃)x⟩_D."""
        terms = self.coefficients.shape[1]
        products = cross_moments(self.operator, residual, self.signal, degree=terms - 1)
        return self.scale * matmul(self.coefficients, products)


def host_bands(
    operator: Laplacian,
    signal: Float[Array | np.ndarray, "vertices 3"],
    coefficients: Float[Array | np.ndarray, "bands terms"],
    *,
    unit_norm: bool = True,
) -> HostBands:
    """Prepare the host's bands as components; can be traced and differentiated with respect to the signal.

    Args:
        operator: the Laplacian, of N vertices.
        signal: the host's coordinates `[N, 3]`, **centred per component** (`jaxmark.laplacian.centre`).
        coefficients: a family from `jaxmark.bands`, `[bands, degree + 1]`.
        unit_norm: scale each component to ‖·‖_D = 1 and drop those that hold less than 1e-5 of the host's norm;
            False is the scheme as printed.

    Returns:
        The components. O(bands · N) memory here, once, for their Gram matrix.
    """
    signal = jnp.asarray(signal)
    c = jnp.asarray(coefficients).astype(signal.dtype)
    products = gram(operator, c, signal)
    if not unit_norm:
        return HostBands(operator, signal, c, jnp.ones((len(c), 3), signal.dtype), products)
    squares = jnp.diagonal(products, axis1=1, axis2=2).T
    full = squares > _EMPTY**2 * operator.inner(signal, signal)
    # Select before the root: its slope at an empty band is infinite.
    scale = jnp.where(full, 1 / jnp.sqrt(jnp.where(full, squares, 1)), 0)
    return HostBands(operator, signal, c, scale, scale.T[:, :, None] * products * scale.T[:, None, :])
