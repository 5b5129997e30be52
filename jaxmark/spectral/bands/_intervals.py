"""Bands between any edges, and edges that give every band an equal part of a spectral measure."""

import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.bands.damping import Damping, damping_factors

_BISECTIONS = 60  # enough to find the angle of an edge to the last bit


def intervals(
    edges: Float[np.ndarray, " edges"], terms: int, *, damping: Damping = "jackson"
) -> Float64[np.ndarray, "bands terms"]:
    """Chebyshev coefficients of the indicators of [edges_j, edges_{j+1}], truncated and damped, one band a row.

    With λ - 1 = cos φ an indicator is a cosine series, c_0 = (φ_j - φ_{j+1})/π and
    c_k = 2 (sin kφ_j - sin kφ_{j+1})/(πk). If the edges reach from 0 to 2, the bands are a partition of unity.
    Jackson's damping keeps them within [0, 1], and blurs an edge by about 1/terms in the angle φ.

    Args:
        edges: λ `[bands + 1]`, ascending in [0, 2].
        terms: number of terms, degree + 1.
        damping: name of the `damping_factors` that the terms are multiplied by.

    Returns:
        `[bands, terms]`, by increasing frequency.

    Raises:
        JaxmarkError: if the edges do not ascend within [0, 2], or `damping` is unknown.
    """
    if len(edges) < 2 or edges[0] < 0 or edges[-1] > 2 or not (np.diff(edges) > 0).all():
        raise JaxmarkError(f"intervals needs two edges or more that ascend within [0, 2], got {edges}.")
    angles = np.arccos(edges - 1)
    k = np.arange(1, terms)
    sines = np.column_stack([angles, 2 * np.sin(np.outer(angles, k)) / k]) / np.pi
    return -np.diff(sines, axis=0) * damping_factors(damping, terms)


def equal_edges(moments: Float[Array | np.ndarray, " terms"], bands: int) -> Float64[np.ndarray, " edges"]:
    """Edges that divide a spectral measure into equal parts, by the kernel polynomial method.

    The measure μ is given by its Chebyshev moments m_k = ∫ T_k(λ - 1) dμ(λ). `chebyshev.moments(operator, x,
    degree=...)` of the host are those of its energy; of `spectrum.white_probes` signals, summed, those of the count of
    eigenvalues. The density is their Chebyshev series, damped by Jackson's kernel (Weiße et al., Rev. Mod. Phys. 78,
    2006, section II.C). The bands `intervals(equal_edges(m, bands), len(m))` then have *exactly* equal
    ⟨x, f_j(Δ)x⟩_D = ∫ f_j dμ, however coarse the estimate, because the same kernel blurs both: no band is empty.

    Args:
        moments: `[terms]`, of one measure. They must depend on the mesh alone, never on a key.
        bands: number of bands.

    Returns:
        λ `[bands + 1]` from 0 to 2.

    Raises:
        JaxmarkError: if the measure is 0, or too concentrated for so many bands: their edges would coincide.
    """
    m = np.asarray(moments, np.float64)
    if not m[0] > 0:
        raise JaxmarkError("equal_edges needs a measure with some energy; that of this signal is 0.")
    k = np.arange(1, len(m))
    series = damping_factors("jackson", len(m))[1:] * m[1:] / m[0] * 2 / k
    wanted = 1 - np.arange(1, bands) / bands  # share above the edge, between the angles 0 and φ
    low, high = np.zeros(bands - 1), np.full(bands - 1, np.pi)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        above = (middle + np.sin(np.outer(middle, k)) @ series) / np.pi
        low, high = np.where(above < wanted, middle, low), np.where(above < wanted, high, middle)
    edges = np.concatenate([[0], 1 + np.cos(low), [2]])
    if not (np.diff(edges) > 0).all():
        raise JaxmarkError(f"{bands} bands are too many for {len(m)} moments of this measure; take more moments.")
    return edges
