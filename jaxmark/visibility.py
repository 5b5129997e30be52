"""How visible displacement is: per band of frequencies by a metric of distortion, per vertex by masking."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark import distortion
from jaxmark.bands import diffusion
from jaxmark.chebyshev import filter
from jaxmark.distortion import Metric
from jaxmark.distortion.roughness import LEAST, MOST, POWER
from jaxmark.mesh import welded_mesh
from jaxmark.original import Original, displaced

_SAMPLES = 16  # bands tried; visibility varies smoothly from one to the next
_TRIED = 1e-3  # RMS displacement that is tried first
_LARGE = 0.1  # values of a metric from which on it may saturate
_SCALE = 5  # roughness is averaged over 2^5 steps of diffusion


def band_visibility(
    original: Original, coefficients: Float64[np.ndarray, "bands terms"], metrics: Sequence[Metric]
) -> Float64[np.ndarray, "metrics bands"]:
    """How far metrics rise for each unit of RMS displacement (in diagonals) in each band, by trial with random signs.

    Tried on 16 bands, denser at low frequencies, and interpolated between them.

    Args:
        original: the original.
        coefficients: of the bands.
        metrics: names in `distortion.METRICS`, or functions of your own.

    Raises:
        JaxmarkError: see `distortion.measure`.
    """
    signs = jax.random.rademacher(jax.random.key(4), original.signal.shape, original.signal.dtype)
    signs = signs * original.traced(original.used)[:, None]
    count = len(coefficients)
    tried = np.unique(np.round(np.geomspace(1, count, min(_SAMPLES, count))).astype(int)) - 1
    values = []
    for band in tried:
        shift = original.on_host(filter(original.operator, coefficients[band], signs))
        size = float(distortion.rms(shift[original.used]))
        # Beyond the mesh's spectrum there is nothing to see.
        found = _per_rms(original, shift / size, metrics) if size > 1e-6 else [np.inf] * len(metrics)
        values.append(found)
    known = np.array(values).T
    logs = [
        np.interp(np.log(np.arange(count) + 1.0), np.log(tried[np.isfinite(row)] + 1.0), np.log(row[np.isfinite(row)]))
        for row in np.maximum(known, 1e-12)
    ]
    return np.exp(np.array(logs))


def _per_rms(original: Original, shift: Float64[np.ndarray, "points 3"], metrics: Sequence[Metric]) -> list[float]:
    """Metrics over RMS displacement, small enough that they are proportional to it."""

    def tried(names: Sequence[Metric], size: float) -> dict[Metric, float]:
        found = distortion.measure(original.mesh, displaced(original, size * shift), names)
        return {name: (value or 0.0) / size for name, value in found.items()}

    values = tried(metrics, _TRIED)
    for name, value in values.items():
        if value * _TRIED > _LARGE:
            values |= tried([name], _LARGE / 2 / value)
    return list(values.values())


def masking(original: Original) -> Float[Array, " rows"]:
    """How much displacement each vertex hides, relative to the others: roughness^0.15, averaged around it; of RMS 1.

    Rough regions hide what smooth ones show. The model is FMPD's (Wang, Torkhani, Montanvert, "A fast roughness-based
    approach to the assessment of 3D mesh visual quality", Computers & Graphics 36(7), 2012): local roughness from 5e-4
    to 0.2, raised to the power 0.15.
    """
    points = welded_mesh(original.mesh, original.weld)
    positions = jnp.asarray(original.positions, original.signal.dtype)
    rough = distortion.local_roughness(positions, np.asarray(points.faces)).roughness
    hidden = np.where(original.used, np.clip(np.asarray(rough), LEAST, MOST) ** POWER, 0)
    # Averaged, so that masking does not make high frequencies of low ones.
    average = diffusion(_SCALE + 1, 2**_SCALE + 1)[_SCALE]
    averaged = jnp.where(original.moving, filter(original.operator, average, original.traced(hidden)), 0)
    return averaged / jnp.sqrt(jnp.sum(averaged**2) / int(original.used.sum()))
