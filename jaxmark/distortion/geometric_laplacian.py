"""The geometric Laplacian of Karni, Gotsman, "Spectral compression of mesh geometry", SIGGRAPH 2000, section 5."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.distortion.displacement import rms


@jax.jit
def geometric_laplacian(
    x: Float[Array, "vertices 3"], edges: Int[Array | np.ndarray, "edges 2"]
) -> Float[Array, "vertices 3"]:
    """How far each vertex stands out, v - Σ_j v_j/l_j / Σ_j 1/l_j over neighbours j at distances l_j; 0 if alone.

    Edges of length 0 count for nothing.
    """
    tail, head = edges[:, 0], edges[:, 1]
    square = jnp.sum((x[tail] - x[head]) ** 2, axis=1)
    weight = jnp.where(square > 0, jax.lax.rsqrt(jnp.where(square > 0, square, 1)), 0)[:, None]
    total = jnp.zeros((len(x), 1), x.dtype).at[tail].add(weight).at[head].add(weight)
    near = jnp.zeros_like(x).at[tail].add(weight * x[head]).at[head].add(weight * x[tail])
    return jnp.where(total > 0, x - near / jnp.where(total > 0, total, 1), 0)


@jax.jit
def gl(
    original: Float[Array, "vertices 3"],
    distorted: Float[Array, "vertices 3"],
    edges: Int[Array | np.ndarray, "edges 2"],
) -> Float[Array, ""]:
    """Half the RMS change of position and half that of the geometric Laplacian.

    The paper divides sums of squares' roots by the number of vertices; here they are root mean squares, so that meshes
    of different size compare.

    Args:
        original: positions.
        distorted: positions of the same vertices.
        edges: from `jaxmark.mesh.edges`.

    Returns:
        In the units of the positions.
    """
    change = geometric_laplacian(distorted, edges) - geometric_laplacian(original, edges)
    return jnp.asarray((rms(distorted - original) + rms(change)) / 2)
