"""Additive noise: uniform, as in the SMI 2010 benchmark (Wang et al.) and in Sohn et al., and Gaussian.

All of it is differentiable with respect to vertices and strength.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmark.attacks.support import Positions, Strength, diagonal, inner_vertices, surface
from jaxmark.distortion.norms import rms
from jaxmark.geometry.mesh import Mesh, used_vertices
from jaxmark.seeds import Seed, random_key


def uniform_noise(mesh: Mesh, strength: Strength, seed: Seed) -> Mesh:
    """Add independent uniform noise to each coordinate, as in the SMI 2010 benchmark; boundary vertices stay.

    The strength is the half width of the interval, relative to the mean distance of the vertices to their centre: 0.005
    moves each coordinate by at most 0.5 % of that distance.
    """
    return _add_noise(mesh, inner_vertices(mesh), strength, _radius(mesh), _uniform(mesh, seed))


def gaussian_noise(mesh: Mesh, strength: Strength, seed: Seed) -> Mesh:
    """Add independent normal noise to each coordinate; boundary vertices stay.

    The strength is the standard deviation of a coordinate, relative to the mean distance of the vertices to their
    centre; that of `uniform_noise` is 1/√3 of its half width.
    """
    vertices = jnp.asarray(mesh.vertices)
    noise = jax.random.normal(random_key(seed), vertices.shape, vertices.dtype)
    return _add_noise(mesh, inner_vertices(mesh), strength, _radius(mesh), noise)


def diagonal_noise(mesh: Mesh, strength: Strength, seed: Seed) -> Mesh:
    """Add independent uniform noise to each coordinate of all vertices, those on a boundary too (Sohn et al.).

    The strength is the half width of the interval, relative to the diagonal of the bounding box. It is also the
    expected RMS displacement of the vertices, in diagonals.
    """
    return _add_noise(mesh, used_vertices(mesh)[:, None], strength, diagonal(surface(mesh)), _uniform(mesh, seed))


def mark_noise(marked: Mesh, original: Mesh, strength: Strength, seed: Seed) -> Mesh:
    """Add uniform noise to each coordinate of all vertices, as a multiple of the watermark's size (Sohn et al.).

    It needs the original, which an attacker does not have, and so it is not in `ATTACKS`.
    The original has the same vertices in the same order. The strength is the expected RMS displacement by the noise,
    relative to that by the mark, both over the vertices that faces use.
    """
    used = used_vertices(marked)
    mark = jnp.asarray(marked.vertices) - jnp.asarray(original.vertices)
    return _add_noise(marked, used[:, None], strength, rms(mark[np.flatnonzero(used)]), _uniform(marked, seed))


def _radius(mesh: Mesh) -> Float[Array, ""]:
    """Return the mean distance of the vertices that faces use to their centre."""
    points = surface(mesh)
    return jnp.linalg.norm(points - points.mean(axis=0), axis=1).mean()


def _uniform(mesh: Mesh, seed: Seed) -> Positions:
    """Draw uniform noise in [-1, 1]; the RMS displacement of a vertex is 1, since 3 · 1/3 = 1."""
    vertices = jnp.asarray(mesh.vertices)
    return jax.random.uniform(random_key(seed), vertices.shape, vertices.dtype, -1, 1)


def _add_noise(
    mesh: Mesh, moving: np.ndarray, strength: Strength, unit: Float[Array | np.ndarray, ""], noise: Positions
) -> Mesh:
    """Move the vertices in `moving` by the noise times `strength` units."""
    size = jnp.asarray(strength).astype(noise.dtype) * unit
    return Mesh(jnp.asarray(mesh.vertices) + jnp.where(moving, size * noise, 0), mesh.faces)
