"""The graph Laplacian of a mesh as edge arrays; all filters are functions of this operator.

Δ = I - D⁻¹W with symmetric non-negative edge weights W and the diagonal D of their row sums (Sohn et al., eq. 4-5; the
paper prints D = diag(1/d), but its Lemma 3.1 holds for D = diag(d)). The spectrum is real and lies in [0, 2], and Δ is
self-adjoint in the inner product ⟨x, y⟩_D = xᵀDy.

With a lumped mass M, Δ = M⁻¹(D - W)/s stands for the generalised problem (D - W)x = λMx of finite elements, where s is
half a bound of its spectrum: an eigenvalue λ of that is λ/s of Δ, in [0, 2] as well, and Δ is self-adjoint in
⟨x, y⟩_M = xᵀMy. Without one, M = D and s = 1.
"""

from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int, Int64, Num, Shaped
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.errors import JaxmarkError
from jaxmark.spectral.kernels import Rows
from jaxmark.spectral.precision import check_precision

Lowering = Literal["auto", "gather", "segments"]
Signal = Float[Array | np.ndarray, " vertices *columns"]
Values = Shaped[Array, " vertices *columns"]

# The cost of adding to a row at any index, in units of reading a row, by measurement: 8 on processors, 5 to 7 on GPUs.
_SCATTER_COST = 8
_SCATTER_COST_PER_VERTEX = 4  # what a pass of such additions costs beside them, however few they are, in the same unit
MIN_LARGE_VALUES = 2**16  # values of a signal from which on running the recurrence takes longer than compiling it
_MIN_ORDERED_VERTICES = 2**14  # from here on a signal outgrows the fastest memory, and reordering vertices pays


@runtime_checkable
class Operator(Protocol):
    """The part of Δ that filters need, M and products: a `Laplacian`, or one device's part of it.

    Products take and give rows in the operator's own order, in which neighbours are near in memory: signals `enter` it
    before the first product, and results `leave` it after the last.
    """

    @property
    def mass(self) -> Float[Array | np.ndarray, " vertices"]:
        """The diagonal of M; 0 where a vertex is isolated, unless it has a mass of its own."""
        ...

    def linked(self, like: Values) -> Bool[Array, " vertices *ones"]:
        """Return a mask of the vertices that have edges, to select from signals like this."""
        ...

    @property
    def by_segments(self) -> "Operator":
        """The same operator in the vertices' order, by sums over edges, whose derivatives by weights only read rows."""
        ...

    def product(self, like: Values) -> Callable[[Values], Values]:
        """Return the map x → Δx in the operator's own order, for signals of the shape and dtype of `like`.

        Call this outside of loops, for it computes what all products share.
        """
        ...

    def rows(self, like: Values) -> Rows | None:
        """Return the rows of Δ - I for compiled kernels, in the dtype of `like`; None if they are not all at hand."""
        ...

    def enter(self, x: Values) -> Values:
        """Reorder rows from the vertices' order to the operator's own."""
        ...

    def leave(self, x: Values) -> Values:
        """Reorder rows from the operator's own order to the vertices' order."""
        ...


class Neighbours(NamedTuple):
    """Each vertex's neighbours in a table of few slots; neighbours without a slot are added one by one.

    Reading rows is several times faster than adding to them, and is shared by the cores. Vertices are numbered in the
    operator's own order here; `order` and `rank` convert from and to the mesh's.
    """

    vertices: Int[Array | np.ndarray, "slots vertices"]  # neighbour in each slot; the vertex itself if it is empty
    empty: Int[Array | np.ndarray, " vertices"]  # number of empty slots
    rest: Int[Array | np.ndarray, "rest 3"]  # vertex, neighbour, edge without a slot; padding is past the last vertex
    edges: Int[Array | np.ndarray, "slots vertices"] | None  # past the last edge if empty; None without edge weights
    order: Int[Array | np.ndarray, " vertices"] | None = None  # the vertex of each row; None if the orders are the same
    rank: Int[Array | np.ndarray, " vertices"] | None = None  # the row of each vertex; None if the orders are the same


