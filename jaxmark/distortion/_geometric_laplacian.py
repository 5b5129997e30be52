"""The geometric Laplacian, and the metric GL.

Reference: Karni, Gotsman, "Spectral compression of mesh geometry", SIGGRAPH 2000, section 5.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.distortion.displacement import rms


@jax.jit
def geometric_laplacian(
    x: Float[Array, "vertices 3"], edges: Int[Array | np.ndarray, "edges 2"]
) -> Float[Array, "vertices 3"]:
    """The geometric Laplacian v - Σ_j v_j/l_j / Σ_j 1/l_j of each vertex, over neighbours j at distances l_j.

    Edges of length 0 do not count; a vertex without other edges gets 0.
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
    """The mean of two RMS changes, that of positions and that of the geometric Laplacian.

    The paper divides the roots of sums of squares by the number of vertices. Here they are root mean squares, so that
    meshes with different numbers of vertices are comparable.

    Args:
        original: positions.
        distorted: positions of the same vertices.
        edges: from `jaxmark.geometry.mesh.edges`.

    Returns:
        The distortion, in the units of the positions.
    """
    change = geometric_laplacian(distorted, edges) - geometric_laplacian(original, edges)
    return jnp.asarray((rms(distorted - original) + rms(change)) / 2)
