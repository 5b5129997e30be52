"""Laplacians of meshes, of points and their nearest neighbours, of any edges, and of given matrices.

They are built on the host, as a `Laplacian` of NumPy arrays in float64 that computes in the dtype of the signal it is
applied to. Its `weights` are None if all are 1. `JaxmarkError` is raised for input that is not as described here.
"""

# `help` then shows the names of type aliases, such as ArrayLike, and not all that they stand for.
from __future__ import annotations

from typing import Any, Literal, get_args

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Float64, Int64
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.sparse import linalg
from scipy.spatial import KDTree

from jaxmark.errors import JaxmarkError, require
from jaxmark.geometry.mesh import Mesh, check_mesh, edges, face_pairs
from jaxmark.spectral.laplacian import Laplacian, Lowering, graph_laplacian, symmetric_matrix
from jaxmark.spectral.weights import Negative, cotangent_weights, inverse_length_weights, vertex_areas

Weighting = Literal["valence", "inverse-length", "cotangent", "robust"]
PointWeighting = Literal["valence", "inverse-length", "gaussian"]
Elements = Literal["vertices", "faces", "edges"]

_BOUND_MARGIN = 1.01  # over an estimate of the largest eigenvalue that is good to a thousandth
_MAX_MEETINGS = 100  # pairs of edges that meet, for each edge; in most meshes about five
_TRACED_LATER = "weights and masses, unlike `with_weights` of the operator,"
_ROUNDING = 1e-9  # of a matrix's rows that should sum to zero, relative to its diagonal


def from_mesh(
    mesh: Mesh,
    weights: Weighting | ArrayLike = "valence",
    *,
    negative: Negative = "clip",
    mass: Literal["areas"] | ArrayLike | None = None,
    bound: float | None = None,
    elements: Elements = "vertices",
    lowering: Lowering = "auto",
) -> Laplacian:
    """Build the graph Laplacian of a mesh.

    Vertices at the same position are *not* merged; see `jaxmark.geometry.mesh.weld`. Positions may be traced, for
    derivatives of filters with respect to them through weights and areas, which are traced arrays then.

    Args:
        mesh: any mesh, its faces concrete; boundary edges, edges of three faces or more, and several components are
            well defined.
        weights: `"valence"`, each edge 1, so that w_ij = 1/d(v_i) as in the paper; `"inverse-length"`, 1 over the
            edge's length; `"cotangent"`, see `jaxmark.spectral.weights.cotangent_weights`; `"robust"`, cotangents of an
            intrinsic Delaunay triangulation by `robust_laplacian` (Sharp, Crane, "A Laplacian for nonmanifold triangle
            meshes", 2020; extra `robust`), which are not negative, also on thin triangles, and join other pairs of
            vertices than the mesh does; or an array `[E]` of non-negative weights, in the order of
            `jaxmark.geometry.mesh.edges`.
        negative: what happens to negative cotangents, see `jaxmark.spectral.weights.cotangent_weights`. `"keep"` needs
            a mass: then Δ stays positive semidefinite, but not its random walk.
        mass: the lumped mass M of the generalised problem (D - W)x = λMx: `"areas"`, see
            `jaxmark.spectral.weights.vertex_areas`, or `[N]`. By default M = D.
        bound: with a mass, a bound of λ; filters are functions of 2λ/bound. By default 1 % above the largest λ, which
            is found by Lanczos iteration; for traced positions it must be given.
        elements: what the graph's vertices are: the mesh's `"vertices"`, joined by its edges; its `"faces"`, joined
            where two of them alone share an edge; or its `"edges"`, joined where they meet (the line graph). Faces and
            edges stand at their centres. They have no cotangents and areas, and weights for them come in the order of
            the operator's `edges`.
        lowering: how products are computed: `"segments"`, by segment-sums over the edges; `"gather"`, by a table of
            each vertex's neighbours; `"auto"`, by the table unless the valences differ so much that it does not pay on
            this platform.

    Raises:
        JaxmarkError: if vertices or faces have other shapes, a face refers to no vertex, a name is unknown, weights or
            masses are not one for each edge or vertex, finite and not negative, an edge has length zero under
            `"inverse-length"`, no edge has a positive weight under `"cotangent"`, a vertex with edges has no mass, or
            the bound is below the spectrum.
    """
    _check_name("Products are lowered by", lowering, Lowering)
    check_mesh(mesh)
    _check_concrete("from_mesh", "faces", mesh.faces)
    _check_concrete("from_mesh", _TRACED_LATER, weights, mass)
    traced = isinstance(mesh.vertices, Tracer)
    vertices = mesh.vertices if traced else np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces)
    _check_shapes(vertices, faces)
    if negative == "keep" and mass is None:
        raise JaxmarkError("negative='keep' needs a mass, such as 'areas'; without one the spectrum leaves [0, 2].")
    if isinstance(weights, str) and weights == "robust":
        return _robust(_of_vertices("robust weights", vertices, elements), faces, mass, bound, lowering)
    pairs, positions = _graph(vertices, faces, elements)
    if isinstance(weights, str):
        _check_name("weights are an array, or", weights, Weighting)
        by_name = {
            "valence": lambda: None,
            "inverse-length": lambda: inverse_length_weights(positions, pairs),
            "cotangent": lambda: cotangent_weights(_of_vertices("cotangents", vertices, elements), faces, negative),
        }
        values = by_name[weights]()
        if values is not None and not traced:
            if not np.isfinite(positions).all():
                raise JaxmarkError(f"A position is not finite, which {weights} weights need; mend it.")
            if not np.isfinite(values).all():
                bad = pairs[int(np.argmax(values))]
                raise JaxmarkError(f"Edge {bad.tolist()} has length zero; weld its vertices or use valence weights.")
            if not values.max(initial=0.0) > 0:
                raise JaxmarkError(f"No edge has a positive {weights} weight; use valence weights.")
    else:
        values = checked_weights(weights, len(pairs))
    masses: Any = mass
    if isinstance(mass, str):
        _check_name("mass is an array, or", mass, Literal["areas"])
        masses = vertex_areas(_of_vertices("areas", vertices, elements), faces)
    if not traced or not (isinstance(values, jax.Array) or isinstance(masses, jax.Array)):
        return _with_mass(graph_laplacian(pairs, len(positions), values, lowering=lowering), masses, bound)
    if masses is not None and not (bound is not None and np.isfinite(bound) and bound > 0):
        raise JaxmarkError(
            "Traced positions need a positive bound of the spectrum; 2 * operator.scale is that of like meshes."
        )
    weighted = graph_laplacian(pairs, len(positions), np.ones(len(pairs)), lowering=lowering)
    weighted = weighted.with_weights(np.ones(len(pairs)) if values is None else values, masses)
    return weighted if masses is None or bound is None else weighted._replace(scale=np.float64(bound / 2))


