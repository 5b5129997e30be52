"""How visible a displacement is: in each band of frequencies by a metric of distortion, at each vertex by masking."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark import distortion
from jaxmark.alignment.original import Original, displace
from jaxmark.distortion import Metric
from jaxmark.distortion.roughness import MAX_ROUGHNESS, MIN_ROUGHNESS, POWER
from jaxmark.geometry.mesh import check_faces
from jaxmark.spectral.bands import diffusion
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.probes import probe_signs

_SAMPLED_BANDS = 16  # visibility varies smoothly from one band to the next
_FIRST_RMS = 1e-3  # displacement in diagonals that is tried first
_MAX_METRIC_VALUE = 0.1  # a metric may saturate at larger values
_AVERAGING_SCALE = 5  # roughness is averaged over 2^5 steps of diffusion


def band_visibility(
    original: Original,
    coefficients: Float64[np.ndarray, "bands terms"],
    metrics: Sequence[Metric],
    mask: Float[Array, " rows *axes"] | None = None,
) -> Float64[np.ndarray, "metrics bands"]:
    """Measure how much metrics rise per unit of RMS displacement (in diagonals) in each band, with random signs.

    They are measured in 16 bands, denser at low frequencies, and interpolated between them.

    Args:
        original: the mesh that is displaced.
        coefficients: Chebyshev coefficients of the bands.
        metrics: names in `distortion.METRICS`, or functions of your own.
        mask: of the displacements, see `apply_mask`.

    Returns:
        `[metrics, bands]`, in the units of each metric per diagonal.

    Raises:
        JaxmarkError: see `distortion.measure`.
    """
    (signs,) = probe_signs("visibility", original.signal.shape, dtype=original.signal.dtype)
    signs = signs * original.to_traced(original.used)[:, None]
    count = len(coefficients)
    tried = np.unique(np.round(np.geomspace(1, count, min(_SAMPLED_BANDS, count))).astype(int)) - 1
    values = []
    for band in tried:
        shift = original.to_host(apply_mask(mask, filter(original.operator, coefficients[band], signs)))
        size = float(distortion.rms(shift[original.used]))
        # A band beyond the mesh's spectrum is empty.
        found = _per_rms(original, shift / size, metrics) if size > 1e-6 else [np.inf] * len(metrics)
        values.append(found)
    known = np.array(values).T
    logs = [
        np.interp(np.log(np.arange(count) + 1.0), np.log(tried[np.isfinite(row)] + 1.0), np.log(row[np.isfinite(row)]))
        for row in np.maximum(known, 1e-12)
    ]
    return np.exp(np.array(logs))


def _per_rms(original: Original, shift: Float64[np.ndarray, "points 3"], metrics: Sequence[Metric]) -> list[float]:
    """Metrics per unit of RMS displacement, at a displacement so small that they are proportional to it."""
    reference = distortion.Reference(original.mesh)

    def measure_at(names: Sequence[Metric], size: float) -> dict[Metric, float]:
        found = reference.measure(displace(original, size * shift), names)
        return {name: (value or 0.0) / size for name, value in found.items()}

    values = measure_at(metrics, _FIRST_RMS)
    for name, value in values.items():
        if value * _FIRST_RMS > _MAX_METRIC_VALUE:
            values |= measure_at([name], _MAX_METRIC_VALUE / 2 / value)
    return list(values.values())


def apply_mask(
    mask: Float[Array | np.ndarray, " rows *axes"] | None, x: Float[Array, "rows 3"]
) -> Float[Array, "rows 3"]:
    """Mask displacements by a factor or a symmetric matrix `[3, 3]` for each vertex; this is its own adjoint."""
    if mask is None:
        return x
    factor = jnp.asarray(mask)
    if factor.ndim == 1:
        return factor[:, None] * x
    return matmul(factor, x[:, :, None])[:, :, 0]


def masking(original: Original) -> Float[Array, " rows"]:
    """Relative displacement that each vertex hides: roughness^0.15, averaged over its surroundings, of RMS 1.

    Rough regions hide displacement that is visible in smooth ones. The model is that of FMPD (Wang, Torkhani,
    Montanvert, "A fast roughness-based approach to the assessment of 3D mesh visual quality", Computers & Graphics
    36(7), 2012): local roughness, clipped to 5e-4 … 0.2, raised to the power 0.15.

    Raises:
        JaxmarkError: if the original is a point cloud.
    """
    check_faces("Masking by roughness", original.points)
    positions = jnp.asarray(original.positions, original.signal.dtype)
    rough = distortion.local_roughness(positions, np.asarray(original.points.faces)).roughness
    hidden = np.where(original.used, np.clip(np.asarray(rough), MIN_ROUGHNESS, MAX_ROUGHNESS) ** POWER, 0)
    # Roughness is averaged, so that masking does not turn low frequencies of the mark into high ones.
    average = diffusion(_AVERAGING_SCALE + 1, 2**_AVERAGING_SCALE + 1)[_AVERAGING_SCALE]
    averaged = jnp.where(original.moving, filter(original.operator, average, original.to_traced(hidden)), 0)
    return averaged / jnp.sqrt(jnp.sum(averaged**2) / int(original.used.sum()))
