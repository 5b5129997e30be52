"""Additive noise: uniform, as in the SMI 2010 benchmark and in Sohn et al., and Gaussian."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxmark.attacks.extent import diagonal, surface
from jaxmark.distortion import rms
from jaxmark.geometry.mesh import Mesh, boundary_vertices, used_vertices


def uniform_noise(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add independent uniform noise to each coordinate, as in the SMI 2010 benchmark (Wang et al.).

    Args:
        mesh: any mesh, its faces concrete; boundary vertices are left alone.
        strength: half width of the interval, relative to the mean distance of the vertices to their centre: 0.005
            moves each coordinate by at most 0.5 % of that distance.
        key: a JAX random key.

    Returns:
        The noisy mesh. Differentiable with respect to vertices and strength.
    """
    return _add_noise(mesh, _inner(mesh), strength, _radius(mesh), _uniform(mesh, key))


def gaussian_noise(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add independent normal noise to each coordinate.

    Otherwise as `uniform_noise`, whose standard deviation is 1/√3 of its half width.

    Args:
        mesh: any mesh, its faces concrete; boundary vertices are left alone.
        strength: standard deviation of each coordinate, relative to the mean distance of the vertices to their centre.
        key: a JAX random key.

    Returns:
        The noisy mesh. Differentiable with respect to vertices and strength.
    """
    vertices = jnp.asarray(mesh.vertices)
    noise = jax.random.normal(key, vertices.shape, vertices.dtype)
    return _add_noise(mesh, _inner(mesh), strength, _radius(mesh), noise)


def diagonal_noise(mesh: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add independent uniform noise to each coordinate of all vertices, those on a boundary too (Sohn et al.).

    Args:
        mesh: any mesh, its faces concrete.
        strength: half width of the interval, relative to the diagonal of the bounding box. It is also the expected RMS
            displacement of the vertices, in diagonals.
        key: a JAX random key.

    Returns:
        The noisy mesh. Differentiable with respect to vertices and strength.
    """
    return _add_noise(mesh, used_vertices(mesh), strength, diagonal(surface(mesh)), _uniform(mesh, key))


def mark_noise(marked: Mesh, original: Mesh, strength: float | Float[Array, ""], key: PRNGKeyArray) -> Mesh:
    """Add uniform noise to each coordinate of all vertices, as a multiple of the watermark's size (Sohn et al.).

    It needs the original, which an attacker does not have, and so it is not in `ATTACKS`.

    Args:
        marked: any mesh, its faces concrete.
        original: the unmarked mesh, with the same vertices in the same order.
        strength: expected RMS displacement by the noise, relative to that by the mark, both over the vertices that
            faces use.
        key: a JAX random key.

    Returns:
        The noisy mesh. Differentiable with respect to vertices and strength.
    """
    used = used_vertices(marked)
    mark = jnp.asarray(marked.vertices) - jnp.asarray(original.vertices)
    return _add_noise(marked, used, strength, rms(mark[np.flatnonzero(used)]), _uniform(marked, key))


def _inner(mesh: Mesh) -> Bool[np.ndarray, " vertices"]:
    """Mask of the vertices that faces use and that lie on no boundary."""
    inner = used_vertices(mesh)
    inner[boundary_vertices(np.asarray(mesh.faces))] = False
    return inner


def _radius(mesh: Mesh) -> Float[Array, ""]:
    """Mean distance of the vertices that faces use to their centre."""
    points = surface(mesh)
    return jnp.linalg.norm(points - points.mean(axis=0), axis=1).mean()


def _uniform(mesh: Mesh, key: PRNGKeyArray) -> Float[Array, "vertices 3"]:
    """Uniform noise in [-1, 1]; the RMS displacement of a vertex is 1, since 3 · 1/3 = 1."""
    vertices = jnp.asarray(mesh.vertices)
    return jax.random.uniform(key, vertices.shape, vertices.dtype, -1, 1)


def _add_noise(
    mesh: Mesh,
    moving: Bool[np.ndarray, " vertices"],
    strength: float | Float[Array, ""],
    unit: Float[Array | np.ndarray, ""],
    noise: Float[Array, "vertices 3"],
) -> Mesh:
    """Move the vertices in `moving` by the noise times `strength` units."""
    size = jnp.asarray(strength).astype(noise.dtype) * unit
    return Mesh(jnp.asarray(mesh.vertices) + jnp.where(moving[:, None], size * noise, 0), mesh.faces)
