"""Quantisation of coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, used_vertices


def quantisation(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Round coordinates to a uniform grid whose step along each axis is (max - min)/2^R.

    Args:
        mesh: any mesh, its faces concrete.
        strength: R, the bits per coordinate, a number in [1, 32]; static.
        key: not used; attacks share one signature.

    Returns:
        The rounded mesh; gradients pass straight through the rounding.

    Raises:
        JaxmarkError: if R is outside [1, 32].
    """
    if not 1 <= strength <= 32:
        raise JaxmarkError(f"Quantisation takes 1 to 32 bits per coordinate, got {strength}.")
    vertices = jnp.asarray(mesh.vertices)
    used = used_vertices(mesh)
    surface = vertices[np.flatnonzero(used)]
    low = surface.min(axis=0)
    step = (surface.max(axis=0) - low) / float(2**strength)
    # Along an axis of zero extent there is nothing to round.
    rounds = used[:, None] & (step > 0)
    rounded = jnp.where(rounds, low + step * jnp.round((vertices - low) / jnp.where(step > 0, step, 1)), vertices)
    return Mesh(vertices + jax.lax.stop_gradient(rounded - vertices), mesh.faces)
