"""Frames: banks of filters whose parts determine the signal, and the inverse of such a bank.

The parts g_j(Δ)x of a signal have the energy Σ_j ‖g_j(Δ)x‖² = ⟨x, G(Δ)x⟩_M with G = Σ_j g_j², between A‖x‖² and B‖x‖²
where A ≤ G ≤ B on [0, 2]. If A > 0 the bank is a frame: different signals have different parts. Reference: Hammond,
Vandergheynst, Gribonval, "Wavelets on graphs via spectral graph theory", 2011.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.signal import fftconvolve
from jaxtyping import Array, Float, Float64
from scipy import fft

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.chebyshev import Bank, check_parts, filter, synthesise
from jaxmark.spectral.laplacian import Operator
from jaxmark.spectral.recurrence import inner_mass, solve

_POINTS_PER_DEGREE = 256  # which bound a polynomial to 2e-5 of its range
_MAX_DEGREE = 2**13  # of the filters of a tight frame
_MAX_ITERATIONS = 10_000  # enough for float64 where A/B = 1e-5, the smallest that frame_bounds resolves


def frame_bounds(coefficients: Bank) -> tuple[float, float]:
    """Compute bounds A ≤ Σ_j g_j(λ)² ≤ B on [0, 2] of a bank `[bands, degree + 1]`, on the host.

    They hold for certain, up to rounding: a polynomial of degree n is evaluated at the M = 256 n zeros of T_M, and is
    nowhere further from the middle of these values than half their range over cos(πn/2M) (Ehlich, Zeller, "Schwankung
    von Polynomen zwischen Gitterpunkten", 1964). They are off by less than 1e-5 (B - A) from the best bounds. A is 0 if
    the bank is not shown to be a frame.
    """
    c = _matrix("frame_bounds", coefficients)
    degree = 2 * (c.shape[1] - 1)
    points = _POINTS_PER_DEGREE * max(degree, 1)
    power = sum(_at_nodes(row, points) ** 2 for row in c)
    low, high = float(np.min(power)), float(np.max(power))
    middle, radius = (low + high) / 2, (high - low) / 2 / math.cos(math.pi * degree / (2 * points))
    return max(middle - radius, 0.0), middle + radius


def tight(coefficients: Bank, *, tolerance: float = 1e-6) -> Float64[np.ndarray, "bands more_terms"]:
    """Divide a bank's filters by √(Σ_j g_j²), so that `synthesise` inverts `band_components`.

    The quotients are no polynomials. They are interpolated, by degrees that double from the bank's own on until the
    frame bounds are within `tolerance` of 1; the closer A is to 0, the higher the degree.

    Args:
        coefficients: a frame, `[bands, degree + 1]`.
        tolerance: largest |Σ_j g_j² - 1| over [0, 2] of the new filters.

    Raises:
        JaxmarkError: if the bank is no frame, or a degree above 8192 would be needed.
    """
    c = _matrix("tight", coefficients)
    _check_frame("tight", c)
    degree = max(c.shape[1] - 1, 1)
    while degree <= _MAX_DEGREE:
        values = np.stack([_at_nodes(row, degree + 1) for row in c])
        found = fft.dct(values / np.sqrt((values**2).sum(axis=0)), axis=1) / (degree + 1)
        found[:, 0] /= 2
        lower, upper = frame_bounds(found)
        if max(1 - lower, upper - 1) <= tolerance:
            return found
        degree *= 2
    raise JaxmarkError(f"A tight frame of this bank needs a degree above {_MAX_DEGREE}; allow a larger tolerance.")


def inverse(
    operator: Operator, coefficients: Bank, parts: Float[Array | np.ndarray, "bands vertices *columns"]
) -> Float[Array, " vertices *columns"]:
    """Recover the signal from its parts: x with g_j(Δ)x = y_j, or as close as any signal comes to changed parts.

    It minimises Σ_j ‖g_j(Δ)x - y_j‖² in the M-norm: G(Δ)x = Σ_j g_j(Δ)y_j with G = Σ_j g_j², by conjugate gradients.
    Each iteration is one `filter` of twice the bank's degree; there are about √(B/A)/2 · ln(2/eps), for all columns
    together, with the `frame_bounds` A and B and the dtype's eps. The error is about B/A times eps. Derivatives with
    respect to the parts, in all modes, come by implicit differentiation.

    Args:
        operator: the Laplacian, of N vertices.
        coefficients: a frame, `[bands, degree + 1]`. It is checked unless it is traced; **a traced bank must be a
            frame**.
        parts: `[bands, N]` or `[bands, N, C]`.

    Returns:
        x, `[N]` or `[N, C]`, in the dtype of the parts.

    Raises:
        JaxmarkError: if shapes do not fit, the parts are not floating, or the bank is no frame.
    """
    parts = jnp.asarray(parts)
    check_parts("inverse", operator, coefficients, parts)
    if not isinstance(coefficients, Tracer):
        _check_frame("inverse", np.asarray(coefficients, np.float64))
    return _inverse(operator, jnp.asarray(coefficients).astype(parts.dtype), parts)


@jax.jit
def _inverse(operator: Operator, c: Array, parts: Array) -> Array:
    power, right = _power(c), synthesise(operator, c, parts)
    mass = inner_mass(operator, right)
    return solve(lambda x: filter(operator, power, x), right, mass, _MAX_ITERATIONS)


def _power(c: Array) -> Array:
    """Compute the Chebyshev series of Σ_j g_j², of twice the degree, by squaring cosine series as Laurent series."""
    laurent = jnp.concatenate([c[:, :0:-1] / 2, c[:, :1], c[:, 1:] / 2], axis=1)
    square = fftconvolve(laurent, laurent, axes=[1]).sum(axis=0)[2 * (c.shape[1] - 1) :]
    return jnp.concatenate([square[:1], 2 * square[1:]])


def _at_nodes(row: np.ndarray, points: int) -> Float64[np.ndarray, " points"]:
    """Evaluate a Chebyshev series of at most `points` terms at the zeros of T_points, by decreasing λ."""
    return np.asarray(fft.dct(np.concatenate([row[:1], row[1:] / 2]), type=3, n=points))


def _matrix(name: str, coefficients: Bank) -> Float64[np.ndarray, "bands terms"]:
    c = np.asarray(coefficients, np.float64)
    if c.ndim != 2 or 0 in c.shape:
        raise JaxmarkError(f"{name} needs coefficients [bands, degree + 1], got {c.shape}.")
    return c


def _check_frame(name: str, c: np.ndarray) -> None:
    lower, upper = frame_bounds(c)
    if not lower > 0:
        raise JaxmarkError(
            f"{name} needs a frame, but the filters' squares fall to 0 or nearly so of {upper:.3g} somewhere in [0, 2]:"
            " add a band for the frequencies that none of them keeps."
        )
