"""How cleanly a family separates a mesh into bands: the conditions of Sohn et al., section 3, in figures."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float64
from numpy.polynomial import chebyshev

from jaxmark.chebyshev import gram
from jaxmark.laplacian import Laplacian
from jaxmark.spectrum import quadrature


class FamilyReport(NamedTuple):
    """A family of bands on one signal of one mesh; all figures are dimensionless."""

    partition_error: float  # max over [0, 2] of |Σ_j f_j(λ) - 1|
    overshoot: Float64[np.ndarray, " bands"]  # per band: how far the response leaves [0, 1], over its largest value
    leakage: Float64[np.ndarray, " bands"]  # per band: share of ‖f_j x‖² from outside its pass band
    coherence_max: float  # ε of Condition 3: the largest |⟨x_i, x_j⟩_D| of unit components
    coherence_median: float


def report(
    operator: Laplacian,
    coefficients: Float64[np.ndarray, "bands terms"],
    x: Float64[np.ndarray, " vertices"],
    *,
    nodes: int | None = None,
) -> FamilyReport:
    """Measure a family on a mesh, on the host.

    The pass band of band j of B is where a partition into B bands, equally wide in the angle θ = arccos(1 - λ) as the
    scaling functions' nodes are, with one band's width to either side. Leakage takes the spectral measure of `x` by
    Gauss quadrature: exact as a whole, resolved to the spacing of the nodes at the edges of a pass band.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: one Chebyshev series per row, `[bands, degree + 1]`, by increasing frequency.
        x: one signal `[N]`, centred.
        nodes: of the quadrature; 4 · (degree + 1) by default, and exact from N on.

    Returns:
        The figures. A band without any energy has leakage 1 and takes no part in the coherence.
    """
    bands, terms = coefficients.shape
    responses = chebyshev.chebval(np.cos(np.linspace(0, np.pi, 16 * terms + 1)), coefficients.T)
    peak = np.abs(responses).max(axis=1)
    overshoot = np.maximum(responses.max(axis=1) - 1, -responses.min(axis=1)).clip(min=0) / peak

    measure = quadrature(operator, x, 4 * terms if nodes is None else nodes)
    angle = np.arccos(np.clip(1 - measure.nodes, -1, 1)) * bands / np.pi  # in band widths
    energy = measure.weights * chebyshev.chebval(measure.nodes - 1, coefficients.T) ** 2
    inside = np.abs(angle - (np.arange(bands)[:, None] + 0.5)) <= 1.5
    total = energy.sum(axis=1)
    alive = total > np.finfo(np.float64).eps ** 2 * measure.weights.sum()
    leakage = np.where(alive, (energy * ~inside).sum(axis=1) / np.where(alive, total, 1), 1.0)

    dtype = jax.dtypes.canonicalize_dtype(np.float64)
    products = np.asarray(gram(operator, coefficients, x.astype(dtype)), np.float64)
    norm = np.sqrt(np.diag(products))
    seen = norm > np.sqrt(len(x)) * np.finfo(dtype).eps * np.sqrt(measure.weights.sum())
    cosines = np.abs(products / np.where(seen, norm, np.inf) / np.where(seen, norm, np.inf)[:, None])
    pairs = cosines[np.triu_indices(bands, 1)][(seen & seen[:, None])[np.triu_indices(bands, 1)]]
    return FamilyReport(
        partition_error=float(np.abs(responses.sum(axis=0) - 1).max()),
        overshoot=overshoot,
        leakage=leakage,
        coherence_max=float(pairs.max(initial=0.0)),
        coherence_median=float(np.median(pairs)) if pairs.size else 0.0,
    )
