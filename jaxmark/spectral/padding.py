"""Operators padded to shapes that many meshes share, so that compiled code serves them all, or stacked in a batch.

Padding vertices are isolated: nothing moves them, and they move nothing. Large meshes, which take longer to run than to
compile for, stay as they are.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Shaped

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.spectral.graphs import Weighting, from_mesh, nearest_pairs
from jaxmark.spectral.laplacian import Laplacian, Lowering, Neighbours, graph_laplacian, make_neighbours

_MIN_SIZE = 256
_MAX_DOUBLED_SIZE = 2**13  # up to this, sizes double: running takes next to no time
SURFACE_VALENCE = 3  # edges per vertex of closed surfaces of triangles, which have few holes
_NEIGHBOURS = 10  # nearest points that each point of a cloud is joined to, at least
_MAX_COMMON_TABLE = 2**14  # up to this, the number of slots of a table matters less than compiling for another one
_MAX_PADDED_SIZE = 2**17  # beyond this, running takes longer than compiling


def common_size(count: int) -> int:
    """Round a size up to a power of two from 2^8 on, beyond 2^13 to one of four per octave; from 2^17 on, keep it."""
    step = 1 << max(count - 1, 1).bit_length() >> 3
    if count <= _MAX_DOUBLED_SIZE:
        step = max(_MIN_SIZE, 8 * step)
    return count if count > _MAX_PADDED_SIZE else -(-count // step) * step


def common_edges(count: int, size: int, valence: float) -> int:
    """Round a number of edges up, for a graph of a common size, to as many edges per vertex if that is enough."""
    if size > _MAX_PADDED_SIZE:
        return count
    usual = math.ceil(valence * size)
    return usual if count <= usual else common_size(count)


def pad_rows(rows: Shaped[np.ndarray, " rows *columns"], count: int, value: float = 0) -> Shaped[np.ndarray, "..."]:
    """Pad with `value` to `count` rows."""
    return np.concatenate([rows, np.full((max(count - len(rows), 0), *rows.shape[1:]), value, rows.dtype)])


def common_laplacian(mesh: Mesh, weights: Weighting = "valence", lowering: Lowering = "auto") -> Laplacian:
    """Build the operator of `from_mesh`, padded with isolated vertices and with edges past the last vertex.

    A mesh without faces is a cloud: its points are joined to the nearest ones, as `from_points` does, by edges of
    weight 1 whatever the weights asked for. Pad signals to the operator's size, such as by `pad_rows`.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    if len(mesh.faces) == 0:
        pairs, _ = nearest_pairs(vertices, min(_NEIGHBOURS, len(vertices) - 1))
        # Mostly, of two points each is among the nearest of the other.
        return pad_edges(graph_laplacian(pairs, common_size(len(vertices)), lowering=lowering), 0.75 * _NEIGHBOURS)
    padded = mesh._replace(vertices=pad_rows(vertices, common_size(len(vertices))))
    return pad_edges(from_mesh(padded, weights, lowering=lowering), SURFACE_VALENCE)


