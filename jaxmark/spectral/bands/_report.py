"""Measures of how well a family separates a mesh into bands, by the conditions of Sohn et al., section 3."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from numpy.polynomial import chebyshev

from jaxmark.spectral.spectrum import Quadrature

_GRID_POINTS = 4096  # on which responses that are functions are evaluated; polynomials take 16 points per term


class FamilyReport(NamedTuple):
    """Measures of a family of bands on one signal of one mesh, all dimensionless."""

    partition_error: float  # max over [0, 2] of |Σ_j f_j(λ) - 1|
    overshoot: Float64[np.ndarray, " bands"]  # how far each response leaves [0, 1], over its largest value
    leakage: Float64[np.ndarray, " bands"]  # share of each band's ‖f_j x‖² from outside its pass band
    coherence_max: float  # ε of Condition 3: the largest |⟨x_i, x_j⟩_D| of the normalised components of two bands
    coherence_median: float  # the median of the same


def report(
    measure: Quadrature,
    family: Float[np.ndarray, "bands terms"] | Callable[[np.ndarray], np.ndarray],
    *,
    edges: Float[np.ndarray, " edges"] | None = None,
) -> FamilyReport:
    """Measure a family on a signal, on the host.

    All figures follow from the signal's spectral measure, as ⟨f_i(Δ)x, f_j(Δ)x⟩_D is the integral of f_i f_j over it.
    Gauss quadrature is exact for this if the polynomials' degree is below the number of nodes; leakage is resolved to
    the spacing of the nodes at the edges of a pass band.

    Args:
        measure: `spectrum.quadrature` of one centred signal, with more nodes than the degree, better four times as
            many; the same one serves any number of families.
        family: one Chebyshev series per row, `[bands, degree + 1]`, by increasing frequency; or any responses, as a
            function from λ `[values]` to `[bands, values]`.
        edges: λ `[bands + 1]` where the bands meet; by default those of bands that are equally wide in the angle
            arccos(1 - λ), as scaling functions are. The pass band of a band is its own interval and both neighbours'.

    Returns:
        The figures. A band without any energy has leakage 1 and is excluded from the coherence.
    """
    if callable(family):
        responses, points = family, _GRID_POINTS
    else:
        responses, points = lambda values: chebyshev.chebval(values - 1, family.T), 16 * family.shape[1]
    shape = responses(1 - np.cos(np.linspace(0, np.pi, points + 1)))
    bands = len(shape)
    peak = np.abs(shape).max(axis=1)
    overshoot = np.maximum(shape.max(axis=1) - 1, -shape.min(axis=1)).clip(min=0) / peak

    edges = 1 - np.cos(np.linspace(0, np.pi, bands + 1)) if edges is None else edges
    first, last = edges[np.maximum(np.arange(bands) - 1, 0)], edges[np.minimum(np.arange(bands) + 2, bands)]
    inside = (measure.nodes >= first[:, None]) & (measure.nodes <= last[:, None])
    components = responses(measure.nodes) * np.sqrt(measure.weights)
    total = (components**2).sum(axis=1)
    alive = total > np.finfo(np.float64).eps ** 2 * measure.weights.sum()
    leakage = np.where(alive, (components**2 * ~inside).sum(axis=1) / np.where(alive, total, 1), 1.0)

    unit = components[alive] / np.sqrt(total[alive, None])
    pairs = np.abs(unit @ unit.T)[np.triu_indices(len(unit), 1)]
    return FamilyReport(
        partition_error=float(np.abs(shape.sum(axis=0) - 1).max()),
        overshoot=overshoot,
        leakage=leakage,
        coherence_max=float(pairs.max(initial=0.0)),
        coherence_median=float(np.median(pairs)) if pairs.size else 0.0,
    )
