"""The paper's components: band components f_j(Δ)x of the host itself (Sohn et al., sections 2.2 and 3)."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.spectral.chebyshev import cross_moments, filter, gram
from jaxmark.spectral.laplacian import Laplacian
from jaxmark.spectral.precision import matmul

# Share of the host's norm. A band that holds less contains only leakage from its neighbours and rounding noise, and
# would carry nothing else when scaled to unit norm.
_MIN_BAND_NORM = 1e-5


class HostBands(NamedTuple):
    """Band components of the host, per coordinate; writing and reading cost one filter each and O(N) memory."""

    operator: Laplacian
    signal: Float[Array, "vertices 3"]  # the host's coordinates, centred per connected component
    coefficients: Float[Array, "bands terms"]  # Chebyshev coefficients C of the bands
    scale: Float[Array, "bands 3"]  # 1 as printed; 1/‖f_j x_c‖_D for unit norm, 0 where the band is empty
    gram: Float[Array, "3 bands bands"]  # D inner products of the scaled components, per coordinate

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Float[Array, "vertices 3"]:
        """See `Components`; all bands together are one filter per coordinate, with coefficients amplitudesᵀ·C."""
        return filter(self.operator, matmul(self.coefficients.T, self.scale * amplitudes).T, self.signal)

    def analyse(self, residual: Float[Array, "vertices 3"]) -> Float[Array, "bands 3"]:
        """See `Components`; all bands need only the moments ⟨residual, T_k(Δ̃)x⟩_D."""
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
        signal: the host's coordinates `[N, 3]`, **centred per connected component**
            (`jaxmark.spectral.laplacian.centre`).
        coefficients: a family from `jaxmark.spectral.bands`, `[bands, degree + 1]`.
        unit_norm: whether to scale each component to ‖·‖_D = 1 and drop those that hold less than 1e-5 of the host's
            norm; False is the scheme as printed.

    Returns:
        The components. Their Gram matrix takes O(bands · N) memory here, once.
    """
    signal = jnp.asarray(signal)
    c = jnp.asarray(coefficients).astype(signal.dtype)
    products = gram(operator, c, signal)
    if not unit_norm:
        return HostBands(operator, signal, c, jnp.ones((len(c), 3), signal.dtype), products)
    squares = jnp.diagonal(products, axis1=1, axis2=2).T
    full = squares > _MIN_BAND_NORM**2 * operator.inner(signal, signal)
    # Select before the root, because its slope at an empty band is infinite.
    scale = jnp.where(full, 1 / jnp.sqrt(jnp.where(full, squares, 1)), 0)
    return HostBands(operator, signal, c, scale, scale.T[:, :, None] * products * scale.T[:, None, :])
