"""Partitions of unity: scaling functions, Bernstein and Lagrange polynomials, intervals; and damping of their series.

Damping factors multiply the terms of a truncated series, against the Gibbs oscillation.
"""

from typing import Literal

import numpy as np
from jaxtyping import Array, Float, Float64
from scipy import special

from jaxmark.errors import JaxmarkError

#: How the series of a family is damped against ripples.
Damping = Literal["none", "jackson", "lanczos"]

_MAX_SIZE = 1e8  # largest sum of a polynomial's |coefficients|; a larger one costs over half of float64's digits
_BISECTIONS = 60  # enough to find the angle of an edge to the last bit


def damping_factors(name: Damping, terms: int) -> Float64[np.ndarray, " terms"]:
    """Compute the factors g_k that damp the terms of a truncated Chebyshev series; g_0 = 1.

    `"jackson"` is Jackson's kernel (Weiße et al., Rev. Mod. Phys. 78, 2006, eq. 71): the series of a non-negative
    function stays non-negative, and is blurred by about 1/terms in the angle arccos(λ - 1). `"lanczos"` are the
    σ-factors sinc(k/terms). `"none"` is 1 for all terms.
    """
    k = np.arange(terms)
    match name:
        case "none":
            return np.ones(terms)
        case "jackson":
            q = np.pi / (terms + 1)
            return ((terms - k + 1) * np.cos(q * k) + np.sin(q * k) / np.tan(q)) / (terms + 1)
        case "lanczos":
            return np.sinc(k / terms)
    raise JaxmarkError(f"damping must be 'none', 'jackson' or 'lanczos', got {name!r}.")


def nodes(bands: int) -> Float64[np.ndarray, " bands"]:
    """Compute the zeros λ of T_bands(λ - 1), ascending.

    At each of them one scaling function of the halved kernel is 1 and all others are 0, so that
    `values @ scaling(bands)` is the Chebyshev series of degree bands - 1 that interpolates the values at the nodes.
    """
    return 1 - np.cos((np.arange(bands) + 0.5) * np.pi / bands)


def scaling(
    bands: int,
    *,
    kernel: Literal["halved", "printed"] = "halved",
    damping: Damping = "none",
) -> Float64[np.ndarray, "bands terms"]:
    """Compute the scaling functions, one row per band, of degree bands - 1 (Sohn et al., section 3.4).

    Band j of n + 1 is the kernel polynomial K_n(·; ξ_j) = Σ_k T_k(·)T_k(ξ_j), scaled, at the zero
    ξ_j = cos((2j + 1)π/(2n + 2)) of T_{n+1}. The paper counts from the highest band, because the eigenvalues of Δ̃ rise
    with frequency and its ξ_j fall with j.

    Args:
        bands: number of bands, at least 1.
        kernel: `"printed"` is the paper's, scaled by 1/bands: the k = 0 term counts in full, so that a band is not zero
            at the other nodes but 1/2 of the scale 1/bands. `"halved"` halves that term and scales by 2/bands, which
            gives the Lagrange basis at the nodes. Both are partitions of unity.
        damping: name of the `damping_factors`; they keep the partition of unity.
    """
    if bands < 1:
        raise JaxmarkError(f"scaling needs at least one band, got {bands}.")
    k = np.arange(bands)
    # Frequency ascends as j descends.
    angles = (2 * np.arange(bands)[::-1] + 1) * np.pi / (2 * bands)
    coefficients = np.cos(np.outer(angles, k)) * damping_factors(damping, bands)
    match kernel:
        case "printed":
            return coefficients / bands
        case "halved":
            return coefficients * np.where(k == 0, 1, 2) / bands
    raise JaxmarkError(f"kernel must be 'halved' or 'printed', got {kernel!r}.")


def bernstein(bands: int) -> Float64[np.ndarray, "bands terms"]:
    """Compute the Chebyshev coefficients of C(n, j) (λ/2)^j (1 - λ/2)^(n - j), n = bands - 1 ≥ 0, one row per band.

    The bands are a partition of unity within [0, 1], without any oscillation, but wide (Sohn et al., section 3.3). Band
    j has its peak at λ = 2j/n and is about √(λ(2 - λ)/n) wide: bands half as wide take four times the degree, where
    other families take twice the degree.
    """
    if bands < 1:
        raise JaxmarkError(f"bernstein needs at least one band, got {bands}.")
    # The values are nowhere above 1, so that interpolation is exact up to rounding.
    j, at, n = np.arange(bands)[:, None], nodes(bands) / 2, bands - 1
    logarithm = -special.betaln(n - j + 1, j + 1) - np.log(n + 1) + special.xlogy(j, at) + special.xlog1py(n - j, -at)
    return np.exp(logarithm) @ scaling(bands)


def lagrange(eigenvalues: Float[np.ndarray, " bands"]) -> Float64[np.ndarray, "bands terms"]:
    """Compute the Chebyshev coefficients of Π_{i≠j} (λ - λ_i)/(λ_j - λ_i), one row per λ_j: a partition of unity.

    At the distinct eigenvalues, including the 0 of the null space,

        pairs = eigenpairs(operator)
        eigenvalues = np.append(0, pairs.values[np.unique(pairs.space)])

    f_j(Δ) is the D-orthogonal projection onto an eigenspace (Sohn et al., eq. 8-10), and c² = ⟨f_j(Δ)x, x⟩_D is the
    energy of x there, for all eigenspaces at once
    `lagrange(eigenvalues) @ cross_moments(operator, x, x, degree=len(eigenvalues) - 1)`. At the zeros of a Chebyshev
    polynomial, `nodes`, these are the polynomials of `scaling`.

    The degree is the number of eigenvalues less one, and between crowded eigenvalues the polynomials are huge, so this
    is for spectra of a dozen eigenvalues: the rounding error is that of the dtype times the polynomials' size. The
    factors of `product.lagrange_factors` mostly round less, but make no larger spectrum feasible.

    Args:
        eigenvalues: λ `[bands]`, distinct, in [0, 2]; rows are in their order.

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


def intervals(
    edges: Float[np.ndarray, " edges"], terms: int, *, damping: Damping = "jackson"
) -> Float64[np.ndarray, "bands terms"]:
    """Compute truncated, damped Chebyshev series of the indicators of [edges_j, edges_{j+1}], one row per band.

    With λ - 1 = cos φ an indicator is a cosine series, c_0 = (φ_j - φ_{j+1})/π and
    c_k = 2 (sin kφ_j - sin kφ_{j+1})/(πk). If the edges reach from 0 to 2, the bands are a partition of unity.
    Jackson's damping keeps them within [0, 1], and blurs an edge by about 1/terms in the angle φ.

    Args:
        edges: λ `[bands + 1]`, ascending in [0, 2].
        terms: number of terms, degree + 1.
        damping: name of the `damping_factors`.
    """
    if len(edges) < 2 or edges[0] < 0 or edges[-1] > 2 or not (np.diff(edges) > 0).all():
        raise JaxmarkError(f"intervals needs two edges or more that ascend within [0, 2], got {edges}.")
    angles = np.arccos(edges - 1)
    k = np.arange(1, terms)
    sines = np.column_stack([angles, 2 * np.sin(np.outer(angles, k)) / k]) / np.pi
    return -np.diff(sines, axis=0) * damping_factors(damping, terms)


def equal_edges(moments: Float[Array | np.ndarray, " terms"], bands: int) -> Float64[np.ndarray, " edges"]:
    """Compute edges that divide a spectral measure into equal parts, by the kernel polynomial method.

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
