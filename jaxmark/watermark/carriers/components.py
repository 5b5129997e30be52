"""Components that a modulated carrier adds up: the paper's band components of the host, and Ohbuchi's eigenspaces.

The band components f_j(Δ)x of the host are those of Sohn et al., sections 2.2 and 3. Ohbuchi, Takahashi, Miyazawa and
Mukaiyama ("Watermarking 3D polygonal meshes in the mesh spectral domain", 2001) add ±β to spectral coefficients. Their
scheme is the special case of the components x_j = ⟨x, φ_j⟩_D φ_j at unit norm, where the host fixes the arbitrary sign
of each eigenvector. Repeated eigenvalues have no preferred eigenvectors; the component is then the host's projection
onto the eigenspace.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.spectral.chebyshev import cross_moments, filter, gram
from jaxmark.spectral.laplacian import Laplacian
from jaxmark.spectral.precision import einsum, matmul
from jaxmark.spectral.spectrum import Eigenpairs
from jaxmark.watermark.interfaces import Displacement

# Relative to the host's norm. A band with a smaller norm contains only leakage from its neighbours and rounding noise,
# and would consist of nothing else after scaling to unit norm.
_MIN_BAND_NORM = 1e-5


@runtime_checkable
class Components(Protocol):
    """The displacements that a carrier adds up: one vector `[N]` per band and coordinate.

    They are determined by the original and must not depend on the key.
    """

    @property
    def gram(self) -> Float[Array, "3 bands bands"]:
        """The D inner products of the components, per coordinate."""
        ...

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Displacement:
        """Add up the components: Σ_j amplitude_jc · component_jc for each coordinate c."""
        ...

    def analyse(self, residual: Displacement) -> Float[Array, "bands 3"]:
        """Apply the D-adjoint of `synthesise`: ⟨residual_c, component_jc⟩_D for each band j and coordinate c."""
        ...


class HostBands(NamedTuple):
    """The band components of the host, per coordinate; writing and reading need one filter each and O(N) memory."""

    operator: Laplacian
    signal: Float[Array, "vertices 3"]  # the host's coordinates, centred per connected component
    coefficients: Float[Array, "bands terms"]  # Chebyshev coefficients C of the bands
    scale: Float[Array, "bands 3"]  # 1 for the printed scheme; 1/‖f_j x_c‖_D for unit norm, 0 where the band is empty
    gram: Float[Array, "3 bands bands"]  # D inner products of the scaled components, per coordinate

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Float[Array, "vertices 3"]:
        """See `Components`; computed by one filter per coordinate, with the coefficients amplitudesᵀ·C."""
        return filter(self.operator, matmul(self.coefficients.T, self.scale * amplitudes).T, self.signal)

    def analyse(self, residual: Float[Array, "vertices 3"]) -> Float[Array, "bands 3"]:
        """See `Components`; computed for all bands from the moments ⟨residual, T_k(Δ̃)x⟩_D."""
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
        unit_norm: whether to scale each component to ‖·‖_D = 1 and drop components with less than 1e-5 of the host's
            norm; False gives the scheme as printed.

    Returns:
        The components. Their Gram matrix needs O(bands · N) memory here, once.
    """
    signal = jnp.asarray(signal)
    c = jnp.asarray(coefficients).astype(signal.dtype)
    products = gram(operator, c, signal)
    if not unit_norm:
        return HostBands(operator, signal, c, jnp.ones((len(c), 3), signal.dtype), products)
    squares = jnp.diagonal(products, axis1=1, axis2=2).T
    used = squares > _MIN_BAND_NORM**2 * operator.inner(signal, signal)
    # Select before taking the root, because the derivative of the root is infinite for an empty band.
    scale = jnp.where(used, 1 / jnp.sqrt(jnp.where(used, squares, 1)), 0)
    return HostBands(operator, signal, c, scale, scale.T[:, :, None] * products * scale.T[:, None, :])


class Eigenspaces(NamedTuple):
    """The host's projections onto eigenspaces at unit norm, per coordinate; O(bands · N) memory."""

    vectors: Float[Array, "vertices bands"]  # D-orthonormal eigenvectors
    degree: Float[Array, " vertices"]  # D
    direction: Float[Array, "bands 3"]  # the host's spectral coefficients, scaled to unit length in each eigenspace
    space: Int[Array, " bands"]  # the band that represents the eigenspace of each eigenvector

    @property
    def gram(self) -> Float[Array, "3 bands bands"]:
        """See `Components`; eigenspaces are orthogonal: the diagonal is 1 where a band is used, and the rest is 0."""
        used = jax.ops.segment_sum(self.direction**2, self.space, len(self.space))
        return einsum("jc,jk->cjk", used, jnp.eye(len(self.space), dtype=used.dtype))

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Float[Array, "vertices 3"]:
        """See `Components`."""
        return matmul(self.vectors, self.direction * amplitudes[self.space])

    def analyse(self, residual: Float[Array, "vertices 3"]) -> Float[Array, "bands 3"]:
        """See `Components`."""
        products = self.direction * matmul(self.vectors.T, self.degree[:, None] * residual)
        return jax.ops.segment_sum(products, self.space, len(self.space))


def eigenspaces(operator: Laplacian, signal: Float[Array | np.ndarray, "vertices 3"], pairs: Eigenpairs) -> Eigenspaces:
    """Prepare the host's projections onto eigenspaces as components.

    Args:
        operator: the Laplacian, of N vertices.
        signal: the host's coordinates `[N, 3]`, centred per connected component.
        pairs: from `jaxmark.spectral.spectrum.eigenpairs`; each pair is a band, and the first pair of an eigenspace
            represents the whole eigenspace.

    Returns:
        The components; bands with less than 1e-6 of the host's norm are not used.
    """
    signal = jnp.asarray(signal)
    vectors = jnp.asarray(pairs.vectors).astype(signal.dtype)
    degree = jnp.asarray(operator.degree).astype(signal.dtype)
    space = jnp.asarray(pairs.space)
    spectrum = matmul(vectors.T, degree[:, None] * signal)
    squares = jax.ops.segment_sum(spectrum**2, space, len(space))
    used = squares > 1e-12 * operator.inner(signal, signal)
    scale = jnp.where(used, 1 / jnp.sqrt(jnp.where(used, squares, 1)), 0)
    return Eigenspaces(vectors, degree, spectrum * scale[space], space)
