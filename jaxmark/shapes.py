"""Shapes that many meshes share, so that what was compiled for one serves others: arrays are filled up to them.

A point more is isolated, so that nothing moves it and it moves nothing. Large meshes, which take longer to run than to
compile for, stay as they are.
"""

import numpy as np
from jaxtyping import Shaped

from jaxmark.laplacian import Laplacian
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


def with_common_size(mesh: Mesh) -> Mesh:
    """A mesh with as many vertices as others have, those that no face uses at the origin."""
    vertices = np.asarray(mesh.vertices, np.float64)
    return mesh._replace(vertices=fill(vertices, common(len(vertices))))


def with_common_shapes(operator: Laplacian) -> Laplacian:
    """An operator of NumPy arrays with as many edges as others have on as many vertices.

    What is filled in is past the last vertex.
    """
    size, edges = len(operator.degree), np.asarray(operator.edges)
    if size > _LARGE:
        return operator
    # A closed surface of triangles has about three edges per vertex.
    count = 3 * size if len(edges) <= 3 * size else common(len(edges))
    weights = None if operator.weights is None else fill(np.asarray(operator.weights), count)
    filled = operator._replace(edges=fill(edges, count, size), weights=weights)
    if (table := operator.neighbours) is None:
        return filled
    rest = np.asarray(table.rest)
    most = max(size // 16, 1 << (len(rest) - 1).bit_length())
    return filled._replace(neighbours=table._replace(rest=fill(rest, most if len(rest) else 0, size)))
