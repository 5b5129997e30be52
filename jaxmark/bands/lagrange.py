"""Lagrange polynomials: at the eigenvalues, exact projections onto the eigenspaces (Sohn et al., eq. 8-10)."""

import numpy as np
from jaxtyping import Float, Float64

from jaxmark.bands.scaling import nodes, scaling
from jaxmark.errors import JaxmarkError

_LARGEST = 1e8  # half of float64's digits


def lagrange(eigenvalues: Float[np.ndarray, " bands"]) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of Π_{i≠j} (λ - λ_i)/(λ_j - λ_i), one λ_j a row: a partition of unity.

    At the distinct eigenvalues, the null space's 0 among them,

        pairs = eigenpairs(operator)
        eigenvalues = np.append(0, pairs.values[np.unique(pairs.space)])

    f_j(Δ) is the D-orthogonal projection onto an eigenspace, and c² = ⟨f_j(Δ)x, x⟩_D the energy that x has there, all
    at once `lagrange(eigenvalues) @ cross_moments(operator, x, x, degree=len(eigenvalues) - 1)`. At the zeros of a
    Chebyshev polynomial, `nodes`, this is `scaling`.

    The degree is the number of eigenvalues less one, and between crowded ones the polynomials are huge, so this is for
    spectra of a dozen eigenvalues: rounding is that of the dtype, times the polynomials' size. In factors, by
    `product.lagrange_factors`, it is mostly less, but no larger spectrum comes within reach.

    Args:
        eigenvalues: λ `[bands]`, distinct, in [0, 2].

    Returns:
        `[bands, bands]`, in their order.

    Raises:
        JaxmarkError: if two nodes fall together, or so crowd that the polynomials exceed 1e8.
    """
    size = len(eigenvalues)
    if size == 0 or len(np.unique(eigenvalues)) < size:
        raise JaxmarkError(f"lagrange needs one node or more, all distinct, got {eigenvalues}.")
    points = nodes(size)
    with np.errstate(over="ignore", invalid="ignore"):  # such are refused
        basis = [
            np.prod((points - others[:, None]) / (node - others[:, None]), axis=0)
            for node, others in ((eigenvalues[j], np.delete(eigenvalues, j)) for j in range(size))
        ]
        coefficients = np.stack(basis) @ scaling(size)
        largest = np.abs(coefficients).sum(axis=1).max()
    if not largest < _LARGEST:
        raise JaxmarkError(
            f"{size} nodes crowd so much that their polynomials, of size {largest:.0e}, would lose all digits; use"
            " eigenpairs."
        )
    return coefficients