def _check_shapes(vertices: Any, faces: np.ndarray) -> None:
    """Refuse arrays that are no mesh, as `from_mesh` describes."""
    if np.ndim(vertices) != 2 or vertices.shape[1] != 3:
        raise JaxmarkError(f"The vertices of a mesh are an array [N, 3], got the shape {np.shape(vertices)}.")
    if faces.size and (faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer)):
        raise JaxmarkError(f"The faces of a mesh are whole numbers [F, 3], got {faces.dtype} {faces.shape}.")
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        bad = faces.max() if faces.max() >= len(vertices) else faces.min()
        raise JaxmarkError(
            f"A face refers to vertex {bad}, but the mesh has {len(vertices)} vertices, numbered from 0."
        )


def from_matrices(
    stiffness: Any, mass: Any = None, *, bound: float | None = None, lowering: Lowering = "auto"
) -> Laplacian:
    """Build the operator of a stiffness matrix S = D - W, such as of `robust_laplacian` or `libigl`.

    Args:
        stiffness: `[N, N]`, any sparse matrix of SciPy's, or a dense one: symmetric, with rows that sum to zero, and
            nothing positive off the diagonal.
        mass: M, a diagonal matrix `[N, N]` or its diagonal `[N]`, positive at vertices with edges. By default the
            diagonal of the stiffness.
        bound: as in `from_mesh`.
        lowering: as in `from_mesh`.
    """
    matrix: Any = sparse.coo_array(stiffness).astype(np.float64)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise JaxmarkError(f"A stiffness matrix is square, got {matrix.shape}.")
    size, diagonal = matrix.shape[0], matrix.diagonal()
    small = _ROUNDING * np.abs(diagonal).max(initial=0)
    if not abs(matrix - matrix.T).max() <= small or not np.abs(matrix.sum(axis=1)).max(initial=0) <= small:
        raise JaxmarkError("A stiffness matrix is symmetric and finite, and its rows sum to zero.")
    upper: Any = sparse.triu(matrix, 1).tocoo()
    if upper.data.max(initial=0) > small:
        bad = int(np.argmax(upper.data))
        raise JaxmarkError(
            f"The edge [{upper.row[bad]}, {upper.col[bad]}] has the weight {-upper.data[bad]:.3g}; filters need weights"
            " that are not negative, such as those of an intrinsic Delaunay triangulation."
        )
    kept = upper.data < 0
    pairs = np.stack([upper.row[kept], upper.col[kept]], axis=1).astype(np.int64)
    if sparse.issparse(mass) or np.ndim(mass) == 2:
        square = sparse.coo_array(mass)
        if (square.row != square.col).any():
            raise JaxmarkError("A lumped mass is a diagonal matrix, or its diagonal.")
        mass = square.diagonal()
    return _with_mass(graph_laplacian(pairs, size, -upper.data[kept], lowering=lowering), mass, bound)


