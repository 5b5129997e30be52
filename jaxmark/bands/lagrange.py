"""Lagrange polynomials: at the eigenvalues, exact projections onto the eigenspaces (Sohn et al., eq. 8-10)."""

import numpy as np
from jaxtyping import Float, Float64
from numpy.polynomial import chebyshev

from jaxmark.errors import JaxmarkError

_LARGEST = 1e8  # half of float64's digits


def lagrange(nodes: Float[np.ndarray, " bands"]) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of Π_{i≠j} (λ - λ_i)/(λ_j - λ_i), one node λ_j a row: a partition of unity.

    At the distinct eigenvalues, the null space's 0 among them,

        pairs = eigenpairs(operator)
        nodes = np.append(0, pairs.values[np.unique(pairs.space)])

    f_j(Δ) is the D-orthogonal projection onto an eigenspace, and c² = ⟨f_j(Δ)x, x⟩_D the energy that x has there, for
    all j at once `lagrange(nodes) @ cross_moments(operator, x, x, degree=len(nodes) - 1)`. At the zeros of a Chebyshev
    polynomial this is `scaling`. The degree is the number of eigenvalues less one, and between crowded ones the
    polynomials are huge, so this is for spectra of a dozen eigenvalues: rounding is their size times the dtype's.
    `product.lagrange_factors` loses a digit or two less.

    Args:
        nodes: λ `[bands]`, distinct, in [0, 2].

    Returns:
        `[bands, bands]`, in the order of the nodes.

    Raises:
        JaxmarkError: if two nodes fall together, or so crowd that the polynomials exceed 1e8.
    """
    size = len(nodes)
    if size == 0 or len(np.unique(nodes)) < size:
        raise JaxmarkError(f"lagrange needs one node or more, all distinct, got {nodes}.")

    def basis(t: np.ndarray) -> np.ndarray:
        bands = [
            np.prod((t[:, None] + 1 - others) / (node - others), axis=1)
            for node, others in ((nodes[j], np.delete(nodes, j)) for j in range(size))
        ]
        return np.stack(bands, axis=1)

    with np.errstate(over="ignore", invalid="ignore"):  # such are refused
        coefficients = chebyshev.chebinterpolate(basis, size - 1).T
        largest = np.abs(coefficients).sum(axis=1).max()
    if not largest < _LARGEST:
        raise JaxmarkError(
            f"{size} nodes crowd so much that their polynomials, of size {largest:.0e}, would lose all digits; use"
            " eigenpairs."
        )
    return coefficients
