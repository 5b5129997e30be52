"""Filters of the spectrum: what somebody does who knows which bands are marked.

Spectra are those of the graph Laplacian, λ in [0, 2]. The polynomials are of degree 64 with Jackson's damping: they do
not overshoot, and blur an edge at λ = 1 - cos φ by about 0.05 in φ; narrower bands are weakened, not removed. They are
1 at λ = 0: the mean position of each component, weighted by valence, stays. All vertices that faces use are filtered,
those on a boundary too.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64, PRNGKeyArray

from jaxmark.attacks.extent import displaced, surface
from jaxmark.bands import intervals
from jaxmark.chebyshev import filter
from jaxmark.errors import JaxmarkError
from jaxmark.laplacian import make_laplacian
from jaxmark.mesh import Mesh, used_vertices

_TERMS = 65
_TOP = 2.0  # of the spectrum
_SHAPE = 0.02  # λ below which a mesh has its shape, and a mark next to nothing


def low_pass(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Remove the upper end of the spectrum.

    Args:
        mesh: any mesh, its faces concrete.
        strength: share of the interval [0, 2] of λ that is removed, from the top, in [0, 1): 0.5 keeps λ < 1; static.
        key: not used; attacks share one signature.

    Returns:
        The filtered mesh. Differentiable with respect to vertices, in reverse mode.

    Raises:
        JaxmarkError: if the share is outside [0, 1).
    """
    if not 0 <= strength < 1:
        raise JaxmarkError(f"A share of the spectrum to remove is in [0, 1), got {strength:g}.")
    return _without(mesh, _TOP * (1 - strength), _TOP)


def band_stop(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Remove the band [0.02, 0.02 + strength] of λ: low frequencies, where marks are, but for those of the shape.

    A mesh of a thousand vertices or fewer has some of its shape above 0.02, and loses that.

    Args:
        mesh: any mesh, its faces concrete.
        strength: width of the band in λ, in [0, 1.98]; static. 0.42 takes what the default scheme writes in.
        key: not used; attacks share one signature.

    Returns:
        The filtered mesh. Differentiable with respect to vertices, in reverse mode.

    Raises:
        JaxmarkError: if the band is wider than what there is above 0.02.
    """
    if not 0 <= strength <= _TOP - _SHAPE:
        raise JaxmarkError(f"The width of a stop band is in [0, {_TOP - _SHAPE:g}], got {strength:g}.")
    return _without(mesh, _SHAPE, _SHAPE + strength)


def _without(mesh: Mesh, low: float, high: float) -> Mesh:
    """The mesh without what lies in [low, high]."""
    vertices, used = jnp.asarray(mesh.vertices), used_vertices(mesh)
    # Only the difference from the middle is filtered: the position does not eat its digits.
    start = jnp.where(used[:, None], vertices - surface(mesh).mean(axis=0), 0)
    removed = filter(make_laplacian(mesh), _removing(low, high).astype(vertices.dtype), start)
    return displaced(mesh, -removed)


def _removing(low: float, high: float) -> Float64[np.ndarray, " terms"]:
    """Chebyshev coefficients of what is removed: 1 between low and high, and 0 at λ = 0."""
    if low >= high:
        return np.zeros(_TERMS)
    bands = intervals(np.unique([0.0, low, high, _TOP]), _TERMS)
    kept = np.eye(_TERMS)[0] - bands[1]
    return np.eye(_TERMS)[0] - kept / (kept[::2].sum() - kept[1::2].sum())