def _robust(
    vertices: Any, faces: Int64[np.ndarray, "faces 3"], mass: Any, bound: float | None, lowering: Lowering
) -> Laplacian:
    """Build the operator of an intrinsic Delaunay triangulation, see `from_mesh`."""
    if isinstance(vertices, Tracer):
        raise JaxmarkError("Robust weights need concrete vertices; use cotangent weights under jit, vmap or grad.")
    stiffness, masses = require("robust_laplacian", "robust").mesh_laplacian(vertices, faces)
    beside = sparse.triu(stiffness, 1)
    joined = sparse.csr_array(beside + beside.T)
    degree = -np.asarray(joined.sum(axis=1)).ravel()
    if isinstance(mass, str):
        _check_name("mass is an array, or", mass, Literal["areas"])
        mass = np.where(degree > 0, masses.diagonal(), 0)  # the package gives lone vertices a little
    return from_matrices(joined + sparse.diags_array(degree), mass, bound=bound, lowering=lowering)


def checked_weights(weights: ArrayLike, count: int) -> Float64[np.ndarray, " edges"]:
    """Return the weights of `count` edges as an array; refuse other numbers of them, and negative and infinite ones."""
    values = np.asarray(weights, np.float64)
    if values.shape != (count,):
        raise JaxmarkError(f"weights must have one value for each of the {count} edges, got {values.shape}.")
    if not (np.isfinite(values) & (values >= 0)).all():
        raise JaxmarkError("weights must be finite and not negative; otherwise the spectrum leaves [0, 2].")
    return values


def from_edges(
    edges: ArrayLike,
    weights: ArrayLike | None = None,
    size: int | None = None,
    *,
    mass: ArrayLike | None = None,
    bound: float | None = None,
    duplicates: Literal["refuse", "add"] = "refuse",
    lowering: Lowering = "auto",
) -> Laplacian:
    """Build the Laplacian of an undirected graph from its edges.

    Args:
        edges: pairs of vertices `[E, 2]`, numbered from 0, none from a vertex to itself; their direction does not
            matter.
        weights: `[E]`, finite and not negative; all 1 unless given.
        size: number of vertices; by default one more than the largest number.
        mass: `[size]`, the lumped mass M, as in `from_mesh`.
        bound: as in `from_mesh`.
        duplicates: what to do with a pair that occurs twice, in one direction or in both: `"refuse"`, or `"add"` the
            weights, as SciPy's sparse matrices do. This doubles all weights of a graph of directed edges, each in both
            directions, which leaves Δ as it is.
        lowering: as in `from_mesh`.
    """
    _check_concrete("from_edges", "edges", edges)
    _check_concrete("from_edges", _TRACED_LATER, weights, mass)
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
    return _with_mass(graph_laplacian(pairs, count, values, lowering=lowering), mass, bound)


def from_points(
    points: ArrayLike,
    neighbours: int = 10,
    weights: PointWeighting = "valence",
    *,
    lowering: Lowering = "auto",
) -> Laplacian:
    """Build the Laplacian of points, each joined to its nearest ones, in O(N log N) by SciPy's k-d tree.

    Two points are joined if one is among the nearest of the other.

    Args:
        points: positions `[N, dimensions]`.
        neighbours: number of nearest points that each is joined to, at least; less than N.
        weights: `"valence"`, each edge 1; `"inverse-length"`, 1 over its length, which must not be 0; `"gaussian"`,
            exp(-l²/2σ²) of its length l, with σ the mean distance to the farthest of the nearest points.
        lowering: as in `from_mesh`.
    """
    _check_concrete("from_points", "points", points)
    positions = np.asarray(points, np.float64)
    if positions.ndim != 2 or not np.isfinite(positions).all():
        raise JaxmarkError(f"Points are finite numbers [N, dimensions], got {positions.shape}.")
    if not 1 <= neighbours < len(positions):
        raise JaxmarkError(
            f"Each of {len(positions)} points has up to {len(positions) - 1} neighbours, not {neighbours}."
        )
    _check_name("weights are", weights, PointWeighting)
    pairs, reach = nearest_pairs(positions, neighbours)
    lengths, values = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1), None
    if weights == "gaussian":
        values = np.exp(-(lengths**2) / (2 * reach**2 or 1.0))
    elif weights == "inverse-length":
        if (lengths == 0).any():
            pair = pairs[int(np.argmin(lengths))].tolist()
            raise JaxmarkError(f"Points {pair} are at the same position; merge them, or use other weights.")
        values = 1 / lengths
    return graph_laplacian(pairs, len(positions), values, lowering=lowering)


