"""Noise where marks are."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, PRNGKeyArray

from jaxmark.attacks.extent import displaced_by
from jaxmark.bands import scaling
from jaxmark.chebyshev import filter
from jaxmark.laplacian import Operator, make_laplacian
from jaxmark.mesh import Mesh
from jaxmark.schemes import DERIVED, KeyedScheme


def jamming(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add what looks like a mark of the default scheme, by a key of the attacker's own.

    It is white normal noise through the bands of the scheme, in their strengths: of all noise of its size, what hides
    a mark best from a reader who knows no more than the attacker does.

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
    return displaced_by(mesh, through_bands(make_laplacian(mesh), noise), strength)


def through_bands(operator: Operator, noise: Float[Array, "vertices columns"]) -> Float[Array, "vertices columns"]:
    """Noise through the bands of the default scheme, in their strengths: what a mark looks like to a stranger.

    Args:
        operator: the Laplacian of the mesh.
        noise: any columns; white ones give the covariance of a mark, up to a factor.
    """
    return filter(operator, _shape().astype(noise.dtype), noise)


def _shape() -> Float64[np.ndarray, " terms"]:
    """Chebyshev coefficients of the sum of the bands."""
    return np.array(DERIVED) @ scaling(KeyedScheme.bands, damping="jackson")[: len(DERIVED)]
