"""A filter to time, on surfaces of any size."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse

import jaxmark as jm
from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import weld_mesh
from jaxmark.spectral.graphs import from_mesh
from jaxmark.spectral.laplacian import Laplacian, sparse_matrices

DEGREE = 64
TOLERANCE = 1e-4  # of two programs' results, over the largest value


def coefficients(degree: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=degree + 1).astype(np.float32)


def bumpy_torus(size: int) -> jm.Mesh:
    """A bumpy torus of about so many vertices, with valences from 4 to 8 and no symmetry."""
    random, around = np.random.default_rng(0), round((size / 2.5) ** 0.5)
    along = round(size / around)
    i = np.arange(along * around)
    u, v = 2 * np.pi * (i // around) / along, 2 * np.pi * (i % around) / around
    waves = [(p, q, random.uniform(0, 2 * np.pi)) for p in range(1, 8) for q in range(4)]
    radius = 0.4 + sum(0.03 / (p + q) * np.cos(p * u + q * v + phase) for p, q, phase in waves)
    ring = 1 + radius * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), radius * np.sin(v)], axis=1)
    up, right = (i + around) % len(i), i - i % around + (i + 1) % around
    across, cut = (right + around) % len(i), random.random(len(i)) < 0.5
    halves = [(i, up, np.where(cut, across, right)), (np.where(cut, i, up), across, right)]
    return jm.Mesh(vertices, np.concatenate([np.stack(half, axis=1) for half in halves]))


def reordered(mesh: jm.Mesh) -> jm.Mesh:
    """Vertices in random order."""
    order = np.random.default_rng(1).permutation(len(mesh.vertices))
    return jm.Mesh(np.asarray(mesh.vertices)[order], np.argsort(order)[np.asarray(mesh.faces)])


def graph(original: Original) -> tuple[Laplacian, jax.Array]:
    """Operator and signal of just its points, on the device."""
    points = weld_mesh(original.mesh, original.weld)
    return jax.tree.map(jnp.asarray, from_mesh(points)), original.signal[: len(points.vertices)]


def shifted(operator: Laplacian) -> sparse.csr_array:
    """Δ - I as a matrix, in float32 and without its zeros."""
    stiffness, mass = sparse_matrices(operator)
    degree = mass.diagonal()
    inverse = sparse.diags_array(1 / np.where(degree > 0, degree, 1))
    matrix = sparse.csr_array(inverse @ (stiffness - mass) - sparse.diags_array(1.0 * (degree == 0)), dtype=np.float32)
    matrix.eliminate_zeros()
    return matrix


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """The slope of logarithms, by least squares."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
