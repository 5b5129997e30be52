"""Weights of edges, and masses of vertices, as functions of positions.

They take NumPy arrays, or JAX's, traced or not, and give the same: on the host in float64, or with derivatives.
"""

from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Faces, edges, sides

_MIN_COTANGENT = 1e-6  # over the median size of the weights
_MIN_HEIGHT = 64  # of a face that is not degenerate, over its longest side, in epsilons of the dtype

Negative = Literal["clip", "keep", "refuse"]
Positions = Float[Array | np.ndarray, "points 3"]


def inverse_length_weights(
    positions: Float[Array | np.ndarray, "points axes"], pairs: Int[np.ndarray, "edges 2"]
) -> Float[Array | np.ndarray, " edges"]:
    """Compute 1 over the length of each edge, in the inverse of the positions' unit; infinite for length zero."""
    xp = positions.__array_namespace__()
    lengths = xp.sqrt(xp.sum((positions[pairs[:, 0]] - positions[pairs[:, 1]]) ** 2, axis=1))
    with np.errstate(divide="ignore"):
        return 1 / lengths


def cotangent_weights(
    vertices: Positions, faces: Faces, negative: Negative = "clip"
) -> Float[Array | np.ndarray, " edges"]:
    """Compute half the sum of the cotangents of the angles opposite each edge.

    Pinkall, Polthier, "Computing discrete minimal surfaces and their conjugates", 1993. A weight is negative where two
    opposite angles sum to more than π, that is, where an edge is not Delaunay. A degenerate face, which is flat up to
    rounding, has no angles, and adds nothing.

    Args:
        vertices: `[V, 3]`.
        faces: `[F, 3]`, concrete.
        negative: what happens to negative weights: `"clip"`, all weights are raised to at least 1e-6 of the median
            size, which changes the operator at these edges; `"keep"`, nothing; `"refuse"`, they are refused, which
            needs concrete vertices.

    Returns:
        `[E]`, in the order of `jaxmark.geometry.mesh.edges`; if no cotangent is positive, no weight is.

    Raises:
        JaxmarkError: if `negative` is something else, or is `"refuse"` and a weight is negative or the vertices are
            traced.
    """
    if negative not in get_args(Negative):
        raise JaxmarkError(f"negative is {', '.join(map(repr, get_args(Negative)))}, not {negative!r}.")
    if negative == "refuse" and isinstance(vertices, Tracer):
        raise JaxmarkError("negative='refuse' needs concrete vertices; use 'clip' or 'keep' under jit, vmap or grad.")
    xp = vertices.__array_namespace__()
    pairs, (ends, apex), base = edges(faces), sides(faces), np.array([len(vertices), 1])
    first, second = vertices[ends[:, 0]] - vertices[apex], vertices[ends[:, 1]] - vertices[apex]
    square = xp.tile(_squares(vertices, faces), 3)
    sound = square > 0
    # Select before dividing, so that degenerate faces keep finite gradients.
    cotangents = xp.where(sound, xp.sum(first * second, axis=1) / xp.sqrt(xp.where(sound, square, 1)), 0)
    # A side from a vertex to itself is no edge; it is counted past the last one.
    which = np.searchsorted(pairs @ base, np.sort(ends, axis=1) @ base)
    which[ends[:, 0] == ends[:, 1]] = len(pairs)
    weights = _sums(cotangents / 2, which, len(pairs))
    if negative == "refuse" and (bad := np.flatnonzero(np.asarray(weights) < 0)).size:
        raise JaxmarkError(
            f"{len(bad)} of {len(pairs)} edges have negative cotangent weights, the first is {pairs[bad[0]].tolist()};"
            " remesh, or use weights='robust' (an intrinsic Delaunay triangulation) or negative='clip'."
        )
    if not len(pairs) or negative != "clip":
        return weights
    # A thin face has weights of any size; the median is that of the others.
    least = xp.where(xp.max(weights) > 0, _MIN_COTANGENT * xp.median(xp.abs(weights)), 0)
    return xp.maximum(weights, least)


def vertex_areas(vertices: Positions, faces: Faces) -> Float[Array | np.ndarray, " vertices"]:
    """Compute a third of the area of the faces around each vertex: the lumped mass `[V]` of linear finite elements.

    Masses are in the square of the positions' unit, and sum to the area of the mesh. Faces are concrete; degenerate
    ones, see `cotangent_weights`, have no area.
    """
    xp = vertices.__array_namespace__()
    square = _squares(vertices, faces)
    areas = xp.where(square > 0, xp.sqrt(xp.where(square > 0, square, 1)) / 2, 0)
    return _sums(xp.concat([areas, areas, areas]) / 3, np.asarray(faces).T.ravel(), len(vertices))


def _squares(vertices: Positions, faces: Faces) -> Float[Array | np.ndarray, " faces"]:
    """Compute the square of twice each face's area; 0 for degenerate faces, which are flat up to rounding."""
    xp = vertices.__array_namespace__()
    a, b, c = (vertices[np.asarray(faces)[:, corner]] for corner in range(3))
    longest = xp.max(xp.stack([xp.sum(side**2, axis=1) for side in (b - a, c - b, a - c)]), axis=0)
    square = xp.sum(xp.linalg.cross(b - a, c - a) ** 2, axis=1)
    eps = xp.finfo(xp.sqrt(square).dtype).eps  # positions may be whole numbers
    return xp.where(square > (_MIN_HEIGHT * eps * longest) ** 2, square, 0)


def _sums(
    values: Float[Array | np.ndarray, " values"], which: Int64[np.ndarray, " values"], count: int
) -> Float[Array | np.ndarray, " things"]:
    """Sum the values of each of so many things; what is counted past the last is left out."""
    if isinstance(values, np.ndarray):
        return np.bincount(which, values, count + 1)[:count]
    return jax.ops.segment_sum(jnp.asarray(values), which, count)
