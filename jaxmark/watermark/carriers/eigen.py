"""Ohbuchi's components: the projections of the host onto eigenspaces of the Laplacian.

Ohbuchi, Takahashi, Miyazawa, Mukaiyama, "Watermarking 3D polygonal meshes in the mesh spectral domain", 2001, add ±β to
spectral coefficients. The paper's special case x_j = ⟨x, φ_j⟩_D φ_j, at unit norm, is that scheme with each
eigenvector's arbitrary sign fixed by the host. Repeated eigenvalues have no preferred eigenvectors: the host's
projection onto the whole eigenspace stands for them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.spectral.laplacian import Laplacian
from jaxmark.spectral.precision import einsum, matmul
from jaxmark.spectral.spectrum import Eigenpairs


class Eigenspaces(NamedTuple):
    """Unit projections of the host onto eigenspaces, per coordinate; O(bands · N) memory."""

    vectors: Float[Array, "vertices bands"]  # D-orthonormal eigenvectors
    degree: Float[Array, " vertices"]  # D
    direction: Float[Array, "bands 3"]  # the host's spectral coefficients, scaled to unit length in each eigenspace
    space: Int[Array, " bands"]  # the band that stands for the eigenspace of each eigenvector

    @property
    def gram(self) -> Float[Array, "3 bands bands"]:
        """See `Components`; eigenspaces are orthogonal, so it is 1 on the diagonal where a band is used, else 0."""
        used = jax.ops.segment_sum(self.direction**2, self.space, len(self.space))
        return einsum("jc,jk->cjk", used, jnp.eye(len(self.space), dtype=used.dtype))

    def synthesise(self, amplitudes: Float[Array, "bands 3"]) -> Float[Array, "vertices 3"]:
        """See `Components`."""
        return matmul(self.vectors, self.direction * amplitudes[self.space])

    def analyse(self, residual: Float[Array, "vertices 3"]) -> Float[Array, "bands 3"]:
        """See `Components`."""
        found = self.direction * matmul(self.vectors.T, self.degree[:, None] * residual)
        return jax.ops.segment_sum(found, self.space, len(self.space))


def eigenspaces(operator: Laplacian, signal: Float[Array | np.ndarray, "vertices 3"], pairs: Eigenpairs) -> Eigenspaces:
    """Prepare the host's projections onto eigenspaces as components.

    Args:
        operator: the Laplacian, of N vertices.
        signal: the host's coordinates `[N, 3]`, centred per connected component.
        pairs: from `jaxmark.spectral.spectrum.eigenpairs`; each pair is a band, and the first pair of an eigenspace
            stands for the whole eigenspace.

    Returns:
        The components; a band that holds less than 1e-6 of the host's norm is not used.
    """
    signal = jnp.asarray(signal)
    vectors = jnp.asarray(pairs.vectors).astype(signal.dtype)
    degree = jnp.asarray(operator.degree).astype(signal.dtype)
    space = jnp.asarray(pairs.space)
    found = matmul(vectors.T, degree[:, None] * signal)
    squares = jax.ops.segment_sum(found**2, space, len(space))
    full = squares > 1e-12 * operator.inner(signal, signal)
    scale = jnp.where(full, 1 / jnp.sqrt(jnp.where(full, squares, 1)), 0)
    return Eigenspaces(vectors, degree, found * scale[space], space)
