"""Quantisation of coordinates."""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh


def quantisation(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Round each coordinate to a uniform grid of steps (max - min)/2^R along each axis.

    Args:
        mesh: any mesh.
        strength: R, bits per coordinate, a number in [1, 32].
        key: not used; attacks share one signature.

    Returns:
        The rounded mesh; gradients pass straight through the rounding.

    Raises:
        JaxmarkError: if R is outside [1, 32].
    """
    if not 1 <= strength <= 32:
        raise JaxmarkError(f"Quantisation takes 1 to 32 bits per coordinate, got {strength}.")
    vertices = jnp.asarray(mesh.vertices)
    low = vertices.min(axis=0)
    step = (vertices.max(axis=0) - low) / 2**strength
    # A flat axis has nothing to round.
    rounded = jnp.where(step > 0, low + step * jnp.round((vertices - low) / jnp.where(step > 0, step, 1)), vertices)
    return Mesh(vertices + jax.lax.stop_gradient(rounded - vertices), mesh.faces)
