"""Spectral filters: attacks by somebody who knows which bands are marked.

Frequencies λ in [0, 2] are those of the graph Laplacian. The filters are polynomials of degree 64 with Jackson damping:
they do not overshoot, and blur an edge at λ = 1 - cos φ by about 0.05 in φ, so that narrower bands are weakened and not
removed. They are 1 at λ = 0, so that the mean position of each component, weighted by valence, stays. All vertices that
faces use are filtered, those on a boundary too.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, PRNGKeyArray

from jaxmark.attacks.extent import displace, surface
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.spectral.bands import intervals
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.graphs import from_mesh

_CHEBYSHEV_TERMS = 65
_MAX_LAMBDA = 2.0  # upper end of the spectrum
_SHAPE_LAMBDA = 0.02  # below it lies the shape of a mesh, and next to nothing of a mark


def low_pass(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Remove the upper end of the spectrum.

    Args:
        mesh: any mesh, its faces concrete.
        strength: share of the spectrum [0, 2] that is removed from the top, in [0, 1): 0.5 keeps λ < 1; static.
        key: not used; attacks share one signature.

    Returns:
        The filtered mesh. Differentiable with respect to vertices, in reverse mode.

    Raises:
        JaxmarkError: if the share is outside [0, 1).
    """
    if not 0 <= strength < 1:
        raise JaxmarkError(f"A share of the spectrum to remove is in [0, 1), got {strength:g}.")
    return _remove(mesh, _MAX_LAMBDA * (1 - strength), _MAX_LAMBDA)


def band_stop(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Remove the band [0.02, 0.02 + strength] of λ: the low frequencies above those of the shape, where marks are.

    A mesh of a thousand vertices or fewer has some of its shape above 0.02, and loses that part.

    Args:
        mesh: any mesh, its faces concrete.
        strength: width of the band in λ, in [0, 1.98]; static. 0.42 covers the bands that the default scheme writes in.
        key: not used; attacks share one signature.

    Returns:
        The filtered mesh. Differentiable with respect to vertices, in reverse mode.

    Raises:
        JaxmarkError: if the width is outside [0, 1.98].
    """
    if not 0 <= strength <= _MAX_LAMBDA - _SHAPE_LAMBDA:
        raise JaxmarkError(f"The width of a stop band is in [0, {_MAX_LAMBDA - _SHAPE_LAMBDA:g}], got {strength:g}.")
    return _remove(mesh, _SHAPE_LAMBDA, _SHAPE_LAMBDA + strength)


def _remove(mesh: Mesh, low: float, high: float) -> Mesh:
    """Remove the frequencies in [low, high] from a mesh."""
    vertices, used = jnp.asarray(mesh.vertices), used_vertices(mesh)
    # Positions are filtered relative to their mean, so that a distant mesh loses no digits.
    start = jnp.where(used[:, None], vertices - surface(mesh).mean(axis=0), 0)
    removed = filter(from_mesh(mesh), _removal_coefficients(low, high).astype(vertices.dtype), start)
    return displace(mesh, -removed)


def _removal_coefficients(low: float, high: float) -> Float64[np.ndarray, " terms"]:
    """Chebyshev coefficients of the removed part: about 1 between low and high, and exactly 0 at λ = 0."""
    if low >= high:
        return np.zeros(_CHEBYSHEV_TERMS)
    bands = intervals(np.unique([0.0, low, high, _MAX_LAMBDA]), _CHEBYSHEV_TERMS)
    kept = np.eye(_CHEBYSHEV_TERMS)[0] - bands[1]
    return np.eye(_CHEBYSHEV_TERMS)[0] - kept / (kept[::2].sum() - kept[1::2].sum())
