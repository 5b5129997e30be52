"""Root mean square and maximum of the displacement of corresponding vertices."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def rms(displacement: Float[Array | np.ndarray, "vertices 3"]) -> Float[Array | np.ndarray, ""]:
    """Root mean square √(mean over v of |d_v|²), unweighted, in the units of `displacement`; the gradient at 0 is 0.

    A NumPy array gives a NumPy result, so that float64 stays float64 on the host.
    """
    xp = np if isinstance(displacement, np.ndarray) else jnp
    mean = xp.mean(xp.sum(displacement**2, axis=-1))
    # The root's slope at 0 is infinite: select before it.
    return xp.where(mean > 0, xp.sqrt(xp.where(mean > 0, mean, 1)), 0)


def maximum(displacement: Float[Array | np.ndarray, "vertices 3"]) -> Float[Array | np.ndarray, ""]:
    """Largest |d_v| over the vertices, in the units of `displacement`; the gradient at 0 is 0."""
    xp = np if isinstance(displacement, np.ndarray) else jnp
    largest = xp.max(xp.sum(displacement**2, axis=-1))
    return xp.where(largest > 0, xp.sqrt(xp.where(largest > 0, largest, 1)), 0)
