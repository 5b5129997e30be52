"""Displacement of corresponding vertices: root mean square and maximum of its length."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def rms(displacement: Float[Array | np.ndarray, "vertices 3"]) -> Float[Array | np.ndarray, ""]:
    """√(mean over vertices of |d_v|²), unweighted, in the units of `displacement`; gradient 0 where all is 0.

    NumPy in, NumPy out: float64 stays float64 on the host.
    """
    xp = np if isinstance(displacement, np.ndarray) else jnp
    mean = xp.mean(xp.sum(displacement**2, axis=-1))
    # The root's slope at 0 is infinite: select before it.
    return xp.where(mean > 0, xp.sqrt(xp.where(mean > 0, mean, 1)), 0)


def maximum(displacement: Float[Array | np.ndarray, "vertices 3"]) -> Float[Array | np.ndarray, ""]:
    """Largest |d_v| over the vertices, in the units of `displacement`; gradient 0 where all is 0."""
    xp = np if isinstance(displacement, np.ndarray) else jnp
    largest = xp.max(xp.sum(displacement**2, axis=-1))
    return xp.where(largest > 0, xp.sqrt(xp.where(largest > 0, largest, 1)), 0)