def pad_edges(operator: Laplacian, valence: float) -> Laplacian:
    """Pad an operator of a common size with edges past the last vertex.

    Args:
        operator: of any graph.
        valence: edges per vertex that most such graphs do not exceed.
    """
    size, edges = len(operator.degree), np.asarray(operator.edges)
    if size > _MAX_PADDED_SIZE:
        return operator
    count = common_edges(len(edges), size, valence)
    values = None if operator.weights is None else pad_rows(np.asarray(operator.weights), count)
    # In most meshes, fewer neighbours than a sixteenth of the vertices have no slot, if slots are chosen by their cost.
    table, rest, step = operator.neighbours, max(size // 16, 1), 2
    if table is not None and size < _MAX_COMMON_TABLE:
        rest, step = max(size // 4, 1), 4
        table = make_neighbours(edges, size, weighted=values is not None, slots=_common_slots(valence))
    if table is not None and len(table.rest):
        table = table._replace(rest=pad_rows(np.asarray(table.rest), _raised(rest, step, len(table.rest)), size))
    return operator._replace(edges=pad_rows(edges, count, size), weights=values, neighbours=table)


def _common_slots(valence: float) -> int:
    """Return a number of slots that suffices for most vertices of graphs with so many edges per vertex."""
    return 4 * math.ceil((2 * valence + 1) / 4)


def _raised(count: int, step: int, least: int) -> int:
    """Multiply a count until it is large enough, so that few different counts occur."""
    while count < least:
        count *= step
    return count


def stack(operators: Sequence[Laplacian], *, size: int | None = None, edges: int | None = None) -> Laplacian:
    """Stack operators of any sizes into one whose arrays have a leading axis.

    `jax.vmap(spectral.filter, (0, None, 0))(stack(operators), coefficients, signals)` filters all in one call that is
    compiled once, with signals `[batch, N]` or `[batch, N, C]` for the largest N. Smaller graphs are filled up by
    isolated vertices, which move nothing: what a signal has there is of no consequence to the others. Every graph costs
    as much as the largest, so sort graphs by size before batching, and loop over those that are far larger than others.

    Args:
        operators: one or more; weights, degrees and masses may be traced, such as those of traced positions. Products
            are by table where all have tables alike, with or without weights, and by segment-sums otherwise.
        size: number of vertices to fill up to, by default that of the largest graph.
        edges: number of edges to fill up to, by default that of the graph with the most. Batches of one size and number
            of edges share compiled programs, unless one has so many vertices of high valence that tables differ.

    Returns:
        The batch, from which `jax.tree.map` takes operators out one by one, filled up as they are.

    Raises:
        JaxmarkError: if there is no operator, or one is larger than `size` or `edges`.
    """
    if not operators:
        raise JaxmarkError("There is no operator to stack.")
    real = [np.flatnonzero(np.asarray(one.edges)[:, 0] < len(one.degree)) for one in operators]
    graphs = [np.asarray(one.edges)[found] for one, found in zip(operators, real, strict=True)]
    largest, most = max(len(one.degree) for one in operators), max(map(len, graphs))
    vertices, count = size or largest, edges or most
    if vertices < largest or count < most:
        raise JaxmarkError(
            f"These graphs have up to {largest} vertices and {most} edges, so they do not fit into size={size} and"
            f" edges={edges}."
        )
    weighted = any(one.weights is not None for one in operators)
    massive = any(one.lumped_mass is not None for one in operators)
    own = [one.neighbours for one in operators if one.neighbours is not None]
    tables: Sequence[Neighbours | None] = [None] * len(operators)
    if len(own) == len(operators) and all((table.edges is not None) == weighted for table in own):
        if size is None and edges is None:
            tables = _tables_alike(own, [len(pairs) for pairs in graphs], vertices, count)
        else:
            tables = _tables_of_shape(graphs, vertices, count, weighted=weighted)

    def weights_of(one: Laplacian, found: np.ndarray) -> Any:
        return np.ones(len(found)) if one.weights is None else one.weights[found]

    batch = [
        Laplacian(
            pad_rows(pairs, count, vertices),
            _filled(weights_of(one, found), count) if weighted else None,
            _filled(one.degree, vertices),
            table,
            _filled(one.mass, vertices) if massive else None,
            (np.asarray(1.0) if one.scale is None else one.scale) if massive else None,
        )
        for one, pairs, found, table in zip(operators, graphs, real, tables, strict=True)
    ]
    return jax.tree.map(_stacked, *batch)


def _filled(values: Any, count: int) -> Any:
    """Pad with zeros to a number of values, in NumPy or, such as traced values, in JAX."""
    return jnp.pad(values, (0, count - len(values))) if isinstance(values, jax.Array) else pad_rows(values, count)


def _stacked(*leaves: Any) -> Array | np.ndarray:
    return (jnp if any(isinstance(leaf, jax.Array) for leaf in leaves) else np).stack(leaves)


def _tables_alike(tables: Sequence[Neighbours], counts: Sequence[int], size: int, edges: int) -> list[Neighbours]:
    """Fill tables up to as many vertices, edges, slots and neighbours without a slot as the largest one has."""
    slots, rest = max(len(table.vertices) for table in tables), max(len(table.rest) for table in tables)
    ordered, own = any(table.order is not None for table in tables), np.arange(size, dtype=np.int32)

    def filled(table: Neighbours, count: int) -> Neighbours:
        old_slots, old_size = np.shape(table.vertices)
        vertices, empty = np.tile(own, (slots, 1)), np.full(size, slots, np.int32)
        vertices[:old_slots, :old_size] = table.vertices
        empty[:old_size] = np.asarray(table.empty) + slots - old_slots
        looked_up = None
        if table.edges is not None:
            looked_up = np.full((slots, size), edges, np.int32)
            looked_up[:old_slots, :old_size] = np.where(np.asarray(table.edges) < count, table.edges, edges)
        left = np.asarray(table.rest)
        orders = [
            np.concatenate([own[:old_size] if order is None else order, own[old_size:]]) if ordered else None
            for order in (table.order, table.rank)
        ]
        return Neighbours(vertices, empty, pad_rows(left[left[:, 0] < old_size], rest, size), looked_up, *orders)

    return [filled(table, count) for table, count in zip(tables, counts, strict=True)]


def _tables_of_shape(
    graphs: Sequence[Int[np.ndarray, "_edges 2"]], size: int, edges: int, *, weighted: bool
) -> list[Neighbours | None]:
    """Build tables in a shape that nearly all graphs with as many vertices and edges share."""
    slots = _common_slots(edges / size)
    tables = [make_neighbours(pairs, size, weighted=weighted, slots=slots) for pairs in graphs]
    rest = _raised(max(size // 4, 1), 4, max(0 if table is None else len(table.rest) for table in tables))
    return [table and table._replace(rest=pad_rows(np.asarray(table.rest), rest, size)) for table in tables]