class Laplacian(NamedTuple):
    """Δ = I - D⁻¹W of a graph with N vertices and E undirected edges, as a pytree of arrays.

    An isolated vertex, one without edges, has a row of zeros: Δx is 0 there, and a filter multiplies its value by the
    gain at 0. It has no mass, so no M-orthonormal eigenvector contains it: eigenpairs, traces and quadratic forms are
    those of the vertices that have edges.
    """

    edges: Int[Array | np.ndarray, "edges 2"]  # each once, no vertex joined to itself; padding is past the last vertex
    weights: Float[Array | np.ndarray, " edges"] | None  # W, symmetric by construction; None if all are 1
    degree: Float[Array | np.ndarray, " vertices"]  # D: the row sums of W, 0 where a vertex is isolated
    neighbours: Neighbours | None = None  # the edges once more, as a table for products by gathering
    lumped_mass: Float[Array | np.ndarray, " vertices"] | None = None  # M, such as areas; None if it is D
    scale: Float[Array | np.ndarray, ""] | None = None  # s, half a bound of the spectrum of M⁻¹(D - W); None if it is 1

    @property
    def mass(self) -> Float[Array | np.ndarray, " vertices"]:
        """M, which weighs vertices in the inner product: the lumped mass, or else the degrees."""
        return self.degree if self.lumped_mass is None else self.lumped_mass

    def with_weights(
        self,
        weights: Float[Array | np.ndarray, " edges"],
        lumped_mass: Float[Array | np.ndarray, " vertices"] | None = None,
    ) -> "Laplacian":
        """Replace the weights, and the mass, as a pure function with derivatives.

        Args:
            weights: not negative, in the order of `edges`. Products are by table only if the operator had weights.
            lumped_mass: M, positive; by default the operator's own, or the new degrees if it has none.

        Returns:
            The operator, with the same `scale`: with a mass, the spectrum of M⁻¹(D - W) must stay below twice that.

        Raises:
            JaxmarkError: if there is not one weight for each edge.
        """
        values = jnp.asarray(weights)
        if values.shape != self.edges.shape[:1]:
            raise JaxmarkError(f"The operator has {len(self.edges)} edges; got weights of the shape {values.shape}.")
        degree = sum(jax.ops.segment_sum(values, end, len(self.degree)) for end in jnp.asarray(self.edges).T)
        mass = self.lumped_mass if lumped_mass is None else lumped_mass
        return self._replace(weights=values, degree=degree, lumped_mass=mass)

    @property
    def by_segments(self) -> "Laplacian":
        """The same operator without a table of neighbours; see `Operator`."""
        return self._replace(neighbours=None)

    @jax.jit
    def apply(self, x: Values) -> Values:
        """Compute Δx for one signal `[N]` or several `[N, C]`, in the dtype of `x`, which must be floating.

        Raises:
            JaxmarkError: if the signal has another number of rows, or is not floating.
        """
        if x.shape[:1] != self.degree.shape:
            raise JaxmarkError(f"Laplacian.apply needs a signal of {len(self.degree)} vertices, got {x.shape}.")
        return self.leave(self.product(x)(self.enter(x)))

    def product(self, like: Values) -> Callable[[Values], Values]:
        """Return the map x → Δx; see `Operator`.

        Raises:
            JaxmarkError: if the signal is not floating.
        """
        if not jnp.issubdtype(like.dtype, jnp.floating):
            raise JaxmarkError(f"Laplacian.apply needs a floating-point signal, got {like.dtype}.")
        own, inverse = self._own(like)
        total = self._by_edges(like) if self._table is None else self._by_table(self._table, like)
        return lambda x: own * x - inverse * total(x)

    def rows(self, like: Values) -> Rows | None:
        """Return the rows of Δ - I for compiled kernels; see `Operator`."""
        table, flat = self._table, like.reshape(len(like), -1)[:, 0]
        if table is None:
            return None
        own, inverse = self._own(flat)
        weights, rest_weights = self._table_weights(table, like)
        return Rows(table.vertices, weights, own - 1, inverse, table.rest, rest_weights, table.order)

    def _own(self, like: Array) -> tuple[Array, Array]:
        """Return the diagonal of Δ, and the factor of the sums over neighbours, in the operator's own order."""
        degree, inverse = (self.enter(rows) for rows in (per_row(self.degree, like), self.inverse_mass(like)))
        own = (degree > 0).astype(like.dtype) if self.lumped_mass is None else degree * inverse
        if self.weights is None and self._table is not None:
            # An empty slot adds the vertex's own row, which is made up for here.
            own += inverse * per_row(self._table.empty, like)
        return own, inverse

    def linked(self, like: Values) -> Bool[Array, " vertices *ones"]:
        """Return a mask of the vertices that have edges; see `Operator`."""
        return per_row(self.degree, like) > 0

    def inverse_mass(self, like: Values) -> Float[Array, " vertices *ones"]:
        """1/(M s), by which sums over neighbours are divided, to multiply signals like this; 0 at isolated vertices."""
        # Select before dividing, so that isolated vertices keep finite gradients.
        linked = self.linked(like)
        mass = per_row(self.mass, like)
        mass = mass if self.scale is None else mass * jnp.asarray(self.scale).astype(like.dtype)
        return jnp.where(linked, 1 / jnp.where(linked, mass, 1), 0)

    def enter(self, x: Values) -> Values:
        """Reorder rows to the operator's own order; see `Operator`."""
        return x if self._table is None or self._table.order is None else x[self._table.order]

    def leave(self, x: Values) -> Values:
        """Reorder rows to the vertices' order; see `Operator`."""
        return x if self._table is None or self._table.rank is None else x[self._table.rank]

    @property
    def _table(self) -> Neighbours | None:
        """The table; None, for products by segment-sums, if weights were put in later that the table cannot look up."""
        table = self.neighbours
        return None if table is None or (self.weights is not None and table.edges is None) else table

    def _table_weights(self, table: Neighbours, like: Array) -> tuple[Array | None, Array | None]:
        """Return the weights of the edges in the table's slots, and of those without a slot; None if all are 1."""
        if self.weights is None or table.edges is None:
            return None, None
        padded = jnp.append(jnp.asarray(self.weights).astype(like.dtype), 0)
        return padded[table.edges], padded[table.rest[:, 2]]

    def _by_table(self, table: Neighbours, like: Array) -> Callable[[Array], Array]:
        """Return the map x → Wx, slot by slot; without weights, each empty slot adds the vertex's own row."""
        weights, rest_weights = self._table_weights(table, like)
        factors = [1.0] * len(table.vertices) if weights is None else [per_row(slot, like) for slot in weights]
        rest, factor = jnp.asarray(table.rest), 1.0 if rest_weights is None else per_row(rest_weights, like)

        def read(x: Array) -> Iterable[Array]:
            # One gather for all slots leaves less to compile than one for each slot, but takes longer to run.
            if x.size < MIN_LARGE_VALUES:
                return take_rows(x, table.vertices)
            return (take_rows(x, vertices) for vertices in table.vertices)

        def total(x: Array) -> Array:
            found = sum((weight * rows for weight, rows in zip(factors, read(x), strict=True)), jnp.zeros_like(x))
            return found.at[rest[:, 0]].add(factor * x[rest[:, 1]]) if len(rest) else found

        return total

    def _by_edges(self, like: Array) -> Callable[[Array], Array]:
        """Return the map x → Wx by two segment-sums over the edges."""
        tail, head = self.edges[:, 0], self.edges[:, 1]
        weights = 1 if self.weights is None else per_row(self.weights, like)
        size = self.degree.shape[0]
        return lambda x: (
            jax.ops.segment_sum(weights * x[head], tail, size) + jax.ops.segment_sum(weights * x[tail], head, size)
        )

    @jax.jit
    def inner(self, x: Values, y: Values) -> Float[Array, " *columns"]:
        """Compute the inner product ⟨x, y⟩_M = Σ_v M_v x_v y_v: a scalar for `[N]`; `[C]`, by columns, for `[N, C]`.

        Raises:
            JaxmarkError: if the shapes differ, or the values are neither float32 nor float64.
        """
        check_precision("Laplacian.inner", x)
        check_precision("Laplacian.inner", y)
        if x.shape != y.shape:
            raise JaxmarkError(f"Laplacian.inner needs two signals of one shape, got {x.shape} and {y.shape}.")
        return jnp.sum(per_row(self.mass, x) * x * y, axis=0)


