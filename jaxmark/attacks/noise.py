"""Additive noise."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmark.mesh import Mesh, boundary_vertices, used_vertices


def uniform_noise(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add independent uniform noise to each coordinate, as in the SMI 2010 benchmark (Wang et al.).

    Args:
        mesh: any mesh, its faces concrete; boundary vertices are left alone.
        strength: half width of the interval, relative to the mean distance of the vertices to their centre: 0.005
            moves each coordinate by at most 0.5 % of it.
        key: a JAX random key.

    Returns:
        The noisy mesh. Differentiable with respect to vertices and strength.
    """
    vertices = jnp.asarray(mesh.vertices)
    used = used_vertices(mesh)
    surface = vertices[np.flatnonzero(used)]
    radius = jnp.linalg.norm(surface - surface.mean(axis=0), axis=1).mean()
    noise = jax.random.uniform(key, vertices.shape, vertices.dtype, -1, 1)
    used[boundary_vertices(np.asarray(mesh.faces))] = False
    size = jnp.asarray(strength).astype(vertices.dtype) * radius
    return Mesh(vertices + jnp.where(used[:, None], size * noise, 0), mesh.faces)