def nearest_pairs(
    positions: Float64[np.ndarray, "points axes"], count: int
) -> tuple[Int64[np.ndarray, "edges 2"], float]:
    """Find the pairs of points that are neighbours, and the mean distance to the farthest neighbour."""
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


def _graph(
    vertices: Float[Array | np.ndarray, "vertices 3"], faces: np.ndarray, elements: Elements
) -> tuple[Int64[np.ndarray, "edges 2"], Float[Array | np.ndarray, "elements 3"]]:
    """Return the edges of the graph of a mesh's elements, and the elements' positions."""
    match elements:
        case "vertices":
            return edges(faces), vertices
        case "faces":
            return face_pairs(faces)[0], vertices[faces].mean(axis=1)
        case "edges":
            pairs = edges(faces)
            return _meetings(pairs), vertices[pairs].mean(axis=1)
    raise JaxmarkError(f"Elements are {', '.join(map(repr, get_args(Elements)))}, not {elements!r}.")


def _meetings(pairs: Int64[np.ndarray, "edges 2"]) -> Int64[np.ndarray, "meetings 2"]:
    """Find the pairs of edges that share a vertex, each pair once."""
    ends = pairs.T.ravel()
    order = np.argsort(ends, kind="stable")
    around = order % max(len(pairs), 1)  # the edges around the first vertex, then around the second, and so on
    count = np.bincount(ends)
    # Each edge meets those after it around the same vertex.
    after = np.repeat(np.cumsum(count), count) - np.arange(len(ends)) - 1
    if after.sum() > _MAX_MEETINGS * len(pairs):
        raise JaxmarkError(
            f"Vertex {int(np.argmax(count))} has {count.max()} edges, all of which meet; the line graph is too large."
        )
    first = np.repeat(np.arange(len(ends)), after)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(after) - after, after)
    return np.sort(np.stack([around[first], around[second]], axis=1), axis=1)


def _of_vertices(what: str, vertices: Any, elements: Elements) -> Any:
    if elements != "vertices":
        raise JaxmarkError(f"The {what} of a mesh belong to its vertices, not to its {elements}.")
    return vertices


def _with_mass(operator: Laplacian, mass: ArrayLike | None, bound: float | None) -> Laplacian:
    """Put a lumped mass in, and half a bound of the spectrum."""
    if mass is None:
        if bound is not None:
            raise JaxmarkError("A bound belongs to a mass; without one the spectrum is in [0, 2].")
        return operator
    values, size = np.asarray(mass, np.float64), len(operator.degree)
    if values.shape != (size,) or not (np.isfinite(values) & (values >= 0)).all():
        raise JaxmarkError(f"A mass is one number for each of {size} vertices, finite and not negative.")
    linked = np.asarray(operator.degree) > 0
    if (lacking := linked & (values == 0)).any():
        raise JaxmarkError(
            f"Vertex {int(np.argmax(lacking))} has edges, but no mass; remove degenerate faces, use weights='robust',"
            " or pass other masses."
        )
    # The largest λ is no smaller than any diagonal element of M⁻¹(D - W).
    least = float(np.max(np.asarray(operator.degree)[linked] / values[linked], initial=0))
    if bound is not None and not (np.isfinite(bound) and bound > 0 and bound >= least):
        raise JaxmarkError(f"{bound:g} is no bound of the spectrum, which reaches {least:g} at least.")
    with_mass = operator._replace(lumped_mass=values, scale=np.float64(1))
    return with_mass._replace(scale=np.float64((_bound(with_mass) if bound is None else bound) / 2))


def _bound(operator: Laplacian) -> float:
    """Bound the spectrum of M⁻¹(D - W), by its rows (Gershgorin) or by the largest eigenvalue and a margin."""
    linked, root, scaled = symmetric_matrix(operator)
    if len(linked) == 0:
        return 2.0
    # Rows of M⁻¹(D - W) by size: twice the diagonal, or more with negative weights.
    by_rows = float((abs(scaled) @ root / root).max())
    if len(linked) < 3:
        return by_rows
    start = np.cos(np.arange(len(linked), dtype=np.float64))  # a fixed start makes the result repeatable
    found: Any = linalg.eigsh(scaled, 1, which="LA", tol=1e-3, v0=start, return_eigenvectors=False)  # pyright: ignore[reportArgumentType]
    return min(by_rows, _BOUND_MARGIN * float(found[0]))


def _check_concrete(function: str, name: str, *values: Any) -> None:
    """Refuse traced values: the graph of an operator is built on the host."""
    if any(isinstance(value, Tracer) for value in values):
        raise JaxmarkError(
            f"{function} needs concrete {name}, but is called under jit, vmap or grad; build the operator before, and"
            " pass it as an argument."
        )


def _check_name(sentence: str, name: str, names: Any) -> None:
    if name not in get_args(names):
        raise JaxmarkError(f"{sentence} {', '.join(map(repr, get_args(names)))}, not {name!r}.")
