"""Additive noise: what the SMI 2010 benchmark does, and Sohn et al."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxmark.distortion import rms
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
    used = used_vertices(mesh)
    surface = jnp.asarray(mesh.vertices)[np.flatnonzero(used)]
    radius = jnp.linalg.norm(surface - surface.mean(axis=0), axis=1).mean()
    used[boundary_vertices(np.asarray(mesh.faces))] = False
    return _noisy(mesh, used, strength, radius, key)


def diagonal_noise(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add independent uniform noise to each coordinate of all vertices, those on a boundary too (Sohn et al.).

    Args:
        mesh: any mesh, its faces concrete.
        strength: half width of the interval, relative to the diagonal of the bounding box. It is also the root mean
            square of the vertices' displacements, in diagonals.
        key: a JAX random key.

    Returns:
        The noisy mesh. Differentiable with respect to vertices and strength.
    """
    used = used_vertices(mesh)
    surface = jnp.asarray(mesh.vertices)[np.flatnonzero(used)]
    return _noisy(mesh, used, strength, jnp.linalg.norm(jnp.ptp(surface, axis=0)), key)


def mark_noise(marked: Mesh, original: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add uniform noise of a multiple of the watermark's size to each coordinate of all vertices (Sohn et al.).

    It is no attack that a stranger could do, for it takes the original, and so it is not in `ATTACKS`.

    Args:
        marked: any mesh, its faces concrete.
        original: of as many vertices.
        strength: expected root mean square of the noise's displacements over that of the mark's, over the vertices
            that faces use.
        key: a JAX random key.

    Returns:
        The noisy mesh. Differentiable with respect to vertices and strength.
    """
    used = used_vertices(marked)
    mark = jnp.asarray(marked.vertices) - jnp.asarray(original.vertices)
    return _noisy(marked, used, strength, rms(mark[np.flatnonzero(used)]), key)


def _noisy(
    mesh: Mesh,
    moving: Bool[np.ndarray, " vertices"],
    strength: float | Float[Array, ""],
    unit: Float[Array | np.ndarray, ""],
    key: PRNGKeyArray,
) -> Mesh:
    """Each coordinate of moving vertices moved by up to so many units: the vertices' RMS, for 3 · 1/3 = 1."""
    vertices = jnp.asarray(mesh.vertices)
    noise = jax.random.uniform(key, vertices.shape, vertices.dtype, -1, 1)
    size = jnp.asarray(strength).astype(vertices.dtype) * unit
    return Mesh(vertices + jnp.where(moving[:, None], size * noise, 0), mesh.faces)