def graph_laplacian(
    pairs: Int[np.ndarray, "edges 2"],
    size: int,
    weights: Float64[np.ndarray, " edges"] | None = None,
    *,
    lowering: Lowering = "auto",
) -> Laplacian:
    """Build the Laplacian of a graph of `size` vertices, on the host; nothing is checked.

    Each edge is there once, none from a vertex to itself. Weights are finite and not negative, all 1 unless given;
    `lowering` is as in `jaxmark.spectral.graphs.from_mesh`.
    """
    degree = np.bincount(pairs.ravel(), None if weights is None else np.repeat(weights, 2), size).astype(np.float64)
    neighbours = None
    if lowering != "segments":
        order = cuthill_mckee(pairs, size) if size >= _MIN_ORDERED_VERTICES else None
        neighbours = make_neighbours(pairs, size, order, weighted=weights is not None, if_cheaper=lowering == "auto")
    return Laplacian(pairs.astype(np.int32), weights, degree, neighbours)


def make_neighbours(
    pairs: Int[np.ndarray, "edges 2"],
    size: int,
    order: Int[np.ndarray, " vertices"] | None = None,
    *,
    weighted: bool,
    if_cheaper: bool = False,
    slots: int | None = None,
) -> Neighbours | None:
    """Build the table of neighbours in a graph of `size` vertices, which looks weights up if edges are `weighted`.

    The rows are in the vertices' own order unless their `order` is given. The number of slots is by default the even
    number, or the next one, that makes a product cheapest. With `if_cheaper`, None is returned where segment-sums are
    cheaper.
    """
    rank = None if order is None else np.argsort(order).astype(np.int32)
    graph = adjacency(pairs if rank is None else rank[pairs], size)
    head, edge, valence = graph.indices, graph.data, np.diff(graph.indptr)
    tail = np.repeat(np.arange(size, dtype=np.int32), valence)
    slot = np.arange(len(tail), dtype=np.int32) - np.repeat(graph.indptr[:-1].astype(np.int32), valence)
    left = len(tail) - np.cumsum(np.bincount(slot))  # number of neighbours without a slot, for one slot, two, …
    costs = size * np.arange(1, 1 + len(left)) + _SCATTER_COST * left + _SCATTER_COST_PER_VERTEX * size * (left > 0)
    if if_cheaper and (len(left) == 0 or costs.min() > _SCATTER_COST * len(tail)):
        return None
    if slots is None:
        # The number is made even, so that more meshes share the shape of their table.
        slots = 1 + int(np.argmin(costs)) if len(left) else 0
        slots += slots % 2
    fits = slot < slots
    # An empty slot reads the vertex's own row, which is in the cache already.
    vertices = np.tile(np.arange(size, dtype=np.int32), (slots, 1))
    vertices[slot[fits], tail[fits]] = head[fits]
    edges = None
    if weighted:
        edges = np.full((slots, size), len(pairs), np.int32)
        edges[slot[fits], tail[fits]] = edge[fits]
    rest = np.stack([column[~fits] for column in (tail, head, edge)], axis=1).astype(np.int32)
    empty = slots - np.minimum(valence, slots)
    orders = (None, None) if rank is None or order is None else (order.astype(np.int32), rank)
    return Neighbours(vertices, empty.astype(np.int32), rest, edges, *orders)


