"""Change of edges' lengths: what a displacement along the surface does to a mesh, and to textures on it."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.distortion.percentiles import percentile
from jaxmark.distortion.roots import root

SHARE = 0.99  # share of the edges that change less


@jax.jit
def stretch(
    original: Float[Array, "vertices 3"],
    distorted: Float[Array, "vertices 3"],
    edges: Int[Array | np.ndarray, "edges 2"],
    share: float | Float[Array, ""] = SHARE,
) -> Float[Array, ""]:
    """The change of length that 1 % of the edges exceed, over the length that each has in the original.

    Args:
        original: positions.
        distorted: positions of the same vertices.
        edges: pairs of vertices, as by `jaxmark.geometry.mesh.edges`; those of no length do not count.
        share: share of the edges that change less; the gradient is that of the edge at this percentile.
    """
    before, after = (root(jnp.sum((x[edges[:, 0]] - x[edges[:, 1]]) ** 2, axis=1)) for x in (original, distorted))
    sound = before > 0
    change = jnp.where(sound, jnp.abs(after - before) / jnp.where(sound, before, 1), 0)
    return percentile(change, sound.astype(change.dtype), share)
