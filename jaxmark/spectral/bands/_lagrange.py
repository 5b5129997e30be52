"""Lagrange polynomials, which at the eigenvalues are exact projections onto eigenspaces (Sohn et al., eq. 8-10)."""

import numpy as np
from jaxtyping import Float, Float64

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.bands._scaling import nodes, scaling

_MAX_SIZE = 1e8  # largest sum of a polynomial's |coefficients|; a larger one costs over half of float64's digits


def lagrange(eigenvalues: Float[np.ndarray, " bands"]) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of Π_{i≠j} (λ - λ_i)/(λ_j - λ_i), one λ_j a row: a partition of unity.

    At the distinct eigenvalues, including the 0 of the null space,

        pairs = eigenpairs(operator)
        eigenvalues = np.append(0, pairs.values[np.unique(pairs.space)])

    f_j(Δ) is the D-orthogonal projection onto an eigenspace, and c² = ⟨f_j(Δ)x, x⟩_D is the energy of x there, for all
    eigenspaces at once `lagrange(eigenvalues) @ cross_moments(operator, x, x, degree=len(eigenvalues) - 1)`. At the
    zeros of a Chebyshev polynomial, `nodes`, these are the polynomials of `scaling`.

    The degree is the number of eigenvalues less one, and between crowded eigenvalues the polynomials are huge, so this
    is for spectra of a dozen eigenvalues: the rounding error is that of the dtype times the polynomials' size. The
    factors of `product.lagrange_factors` mostly round less, but make no larger spectrum feasible.

    Args:
        eigenvalues: λ `[bands]`, distinct, in [0, 2].

    Returns:
        `[bands, bands]`, in the order of the eigenvalues.

    Raises:
        JaxmarkError: if there is no eigenvalue, two coincide, or they crowd so much that the polynomials exceed 1e8.
    """
    size = len(eigenvalues)
    if size == 0 or len(np.unique(eigenvalues)) < size:
        raise JaxmarkError(f"lagrange needs one node or more, all distinct, got {eigenvalues}.")
    points = nodes(size)
    with np.errstate(over="ignore", invalid="ignore"):  # polynomials that overflow are refused below
        basis = [
            np.prod((points - others[:, None]) / (node - others[:, None]), axis=0)
            for node, others in ((eigenvalues[j], np.delete(eigenvalues, j)) for j in range(size))
        ]
        coefficients = np.stack(basis) @ scaling(size)
        largest = np.abs(coefficients).sum(axis=1).max()
    if not largest < _MAX_SIZE:
        raise JaxmarkError(
            f"{size} nodes crowd so much that their polynomials, of size {largest:.0e}, would lose all digits; use"
            " eigenpairs."
        )
    return coefficients
