"""Jamming: noise in the bands that carry marks."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from jaxmark.attacks.extent import displace_by
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.bands import scaling
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Operator
from jaxmark.watermark.schemes.keyed import DERIVED, KeyedScheme


def jamming(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add noise that looks like a mark of the default scheme under a key of the attacker's own.

    White normal noise is filtered by the bands of the scheme, each with its strength. Of all noise of its size, this
    hides a mark best from a reader who knows no more than the attacker does.

    Args:
        mesh: any mesh, its faces concrete; boundary vertices move as all others do.
        strength: root mean square of the vertices' displacements, relative to the diagonal of the bounding box; met
            exactly.
        key: a JAX random key.

    Returns:
        The jammed mesh. Differentiable with respect to vertices and strength, in reverse mode.
    """
    vertices = jnp.asarray(mesh.vertices)
    noise = jax.random.normal(key, vertices.shape, vertices.dtype)
    return displace_by(mesh, through_bands(from_mesh(mesh), noise), strength)


def through_bands(operator: Operator, noise: Float[Array, "vertices columns"]) -> Float[Array, "vertices columns"]:
    """Filter noise by the bands of the default scheme, each with its strength: how a mark looks to a stranger.

    Args:
        operator: the Laplacian of the mesh.
        noise: columns to filter; white noise becomes noise with the covariance of a mark, up to a factor.
    """
    return filter(operator, _coefficients().astype(noise.dtype), noise)


def _coefficients() -> Float64[np.ndarray, " terms"]:
    """Chebyshev coefficients of the bands' sum, each band times its strength."""
    return np.array(DERIVED) @ scaling(KeyedScheme.bands, damping="jackson")[: len(DERIVED)]
