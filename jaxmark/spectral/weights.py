"""Weights of edges, and masses of vertices, as functions of positions.

They take NumPy arrays, or JAX's, traced or not, and give the same: on the host in float64, or with derivatives.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int64

from jaxmark.geometry.mesh import Faces, edges, sides

_MIN_COTANGENT = 1e-6  # over the largest weight

Positions = Float[Array | np.ndarray, "points 3"]


def inverse_length_weights(
    positions: Float[Array | np.ndarray, "points axes"], pairs: Int[np.ndarray, "edges 2"]
) -> Float[Array | np.ndarray, " edges"]:
    """Compute 1 over the length of each edge, in the inverse of the positions' unit; infinite for length zero."""
    xp = positions.__array_namespace__()
    lengths = xp.sqrt(xp.sum((positions[pairs[:, 0]] - positions[pairs[:, 1]]) ** 2, axis=1))
    with np.errstate(divide="ignore"):
        return 1 / lengths


def cotangent_weights(vertices: Positions, faces: Faces) -> Float[Array | np.ndarray, " edges"]:
    """Compute half the sum of the cotangents of the angles opposite each edge, clipped below at 1e-6 of the largest.

    Pinkall, Polthier, "Computing discrete minimal surfaces and their conjugates", 1993. Obtuse angles make weights
    negative, whence the clipping. A degenerate face has no angles, and adds nothing.

    Args:
        vertices: `[V, 3]`.
        faces: `[F, 3]`, concrete.

    Returns:
        `[E]`, in the order of `jaxmark.geometry.mesh.edges`; none is positive if no cotangent is.
    """
    xp = vertices.__array_namespace__()
    pairs, (ends, apex), base = edges(faces), sides(faces), np.array([len(vertices), 1])
    first, second = vertices[ends[:, 0]] - vertices[apex], vertices[ends[:, 1]] - vertices[apex]
    square = xp.sum(xp.linalg.cross(first, second) ** 2, axis=1)
    sound = square > 0
    # Select before dividing, so that degenerate faces keep finite gradients.
    cotangents = xp.where(sound, xp.sum(first * second, axis=1) / xp.sqrt(xp.where(sound, square, 1)), 0)
    # A side from a vertex to itself is no edge; it is counted past the last one.
    which = np.searchsorted(pairs @ base, np.sort(ends, axis=1) @ base)
    which[ends[:, 0] == ends[:, 1]] = len(pairs)
    weights = _sums(cotangents / 2, which, len(pairs))
    return xp.maximum(weights, _MIN_COTANGENT * xp.max(xp.append(weights, 0)))


def vertex_areas(vertices: Positions, faces: Faces) -> Float[Array | np.ndarray, " vertices"]:
    """Compute a third of the area of the faces around each vertex: the lumped mass `[V]` of linear finite elements.

    Masses are in the square of the positions' unit, and sum to the area of the mesh. Faces are concrete.
    """
    xp = vertices.__array_namespace__()
    faces = np.asarray(faces)
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    square = xp.sum(xp.linalg.cross(b - a, c - a) ** 2, axis=1)
    areas = xp.where(square > 0, xp.sqrt(xp.where(square > 0, square, 1)) / 2, 0)
    return _sums(xp.concat([areas, areas, areas]) / 3, faces.T.ravel(), len(vertices))


def _sums(
    values: Float[Array | np.ndarray, " values"], which: Int64[np.ndarray, " values"], count: int
) -> Float[Array | np.ndarray, " things"]:
    """Sum the values of each of so many things; what is counted past the last is left out."""
    if isinstance(values, np.ndarray):
        return np.bincount(which, values, count + 1)[:count]
    return jax.ops.segment_sum(jnp.asarray(values), which, count)