def cuthill_mckee(pairs: Int[np.ndarray, "edges 2"], size: int) -> Int64[np.ndarray, " vertices"]:
    """Order the vertices so that neighbours are near each other (reverse Cuthill-McKee)."""
    return csgraph.reverse_cuthill_mckee(adjacency(pairs, size), symmetric_mode=True).astype(np.int64)


def adjacency(pairs: Int[np.ndarray, "edges 2"], size: int) -> sparse.csr_array:
    """Return the adjacency matrix of the edges, with the numbers of the edges as entries."""
    pairs = pairs.astype(np.int32, copy=False)
    (tail, head), edge = np.concatenate([pairs, pairs[:, ::-1]]).T, np.tile(np.arange(len(pairs), dtype=np.int32), 2)
    return sparse.csr_array(sparse.coo_array((edge, (tail, head)), shape=(size, size)))


def take_rows(x: Array | np.ndarray, places: Int[Array | np.ndarray, " *places"]) -> Array:
    """Read the rows at places that are certainly between 0 and the number of rows, which leaves less to compile."""
    return jnp.asarray(x).at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)


def per_row(values: Num[Array | np.ndarray, " rows"], x: Array | np.ndarray) -> Array:
    """Cast one value per row, such as D, to the dtype of `x`, and shape it to broadcast against its columns."""
    return jnp.asarray(values).astype(x.dtype).reshape(-1, *[1] * (x.ndim - 1))


