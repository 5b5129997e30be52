"""Laplacians of graphs that are no meshes: of any edges, and of points and their nearest neighbours."""

from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64, Int64
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.laplacian import Laplacian, Lowering, checked_weights, graph_laplacian

PointWeighting = Literal["valence", "inverse-length", "gaussian"]


def from_edges(
    edges: ArrayLike,
    weights: ArrayLike | None = None,
    size: int | None = None,
    *,
    duplicates: Literal["refuse", "add"] = "refuse",
    lowering: Lowering = "auto",
) -> Laplacian:
    """Build the Laplacian of an undirected graph from its edges, on the host.

    Args:
        edges: pairs of vertices `[E, 2]`, numbered from 0; the direction of a pair does not matter.
        weights: `[E]`, finite and not negative; all 1 unless given.
        size: number of vertices; by default one more than the largest number.
        duplicates: what to do with a pair that is there twice, in one direction or in both: `"refuse"`, or `"add"`
            the weights, as SciPy's sparse matrices do. A graph of directed edges, each in both directions, doubles all
            weights so, which leaves Δ as it is.
        lowering: see `make_laplacian`.

    Returns:
        A `Laplacian` of NumPy arrays in float64; its `weights` are None if all are 1.

    Raises:
        JaxmarkError: if an edge joins a vertex to itself, is there twice or has a vertex that is not there, or a weight
            is negative or not finite.
    """
    given = np.asarray(edges)
    if given.ndim != 2 or given.shape[1] != 2 or not (np.issubdtype(given.dtype, np.integer) or given.size == 0):
        raise JaxmarkError(f"Edges are whole numbers [E, 2], got {given.dtype} {given.shape}.")
    pairs = np.sort(given.astype(np.int64), axis=1)
    count = int(pairs.max(initial=-1)) + 1 if size is None else size
    if len(pairs) and (pairs.min() < 0 or pairs.max() >= count):
        bad = int(np.argmax((pairs[:, 0] < 0) | (pairs[:, 1] >= count)))
        raise JaxmarkError(f"Edge {bad}, {given[bad].tolist()}, has a vertex that is not among 0 to {count - 1}.")
    if (loops := pairs[:, 0] == pairs[:, 1]).any():
        bad = int(np.argmax(loops))
        raise JaxmarkError(f"Edge {bad}, {given[bad].tolist()}, joins a vertex to itself; leave such edges out.")
    values = None if weights is None else checked_weights(weights, len(pairs))
    found, first, which, copies = np.unique(
        pairs @ [max(count, 1), 1], return_index=True, return_inverse=True, return_counts=True
    )
    if len(found) < len(pairs):
        if duplicates == "refuse":
            pair = pairs[first[int(np.argmax(copies > 1))]].tolist()
            raise JaxmarkError(f"The edge {pair} is there more than once; merge them, or pass duplicates='add'.")
        values = np.bincount(which.reshape(-1), np.ones(len(pairs)) if values is None else values, len(found))
        pairs = pairs[first]
    return graph_laplacian(pairs, count, values, lowering=lowering)


def from_points(
    points: ArrayLike,
    neighbours: int = 10,
    weights: PointWeighting = "valence",
    *,
    lowering: Lowering = "auto",
) -> Laplacian:
    """Build the Laplacian of points, each joined to its nearest ones, on the host, in O(N log N) by SciPy's k-d tree.

    Two points are joined if one is among the nearest of the other.

    Args:
        points: positions `[N, dimensions]`.
        neighbours: number of nearest points that each is joined to, at least.
        weights: `"valence"`, each edge 1; `"inverse-length"`, 1 over its length; `"gaussian"`, exp(-l²/2σ²) of its
            length l, with σ the mean distance to the farthest of the nearest points.
        lowering: see `make_laplacian`.

    Returns:
        See `from_edges`.

    Raises:
        JaxmarkError: if the points are not finite, there are no more of them than neighbours, or two points are at the
            same position under `"inverse-length"`.
    """
    positions = np.asarray(points, np.float64)
    if positions.ndim != 2 or not np.isfinite(positions).all():
        raise JaxmarkError(f"Points are finite numbers [N, dimensions], got {positions.shape}.")
    if not 1 <= neighbours < len(positions):
        raise JaxmarkError(
            f"Each of {len(positions)} points has up to {len(positions) - 1} neighbours, not {neighbours}."
        )
    if weights not in get_args(PointWeighting):
        raise JaxmarkError(f"weights are {', '.join(map(repr, get_args(PointWeighting)))}, not {weights!r}.")
    pairs, reach = _nearest(positions, neighbours)
    if weights == "valence":
        return graph_laplacian(pairs, len(positions), lowering=lowering)
    lengths = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    if weights == "gaussian":
        return graph_laplacian(pairs, len(positions), np.exp(-(lengths**2) / (2 * reach**2 or 1.0)), lowering=lowering)
    if (lengths == 0).any():
        pair = pairs[int(np.argmin(lengths))].tolist()
        raise JaxmarkError(f"Points {pair} are at the same position; merge them, or use other weights.")
    return graph_laplacian(pairs, len(positions), 1 / lengths, lowering=lowering)


def _nearest(positions: Float64[np.ndarray, "points axes"], count: int) -> tuple[Int64[np.ndarray, "edges 2"], float]:
    """Pairs of points one of which is among the nearest of the other, and the mean distance of the last of these."""
    found = KDTree(positions).query(positions, count + 1)
    distance, nearest = (np.asarray(part) for part in found)
    size = len(positions)
    own = nearest == np.arange(size)[:, None]
    # Among many points at one position, a point may not be among its own nearest: then the last one is left out.
    own[~own.any(axis=1), -1] = True
    others = nearest[~own].reshape(size, count)
    pairs = np.sort(np.stack([np.repeat(np.arange(size), count), others.ravel()], axis=1), axis=1)
    codes = np.unique(pairs @ [size, 1])
    return np.stack(np.divmod(codes, size), axis=1), float(distance[:, -1].mean())
