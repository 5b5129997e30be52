"""Operators of unlike graphs in one batch, for `vmap`."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.laplacian import Laplacian, Neighbours, host_edges
from jaxmark.spectral.shapes import pad_rows


def stack(operators: Sequence[Laplacian]) -> Laplacian:
    """Stack operators of any sizes into one whose arrays have a leading axis, on the host.

    `jax.vmap(spectral.filter, (0, None, 0))(stack(operators), coefficients, signals)` filters all in one call that is
    compiled once, with signals `[batch, N]` or `[batch, N, C]` for the largest N. Smaller graphs are filled up by
    isolated vertices, which move nothing: what a signal has there is of no consequence to the others.

    Args:
        operators: one or more. Products are by table where all have tables alike, with or without weights, and by
            segment-sums otherwise.

    Returns:
        The batch, from which `jax.tree.map` takes operators out one by one, filled up as they are.

    Raises:
        JaxmarkError: if there is no operator.
    """
    if not operators:
        raise JaxmarkError("There is no operator to stack.")
    size = max(len(one.degree) for one in operators)
    found = [host_edges(one) for one in operators]
    count = max(len(pairs) for pairs, _ in found)
    weighted = any(one.weights is not None for one in operators)
    massive = any(one.lumped_mass is not None for one in operators)
    tables = [one.neighbours for one in operators if one.neighbours is not None]
    alike = len(tables) == len(operators) and all((table.edges is not None) == weighted for table in tables)
    slots = max((len(table.vertices) for table in tables), default=0)
    rest = max((len(table.rest) for table in tables), default=0)
    ordered = any(table.order is not None for table in tables)
    padded = [
        Laplacian(
            pad_rows(pairs, count, size),
            pad_rows(weights, count) if weighted else None,
            pad_rows(np.asarray(one.degree), size),
            _padded_table(one.neighbours, len(pairs), size, count, slots, rest, ordered)
            if alike and one.neighbours is not None
            else None,
            pad_rows(np.asarray(one.mass), size) if massive else None,
            np.asarray(1.0 if one.scale is None else one.scale) if massive else None,
        )
        for one, (pairs, weights) in zip(operators, found, strict=True)
    ]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *padded)


def _padded_table(
    table: Neighbours, edges: int, size: int, count: int, slots: int, rest: int, ordered: bool
) -> Neighbours:
    """A table for a graph of more vertices, edges, slots and neighbours without a slot."""
    old_slots, old_size = np.shape(table.vertices)
    own = np.arange(size, dtype=np.int32)
    vertices = np.tile(own, (slots, 1))
    vertices[:old_slots, :old_size] = table.vertices
    empty = np.full(size, slots, np.int32)
    empty[:old_size] = np.asarray(table.empty) + slots - old_slots
    looked_up = None
    if table.edges is not None:
        looked_up = np.full((slots, size), count, np.int32)
        looked_up[:old_slots, :old_size] = np.where(np.asarray(table.edges) < edges, table.edges, count)
    left = np.asarray(table.rest)
    left = pad_rows(left[left[:, 0] < old_size], rest, size)

    def longer(order: Array | np.ndarray | None) -> np.ndarray | None:
        if not ordered:
            return None
        whole = own.copy()
        whole[:old_size] = own[:old_size] if order is None else order
        return whole

    return Neighbours(vertices, empty, left, looked_up, longer(table.order), longer(table.rank))
