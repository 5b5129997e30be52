"""Dense NumPy references, written from the definitions."""

import numpy as np

from jaxmark.spectral.laplacian import Laplacian, host_edges


def laplacian_matrix(operator: Laplacian) -> np.ndarray:
    """Δ = I - D⁻¹W entry by entry, a zero row for an isolated vertex."""
    degree = np.asarray(operator.degree, np.float64)
    weights = np.zeros((len(degree), len(degree)))
    for (i, j), value in zip(*host_edges(operator), strict=True):
        weights[i, j] += value
        weights[j, i] += value
    matrix = np.zeros_like(weights)
    for i, d in enumerate(degree):
        if d > 0:
            matrix[i] = -weights[i] / d
            matrix[i, i] += 1
    return matrix


def chebyshev_matrices(operator: Laplacian, degree: int) -> np.ndarray:
    """T_k(Δ - I) for k = 0 … degree by eigendecomposition, not by recurrence: `[degree + 1, N, N]`."""
    values, vectors = np.linalg.eig(laplacian_matrix(operator))
    inverse = np.linalg.inv(vectors)
    angles = np.arccos(np.clip(np.real(values) - 1, -1, 1))
    return np.real(np.stack([(vectors * np.cos(k * angles)) @ inverse for k in range(degree + 1)]))


def tolerance(dtype: np.dtype, factor: float = 1.0) -> float:
    """A few hundred roundings, relative."""
    return factor * 300 * float(np.finfo(dtype).eps)
