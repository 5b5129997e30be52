"""Smoothing that preserves edges: the bilateral filter."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxmark.attacks.smoothing import inner_vertices, whole_steps
from jaxmark.distortion.norms import root
from jaxmark.geometry.mesh import Mesh, edges


def bilateral_smoothing(mesh: Mesh, strength: float, key: PRNGKeyArray | None = None) -> Mesh:
    """Move each vertex along its normal by a weighted mean of its neighbours' offsets in that direction.

    Fleishman, Drori, Cohen-Or, "Bilateral mesh denoising", SIGGRAPH 2003. With n the normal at v, h = n · (q - v) the
    offset of a neighbour q and r = |q - v|, v moves by n Σ w h / Σ w with w = exp(-r²/2σ_c²) exp(-h²/2σ_s²). Neighbours
    are joined by an edge. σ_c is the mean edge length and σ_s the root mean square of the offsets, both of the given
    mesh; normals are weighted by area and computed anew in each iteration. Boundary vertices stay.

    Args:
        mesh: any mesh, its faces concrete.
        strength: number of iterations, a whole number up to 100,000; static.
        key: not used; attacks share one signature.

    Returns:
        The smoothed mesh. Differentiable with respect to vertices.

    Raises:
        JaxmarkError: if the number of iterations is not a whole number from 0 to 100,000.
    """
    faces = np.asarray(mesh.faces)
    pairs = edges(faces)
    vertices, directed = jnp.asarray(mesh.vertices), np.concatenate([pairs, pairs[:, ::-1]])
    return Mesh(_smooth(vertices, faces, directed, inner_vertices(mesh), whole_steps(strength)), mesh.faces)


@partial(jax.jit, static_argnums=4)
def _smooth(
    vertices: Float[Array, "vertices 3"],
    faces: Int[Array | np.ndarray, "faces 3"],
    pairs: Int[Array | np.ndarray, "pairs 2"],
    moving: Array | np.ndarray,
    steps: int,
) -> Float[Array, "vertices 3"]:
    tail, head = pairs[:, 0], pairs[:, 1]

    def offsets(v: Array) -> tuple[Array, Array, Array]:
        """Vertex normals, squared lengths of the pairs, and offsets of the pairs."""
        normal, side = _vertex_normals(v, faces), v[head] - v[tail]
        return normal, jnp.sum(side**2, axis=1), jnp.sum(normal[tail] * side, axis=1)

    _, square, offset = offsets(vertices)
    spatial, spread = 2 * jnp.mean(root(square)) ** 2, 2 * jnp.mean(offset**2)
    flat = spread <= 0  # all offsets are zero, so nothing moves

    def step(v: Array, _: None) -> tuple[Array, None]:
        normal, square, offset = offsets(v)
        weight = jnp.exp(-square / spatial - offset**2 / jnp.where(flat, 1, spread))
        above, below = (jax.ops.segment_sum(x, tail, len(v)) for x in (weight * offset, weight))
        shift = above / jnp.where(below > 0, below, 1)
        return v + jnp.where(moving, shift[:, None] * normal, 0), None

    return jax.lax.scan(step, vertices, None, length=steps)[0]


def _vertex_normals(
    v: Float[Array, "vertices 3"], faces: Int[Array | np.ndarray, "faces 3"]
) -> Float[Array, "vertices 3"]:
    """Unit normals weighted by area, as `jaxmark.geometry.mesh.vertex_normals`, but traceable."""
    a, b, c = (v[faces[:, corner]] for corner in range(3))
    total = jax.ops.segment_sum(jnp.repeat(jnp.cross(b - a, c - a), 3, axis=0), faces.ravel(), len(v))
    length = root(jnp.sum(total**2, axis=1, keepdims=True))
    return total / jnp.where(length > 0, length, 1)