def checked_signal(name: str, operator: Operator, x: Array | np.ndarray) -> Array:
    """Return a signal as a JAX array, and refuse one that is not of the operator's vertices, or in half precision.

    Raises:
        JaxmarkError: if it is not `[N]` or `[N, C]`, in float32 or float64.
    """
    x = jnp.asarray(x)
    if x.ndim not in (1, 2) or x.shape[0] != operator.mass.shape[0]:
        raise JaxmarkError(
            f"{name} needs a signal [N] or [N, C] with N = {operator.mass.shape[0]} vertices, got {x.shape}."
        )
    check_precision(name, x)
    return x


def centre(
    operator: Laplacian, x: Float[Array | np.ndarray, " vertices *columns"]
) -> Float64[np.ndarray, " vertices *columns"]:
    """Subtract the M-weighted mean of each connected component, on the host in float64.

    The result has no part in the null space of Δ, so that a filtered signal does not depend on where the object, or any
    piece of it, is placed. Centre before casting to float32, or large offsets eat the digits. An isolated vertex
    becomes 0.

    Raises:
        JaxmarkError: if the signal is not `[N]` or `[N, C]`.
    """
    shape, x = np.shape(x), np.asarray(x, np.float64)
    if x.ndim not in (1, 2) or len(x) != operator.mass.shape[0]:
        raise JaxmarkError(f"centre needs a signal [N] or [N, C], N = {operator.mass.shape[0]} vertices, got {shape}.")
    if not x.size:
        return x
    x = x.reshape(len(x), -1)
    mass = np.asarray(operator.mass, np.float64)
    size = len(mass)
    pairs, weights = host_edges(operator)
    # An edge of weight zero joins nothing.
    tail, head = pairs[weights != 0].T
    graph = sparse.coo_array((np.ones(len(tail)), (tail, head)), shape=(size, size))
    count, component = csgraph.connected_components(graph, directed=False)
    mass = np.where(mass > 0, mass, 1.0)
    total = np.bincount(component, mass, count)[:, None]
    for _ in range(2):  # the second pass removes the rounding errors that the first leaves at large offsets
        x = x - (np.stack([np.bincount(component, mass * column, count) for column in x.T], axis=1) / total)[component]
    return x.reshape(shape)


def sparse_matrices(operator: Laplacian) -> tuple[sparse.csr_array, sparse.dia_array]:
    """((D - W)/s, M) as SciPy sparse matrices in float64, for host-side linear algebra; M⁻¹(D - W)/s is Δ."""
    degree = np.asarray(operator.degree, np.float64)
    pairs, weights = host_edges(operator)
    adjacency = sparse.coo_array((weights, tuple(pairs.T)), shape=(len(degree), len(degree)))
    stiffness = sparse.csr_array(sparse.diags_array(degree) - adjacency - adjacency.T)
    stiffness.eliminate_zeros()
    if operator.scale is not None:
        stiffness = stiffness / float(operator.scale)
    return stiffness, sparse.diags_array(np.asarray(operator.mass, np.float64))


def symmetric_matrix(operator: Laplacian) -> tuple[Int64[np.ndarray, " linked"], np.ndarray, sparse.csr_array]:
    """Return the vertices that have edges, √M on them, and the symmetric form M^½ΔM^-½ of Δ on them, on the host."""
    stiffness, mass = sparse_matrices(operator)
    linked = np.flatnonzero(np.asarray(operator.degree) > 0)
    root = np.sqrt(mass.diagonal()[linked])
    inverse = sparse.diags_array(1 / root)
    return linked, root, inverse @ stiffness[linked][:, linked] @ inverse


def host_edges(operator: Laplacian) -> tuple[Int[np.ndarray, "edges 2"], Float64[np.ndarray, " edges"]]:
    """Return the edges without padding, and their weights, as NumPy arrays; weights are 1 if the operator has none."""
    pairs = np.asarray(operator.edges)
    real = pairs[:, 0] < len(operator.degree)
    weights = np.ones(len(pairs)) if operator.weights is None else np.asarray(operator.weights, np.float64)
    return pairs[real], weights[real]
