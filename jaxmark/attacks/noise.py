"""Additive noise: what the SMI 2010 benchmark does, and Sohn et al.; and its Gaussian kin."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxmark.attacks.extent import diagonal, surface
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
    return _noisy(mesh, _inner(mesh), strength, _radius(mesh), _uniform(mesh, key))


def gaussian_noise(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add independent normal noise to each coordinate, else as `uniform_noise`, of which 1/√3 is the deviation.

    Args:
        mesh: any mesh, its faces concrete; boundary vertices are left alone.
        strength: standard deviation of each coordinate, relative to the mean distance of the vertices to their centre.
        key: a JAX random key.

    Returns:
        The noisy mesh. Differentiable with respect to vertices and strength.
    """
    vertices = jnp.asarray(mesh.vertices)
    noise = jax.random.normal(key, vertices.shape, vertices.dtype)
    return _noisy(mesh, _inner(mesh), strength, _radius(mesh), noise)


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
    return _noisy(mesh, used_vertices(mesh), strength, diagonal(surface(mesh)), _uniform(mesh, key))


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
    return _noisy(marked, used, strength, rms(mark[np.flatnonzero(used)]), _uniform(marked, key))


def _inner(mesh: Mesh) -> Bool[np.ndarray, " vertices"]:
    """The vertices that faces use, but for boundaries."""
    inner = used_vertices(mesh)
    inner[boundary_vertices(np.asarray(mesh.faces))] = False
    return inner


def _radius(mesh: Mesh) -> Float[Array, ""]:
    """Mean distance of the vertices to their centre."""
    points = surface(mesh)
    return jnp.linalg.norm(points - points.mean(axis=0), axis=1).mean()


def _uniform(mesh: Mesh, key: PRNGKeyArray) -> Float[Array, "vertices 3"]:
    """From -1 to 1: the vertices' root mean square is 1, for 3 · 1/3 = 1."""
    vertices = jnp.asarray(mesh.vertices)
    return jax.random.uniform(key, vertices.shape, vertices.dtype, -1, 1)


def _noisy(
    mesh: Mesh,
    moving: Bool[np.ndarray, " vertices"],
    strength: float | Float[Array, ""],
    unit: Float[Array | np.ndarray, ""],
    noise: Float[Array, "vertices 3"],
) -> Mesh:
    """Moving vertices moved by so many units of the noise."""
    size = jnp.asarray(strength).astype(noise.dtype) * unit
    return Mesh(jnp.asarray(mesh.vertices) + jnp.where(moving[:, None], size * noise, 0), mesh.faces)
