"""Pad arrays to shapes that many meshes share, so that code compiled for one mesh serves others.

Padding vertices are isolated: nothing moves them, and they move nothing. Large meshes, which take longer to run than to
compile for, stay as they are.
"""

import math

import numpy as np
from jaxtyping import Shaped

from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.graphs import Weighting, from_mesh, nearest_pairs
from jaxmark.spectral.laplacian import Laplacian, Lowering, graph_laplacian

_MIN_SIZE = 256
_MAX_DOUBLED_SIZE = 2**11  # up to this, sizes double: running takes next to no time
_NEIGHBOURS = 10  # nearest points that each point of a cloud is joined to, at least
_MAX_PADDED_SIZE = 2**17  # beyond this, running takes longer than compiling


def common_size(count: int) -> int:
    """Round a size up to a power of two from 2^8 on, beyond 2^11 to one of four per octave; from 2^17 on, keep it."""
    step = 1 << max(count - 1, 1).bit_length() >> 3
    if count <= _MAX_DOUBLED_SIZE:
        step = max(_MIN_SIZE, 8 * step)
    return count if count > _MAX_PADDED_SIZE else -(-count // step) * step


def pad_rows(rows: Shaped[np.ndarray, " rows *columns"], count: int, value: float = 0) -> Shaped[np.ndarray, "..."]:
    """Pad with `value` to `count` rows."""
    padding = np.full((max(count - len(rows), 0), *rows.shape[1:]), value, rows.dtype)
    return np.concatenate([rows, padding])


def common_laplacian(mesh: Mesh, weights: Weighting = "valence", lowering: Lowering = "auto") -> Laplacian:
    """`from_mesh`, padded with isolated vertices and with edges past the last vertex.

    A mesh without faces is a cloud: its points are joined to the nearest ones, as `from_points` does, by edges of
    weight 1 whatever the weights asked for.

    Pad signals to the operator's size, such as by `pad_rows`.

    Raises:
        JaxmarkError: see `from_mesh`.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    if len(mesh.faces) == 0:
        pairs, _ = nearest_pairs(vertices, min(_NEIGHBOURS, len(vertices) - 1))
        # Where one point is near to another, the other mostly is near to the one.
        return pad_edges(graph_laplacian(pairs, common_size(len(vertices)), lowering=lowering), 0.75 * _NEIGHBOURS)
    padded = mesh._replace(vertices=pad_rows(vertices, common_size(len(vertices))))
    # A closed surface of triangles has about three edges per vertex.
    return pad_edges(from_mesh(padded, weights, lowering=lowering), 3)


def pad_edges(operator: Laplacian, valence: float) -> Laplacian:
    """Pad an operator of a common size with edges past the last vertex.

    Args:
        operator: of any graph.
        valence: edges per vertex that most such graphs do not exceed.
    """
    size, edges = len(operator.degree), np.asarray(operator.edges)
    if size > _MAX_PADDED_SIZE:
        return operator
    count = math.ceil(valence * size)
    if len(edges) > count:
        count = common_size(len(edges))
    values = None if operator.weights is None else pad_rows(np.asarray(operator.weights), count)
    operator = operator._replace(edges=pad_rows(edges, count, size), weights=values)
    table = operator.neighbours
    if table is None or not len(table.rest):
        return operator
    # In most meshes, fewer neighbours than a sixteenth of the vertices have no slot.
    rest = max(size // 16, 1 << (len(table.rest) - 1).bit_length())
    return operator._replace(neighbours=table._replace(rest=pad_rows(np.asarray(table.rest), rest, size)))
