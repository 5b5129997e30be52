"""The visibility of displacements in each band of frequencies, by metrics of distortion."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark import distortion
from jaxmark.alignment.original import Original, displace
from jaxmark.distortion import Metric
from jaxmark.seeds import probe_signs
from jaxmark.spectral.chebyshev import filter
from jaxmark.watermark.perception.budget import reference_of
from jaxmark.watermark.perception.masking import apply_mask

_SAMPLED_BANDS = 16  # visibility varies smoothly from one band to the next
_FIRST_RMS = 1e-3  # displacement in diagonals that is tried first
_MAX_METRIC_VALUE = 0.1  # a metric may saturate at larger values


def band_visibility(
    original: Original,
    coefficients: Float64[np.ndarray, "bands terms"],
    metrics: Sequence[Metric],
    mask: Float[Array, " rows *axes"] | None = None,
) -> Float64[np.ndarray, "metrics bands"]:
    """Measure how much metrics increase per unit of RMS displacement (in diagonals) in each band, with random signs.

    The metrics are measured in 16 bands, which are denser at low frequencies, and interpolated between them.

    Args:
        original: the mesh that is displaced.
        coefficients: Chebyshev coefficients of the bands.
        metrics: names in `distortion.METRICS`, or functions of your own.
        mask: mask of the displacements, see `apply_mask`.

    Returns:
        `[metrics, bands]`, in the units of each metric per diagonal.

    Raises:
        JaxmarkError: see `distortion.measure`.
    """
    (signs,) = probe_signs("visibility", original.signal.shape, dtype=original.signal.dtype)
    signs = signs * original.to_traced(original.used)[:, None]
    count = len(coefficients)
    candidates = np.unique(np.round(np.geomspace(1, count, min(_SAMPLED_BANDS, count))).astype(int)) - 1
    values = []
    for band in candidates:
        shift = original.to_host(apply_mask(mask, filter(original.operator, coefficients[band], signs)))
        size = float(distortion.rms(shift[original.used]))
        # A band beyond the mesh's spectrum is empty.
        column = _per_rms(original, shift / size, metrics) if size > 1e-6 else [np.inf] * len(metrics)
        values.append(column)
    table = np.array(values).T
    logs = [
        np.interp(
            np.log(np.arange(count) + 1.0), np.log(candidates[np.isfinite(row)] + 1.0), np.log(row[np.isfinite(row)])
        )
        for row in np.maximum(table, 1e-12)
    ]
    return np.exp(np.array(logs))


def _per_rms(original: Original, shift: Float64[np.ndarray, "points 3"], metrics: Sequence[Metric]) -> list[float]:
    """Measure metrics per unit of RMS displacement, at so small a displacement that they are proportional to it."""
    reference = reference_of(original)

    def measure_at(names: Sequence[Metric], size: float) -> dict[Metric, float]:
        measured = reference.measure(displace(original, size * shift), names)
        return {name: (value or 0.0) / size for name, value in measured.items()}

    values = measure_at(metrics, _FIRST_RMS)
    for name, value in values.items():
        if value * _FIRST_RMS > _MAX_METRIC_VALUE:
            values |= measure_at([name], _MAX_METRIC_VALUE / 2 / value)
    return list(values.values())
