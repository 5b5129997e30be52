"""Shapes that many meshes share, so that what was compiled for one serves others: arrays are filled up to them.

A point more is isolated, so that nothing moves it and it moves nothing. Large meshes, which take longer to run than to
compile for, stay as they are.
"""

import numpy as np
from jaxtyping import Shaped

from jaxmark.laplacian import Laplacian, Lowering, Weighting, make_laplacian
from jaxmark.mesh import Mesh

_LEAST, _LARGE = 16, 2**17


def common(count: int) -> int:
    """The next of four sizes per octave, of which none wastes more than a fifth; from 2^17 on the number itself."""
    step = max(_LEAST, 1 << max(count - 1, 1).bit_length() >> 3)
    return count if count > _LARGE else -(-count // step) * step


def fill(rows: Shaped[np.ndarray, " rows *columns"], count: int, value: float = 0) -> Shaped[np.ndarray, "..."]:
    """So many rows, those that are missing of one value."""
    more = np.full((max(count - len(rows), 0), *rows.shape[1:]), value, rows.dtype)
    return np.concatenate([rows, more])


def common_laplacian(mesh: Mesh, weights: Weighting = "valence", lowering: Lowering = "auto") -> Laplacian:
    """`make_laplacian` with isolated vertices added, and edges past the last vertex; signals are filled up to its size.

    Raises:
        JaxmarkError: see `make_laplacian`.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    filled = mesh._replace(vertices=fill(vertices, common(len(vertices))))
    operator = make_laplacian(filled, weights, lowering=lowering)
    size, edges = len(operator.degree), np.asarray(operator.edges)
    if size > _LARGE:
        return operator
    # A closed surface of triangles has about three edges per vertex.
    count = 3 * size if len(edges) <= 3 * size else common(len(edges))
    values = None if operator.weights is None else fill(np.asarray(operator.weights), count)
    operator = operator._replace(edges=fill(edges, count, size), weights=values)
    table = operator.neighbours
    if table is None or not len(table.rest):
        return operator
    # Few meshes have more left over than this.
    most = max(size // 16, 1 << (len(table.rest) - 1).bit_length())
    return operator._replace(neighbours=table._replace(rest=fill(np.asarray(table.rest), most, size)))
