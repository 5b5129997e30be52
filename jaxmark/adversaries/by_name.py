"""Attacks by their names: those of `jaxmark.attacks`, and three that know which bands are marked, but not the key.

These three are a low-pass filter, a band-stop filter, and jamming: noise in the bands that carry marks. Frequencies λ
in [0, 2] are those of the graph Laplacian. The filters are polynomials of degree 64 with Jackson damping: they do not
overshoot, and blur an edge at λ = 1 - cos φ by about 0.05 in φ, so that narrower bands are weakened and not removed.
They are 1 at λ = 0, so that the mean position of each component, weighted by valence, stays. All vertices that faces
use move, those on a boundary too. All three are differentiable with respect to vertices in reverse mode.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64

from jaxmark.attacks import attack as application
from jaxmark.attacks.attack import Attack, Registry, surface_attack
from jaxmark.attacks.support import Strength, centred, displace, displace_by
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.seeds import Seed, random_key
from jaxmark.spectral.bands import intervals, scaling
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Operator
from jaxmark.watermark.schemes.keyed import DERIVED, KeyedScheme

_CHEBYSHEV_TERMS = 65
_MAX_LAMBDA = 2.0  # upper end of the spectrum
_SHAPE_LAMBDA = 0.02  # lower frequencies carry the shape of a mesh, and hardly anything of a mark


def low_pass(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Remove the upper end of the spectrum.

    The strength is the share of the spectrum [0, 2] that is removed from the top, in [0, 1): 0.5 keeps λ < 1; static.
    """
    if not 0 <= strength < 1:
        raise JaxmarkError(f"A share of the spectrum to remove is in [0, 1), got {strength:g}.")
    return _remove(mesh, _MAX_LAMBDA * (1 - strength), _MAX_LAMBDA)


def band_stop(mesh: Mesh, strength: float, seed: Seed | None = None) -> Mesh:
    """Remove the band [0.02, 0.02 + strength] of λ: the low frequencies above those of the shape, where marks are.

    The strength is in [0, 1.98]; static. 0.42 covers the bands that the default scheme writes in. A mesh of a thousand
    vertices or fewer has some of its shape above 0.02, and loses that part.
    """
    if not 0 <= strength <= _MAX_LAMBDA - _SHAPE_LAMBDA:
        raise JaxmarkError(f"The width of a stop band is in [0, {_MAX_LAMBDA - _SHAPE_LAMBDA:g}], got {strength:g}.")
    return _remove(mesh, _SHAPE_LAMBDA, _SHAPE_LAMBDA + strength)


def jamming(mesh: Mesh, strength: Strength, seed: Seed) -> Mesh:
    """Add noise with the spectrum of a mark of the default scheme.

    White normal noise is filtered by the bands of the scheme, each with its strength. Against a reader that knows no
    more than the attacker, no other noise of the same size hides a mark better. The strength is the RMS displacement of
    the vertices, relative to the diagonal of the bounding box, and is met exactly. The attack is also differentiable
    with respect to the strength.
    """
    vertices = jnp.asarray(mesh.vertices)
    noise = jax.random.normal(random_key(seed), vertices.shape, vertices.dtype)
    return displace_by(mesh, through_bands(from_mesh(mesh), noise), strength)


def through_bands(operator: Operator, noise: Float[Array, "vertices columns"]) -> Float[Array, "vertices columns"]:
    """Filter noise by the bands of the default scheme, each with its strength.

    White noise becomes noise with the covariance of marks of random keys, up to a factor.
    """
    # Chebyshev coefficients of the bands' sum, each band times its strength.
    coefficients = np.array(DERIVED) @ scaling(KeyedScheme.bands, damping="jackson")[: len(DERIVED)]
    return filter(operator, coefficients.astype(noise.dtype), noise)


def _remove(mesh: Mesh, low: float, high: float) -> Mesh:
    """Remove the frequencies in [low, high] from a mesh."""
    start = centred(mesh)
    return displace(mesh, -filter(from_mesh(mesh), _removal_coefficients(low, high).astype(start.dtype), start))


def _removal_coefficients(low: float, high: float) -> Float64[np.ndarray, " terms"]:
    """Return the Chebyshev coefficients of the removed part: about 1 between low and high, and exactly 0 at λ = 0."""
    if low >= high:
        return np.zeros(_CHEBYSHEV_TERMS)
    bands = intervals(np.unique([0.0, low, high, _MAX_LAMBDA]), _CHEBYSHEV_TERMS)
    kept = np.eye(_CHEBYSHEV_TERMS)[0] - bands[1]
    return np.eye(_CHEBYSHEV_TERMS)[0] - kept / (kept[::2].sum() - kept[1::2].sum())


_REGISTRY = Registry(
    {
        **application.ATTACKS,
        "low-pass": surface_attack(low_pass, "share of the spectrum, removed from the top", (0.3, 0.5, 0.7, 0.8, 0.9)),
        "band-stop": surface_attack(
            band_stop, "width in λ of the band that is removed, from 0.02 up", (0.02, 0.05, 0.1, 0.2, 0.4)
        ),
        "jamming": surface_attack(jamming, "RMS over the diagonal", (0.0001, 0.0002, 0.0005, 0.001, 0.002)),
    }
)
#: All attacks of the library, by the names that the command line uses.
ATTACKS: Mapping[str, Attack] = _REGISTRY.attacks
#: Apply an attack to a mesh; see `jaxmark.attacks.attack.Registry.attack`.
attack = _REGISTRY.attack
#: Apply an attack to a mesh once for each seed; see `jaxmark.attacks.attack.Registry.attack_each`.
attack_each = _REGISTRY.attack_each
#: Make one attack of several; see `jaxmark.attacks.attack.Registry.chain`.
chain = _REGISTRY.chain
#: Find an attack by its name; see `jaxmark.attacks.attack.Registry.get`.
get_attack = _REGISTRY.get
