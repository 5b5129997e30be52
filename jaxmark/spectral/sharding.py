"""Filters of the Laplacian over several devices, in one process or in several.

Vertices are ordered along a curve, or by reverse Cuthill-McKee, and cut into blocks of equal size, one per device. A
device holds the edges within its block as a `Laplacian` of its own, and the edges that the partition cuts as triples.
For each product it receives only the vertices at the other ends of cut edges, by a few `ppermute`s of fixed width. To
`jaxmark.spectral.chebyshev` a device's part is an operator like any other, so that filters and their derivatives are
the same code as on one device.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int, Int64, Shaped
from numpy.typing import ArrayLike

from jaxmark.errors import JaxmarkError
from jaxmark.spectral import chebyshev
from jaxmark.spectral.laplacian import Laplacian, Neighbours, cuthill_mckee, host_edges, make_neighbours, per_row

_AXIS = "devices"
_MAX_PADDING = 0.12  # as a share of the rows needed: with padding, flows of unlike width share fewer rounds
_BITS_PER_AXIS = 20  # resolution of the curve; three coordinates fit into a 64-bit integer

Devices = Sequence[jax.Device]  # pyright: ignore[reportInvalidTypeForm] (JAX declares it as a variable)
Round = tuple[tuple[int, int], ...]  # pairs (from, to); each device sends at most once, and receives at most once


@jax.tree_util.register_static
@dataclass(frozen=True)
class Plan:
    """The part of a partition that is static while tracing."""

    vertices: int  # N
    cut: int  # number of undirected edges between devices
    boundary: int  # number of rows needed elsewhere: each vertex once for each other device that it has an edge to
    rounds: tuple[Round, ...]  # which devices exchange rows in each round
    mesh: Mesh | None = None  # the mesh of devices; None until the parts are placed on them


class Shard(NamedTuple):
    """One device's part of Δ, an `Operator` within `shard_map`."""

    interior: Laplacian  # the edges within the block, but with the degrees of the whole graph
    sends: tuple[Int[Array | np.ndarray, " width"], ...]  # the rows to send in each round; padding is any row
    cut: Int[Array | np.ndarray, "cut 2"]  # edges to other devices: own row, and place among the received rows
    weights: Float[Array | np.ndarray, " cut"]  # weights of these edges; padding is 0
    plan: Plan

    @property
    def mass(self) -> Float[Array | np.ndarray, " rows"]:
        """The diagonal of M for the block's rows; 0 past the last vertex."""
        return self.interior.mass

    def linked(self, like: Array) -> Array:
        """Return a mask of the block's vertices that have edges; see `Operator`."""
        return self.interior.linked(like)

    @property
    def by_segments(self) -> "Shard":
        """The same operator by sums over edges; see `Operator`."""
        return self._replace(interior=self.interior.by_segments)

    def product(self, like: Array) -> Callable[[Array], Array]:
        """Return the map x → Δx on the block's rows, for use within `shard_map`; see `Operator`."""
        inside = self.interior.product(like)
        row, place = jnp.asarray(self.cut).T
        factor = per_row(self.weights, like) * self.interior.inverse_mass(like)[row]
        # The received rows are used last, so that the block's own edges are computed while rows are on their way.
        return lambda x: inside(x).at[row].add(-factor * self._received(x)[place])

    def rows(self, like: Array) -> None:
        """Return None, as some rows are on other devices; see `Operator`."""

    def enter(self, x: Array) -> Array:
        """Return the rows as they are: the partition has put them in a good order."""
        return x

    def leave(self, x: Array) -> Array:
        """Return the rows as they are."""
        return x

    def _received(self, x: Array) -> Array:
        """Exchange rows, round by round, and return those that this device needs of others."""
        rounds = zip(self.sends, self.plan.rounds, strict=True)
        return jnp.concatenate([x[:0], *(jax.lax.ppermute(x[rows], _AXIS, pairs) for rows, pairs in rounds)])


class ShardedLaplacian(NamedTuple):
    """Δ in parts, one per device. Values per vertex are `[devices, rows]` or `[devices, rows, C]`.

    With several processes, pass it to functions under `jit` as an argument: JAX cannot close over arrays of which other
    processes hold parts.
    """

    shards: Shard  # every array has a leading axis of devices
    vertices: Int[Array | np.ndarray, "devices rows"]  # the vertex of each row; -1 past the last

    @property
    def plan(self) -> Plan:
        """The part of the partition that is static while tracing."""
        return self.shards.plan

    def scatter(self, x: Shaped[np.ndarray, " vertices *columns"]) -> Shaped[Array, "devices rows *columns"]:
        """Put values per vertex, `[N]` or `[N, C]` in the order of the mesh, from the host onto the devices.

        A process reads only the values that its devices hold. The result is `[devices, rows]` or `[devices, rows, C]`,
        with 0 past the last vertex.

        Raises:
            JaxmarkError: if there is not one row for each vertex, or the operator is not on devices.
        """
        mesh = _placed(self)
        if x.shape[:1] != (self.plan.vertices,):
            raise JaxmarkError(f"scatter needs a row for each of {self.plan.vertices} vertices, got {x.shape}.")
        assert isinstance(self.vertices, Array)
        mine = {shard.index[0].start or 0: np.asarray(shard.data)[0] for shard in self.vertices.addressable_shards}

        def rows(device: int) -> np.ndarray:
            vertices = mine[device]
            return np.where(vertices.reshape(*vertices.shape, *[1] * (x.ndim - 1)) >= 0, x[vertices], 0)

        return _on_devices(mesh, rows)

    def gather(self, y: Shaped[Array, "devices rows *columns"]) -> Shaped[np.ndarray, " vertices *columns"]:
        """Collect values `[devices, rows]` or `[devices, rows, C]` on the host of every process, as `[N]` or `[N, C]`.

        Raises:
            JaxmarkError: if the values are not of this operator's vertices.
        """
        _check_values("gather", self, y)
        values, vertices = multihost_utils.process_allgather((y, self.vertices), tiled=True)
        whole = np.empty((self.plan.vertices, *y.shape[2:]), y.dtype)
        whole[vertices[vertices >= 0]] = values[vertices >= 0]
        return whole


class Traffic(NamedTuple):
    """Rows that all devices together send for one product; a row has one value for each column of the signal."""

    sent: int  # rows sent, padding included
    needed: int  # rows needed: each vertex once for each other device that it has an edge to
    cut: int  # the edge cut: number of undirected edges between devices

    @property
    def per_cut_edge(self) -> float:
        """Rows sent per cut edge, padding included; 0 if no edge is cut."""
        return self.sent / self.cut if self.cut else 0.0


def shard(operator: Laplacian, devices: Devices, positions: ArrayLike | None = None) -> ShardedLaplacian:
    """Partition an operator and place its parts on devices: `place(partition(...))`, with their arguments and errors.

    With several processes, all call this with the same arguments.
    """
    return place(partition(operator, len(devices), positions), devices)


def partition(operator: Laplacian, count: int, positions: ArrayLike | None = None) -> ShardedLaplacian:
    """Cut an operator into parts on the host, in O(N log N).

    Args:
        operator: the Laplacian, of N vertices; its parts compute as it does, by a table of neighbours or segment-sums.
        count: number of parts.
        positions: `[N, 3]`, to order vertices along a space-filling Hilbert curve, which cuts fewer edges where parts
            are many. Without them, vertices are ordered by reverse Cuthill-McKee.

    Returns:
        A `ShardedLaplacian` of NumPy arrays, which can be saved leaf by leaf and placed elsewhere.

    Raises:
        JaxmarkError: if there are fewer vertices than parts, or the positions are not `[N, 3]` and finite.
    """
    size = len(operator.mass)
    if not 1 <= count <= size:
        raise JaxmarkError(f"{size} vertices can be shared by 1 to {size} devices, not by {count}.")
    pairs, weights = host_edges(operator)
    order = cuthill_mckee(pairs, size) if positions is None else _along_curve(positions, size)
    rows = -(-size // count)
    # Blocks differ by at most one vertex, so that every device has some.
    start = np.arange(count + 1) * size // count
    device = np.repeat(np.arange(count), np.diff(start))
    place = np.empty(size, np.int64)
    place[order] = device * rows + np.arange(size) - start[device]
    vertices = np.full(count * rows, -1)
    vertices[place] = np.arange(size)

    def spread(values: Array | np.ndarray) -> np.ndarray:
        whole = np.zeros(count * rows)
        whole[place] = values
        return whole.reshape(count, rows)

    pairs = place[pairs]
    cut = pairs[:, 0] // rows != pairs[:, 1] // rows
    inside = weights[~cut] if operator.weights is not None else None
    interior = _interior(pairs[~cut], inside, spread(operator.degree), operator.neighbours is not None)
    if operator.lumped_mass is not None:
        interior = interior._replace(lumped_mass=spread(operator.lumped_mass))
    if operator.scale is not None:
        interior = interior._replace(scale=np.full(count, operator.scale))
    return ShardedLaplacian(
        _with_cut(interior, pairs[cut], weights[cut], size), vertices.reshape(count, rows).astype(np.int32)
    )


def place(parts: ShardedLaplacian, devices: Devices) -> ShardedLaplacian:
    """Put each part on a device of its own; a process reads only the parts of its own devices.

    Raises:
        JaxmarkError: if there is not one device of its own for each part, or this process holds none of the devices.
    """
    if not len(parts.vertices) == len(set(devices)) == len(devices):
        raise JaxmarkError(f"{len(parts.vertices)} parts need as many different devices, got {len(devices)}.")
    if jax.process_index() not in {device.process_index for device in devices}:
        raise JaxmarkError("Each process that takes part must hold at least one of the devices.")
    mesh = Mesh(np.array(devices), _AXIS)
    placed = jax.tree.map(lambda leaf: _on_devices(mesh, leaf.__getitem__), parts)
    return placed._replace(shards=placed.shards._replace(plan=replace(parts.plan, mesh=mesh)))


@jax.jit
def filter_sharded(
    operator: ShardedLaplacian,
    coefficients: Float[Array | np.ndarray, "*filters terms"],
    x: Float[Array, "devices rows *columns"],
) -> Float[Array, "devices rows *columns"]:
    """Filter a signal over several devices: f(Δ)x in O(N / devices) memory on each, derivatives included.

    Args:
        operator: the Laplacian, placed on its devices by `shard`.
        coefficients: `[degree + 1]`, or `[C, degree + 1]` for one filter per column; the same on all devices.
        x: `[devices, rows]` or `[devices, rows, C]`, from `ShardedLaplacian.scatter`. The result keeps its shape, dtype
            and placement, and is 0 past the last vertex if `x` is.

    Raises:
        JaxmarkError: if shapes do not fit, or the operator is not on devices.
    """
    mesh = _placed(operator)
    _check_values("filter", operator, x)

    def local(shards: Shard, c: Array, x: Array) -> Array:
        own = jax.tree.map(lambda leaf: leaf[0], shards)
        # Each device computes its own part of the coefficients' derivative, and the transpose of this cast sums them.
        c = jax.lax.pcast(c, _AXIS, to="varying")
        return chebyshev.filter(own, c, x[0])[None]

    over, whole = PartitionSpec(_AXIS), PartitionSpec()
    mapped = jax.shard_map(local, mesh=mesh, in_specs=(over, whole, over), out_specs=over)
    return mapped(operator.shards, jnp.asarray(coefficients), x)


def traffic(operator: ShardedLaplacian) -> Traffic:
    """Count the rows that one product sends between devices, and the partition's edge cut."""
    plan = operator.plan
    sent = sum(len(pairs) * rows.shape[-1] for pairs, rows in zip(plan.rounds, operator.shards.sends, strict=True))
    return Traffic(sent, plan.boundary, plan.cut)


def _along_curve(positions: ArrayLike, size: int) -> Int64[np.ndarray, " vertices"]:
    """Order the vertices along a Hilbert curve (Skilling, *Programming the Hilbert curve*, 2004)."""
    positions = np.asarray(positions, np.float64)
    if positions.shape != (size, 3) or not np.isfinite(positions).all():
        raise JaxmarkError(f"positions must be [{size}, 3] and finite, got {positions.shape}.")
    low = positions.min(axis=0)
    extent = max(float((positions - low).max()), np.finfo(float).tiny)
    axes = ((positions - low) / extent * (2**_BITS_PER_AXIS - 1)).astype(np.int64).T
    for bit in range(_BITS_PER_AXIS - 1, 0, -1):
        below = (1 << bit) - 1
        for axis in axes:
            swap = np.where(axis >> bit & 1, 0, (axes[0] ^ axis) & below)
            axes[0] ^= np.where(axis >> bit & 1, below, swap)
            axis ^= swap
    axes = np.bitwise_xor.accumulate(axes, axis=0)
    turn = np.zeros_like(axes[0])
    for bit in range(_BITS_PER_AXIS - 1, 0, -1):
        turn ^= (axes[-1] >> bit & 1) * ((1 << bit) - 1)
    axes ^= turn
    code = np.zeros_like(turn)
    for bit in range(_BITS_PER_AXIS - 1, -1, -1):
        for axis in axes:
            code = code << 1 | (axis >> bit & 1)
    return np.argsort(code, kind="stable")


def _interior(
    pairs: Int64[np.ndarray, "edges 2"],
    weights: Float[np.ndarray, " edges"] | None,
    degree: Float[np.ndarray, "devices rows"],
    table: bool,
) -> Laplacian:
    """Compute the Laplacians of the edges within blocks, stacked; in `pairs`, vertices are device · rows + row."""
    count, rows = degree.shape
    order = np.argsort(pairs[:, 0] // rows, kind="stable")
    pairs = pairs[order]
    device = pairs[:, 0] // rows
    start = np.searchsorted(device, np.arange(count))
    edges = _grouped(pairs % rows, device, count, rows)
    most = edges.shape[1]
    weights = None if weights is None else _grouped(weights[order], device, count, 0)
    made = make_neighbours(pairs, count * rows, weighted=weights is not None) if table else None
    if made is not None:
        split = (-1, count, rows)
        edge = None
        if made.edges is not None:
            edge = np.where(made.edges == len(pairs), most, made.edges - np.repeat(start, rows)).reshape(split)
            edge = np.moveaxis(edge, 1, 0).astype(np.int32)
        owner = made.rest[:, 0] // rows
        rest = np.c_[made.rest[:, :2] % rows, made.rest[:, 2] - start[owner]]
        made = Neighbours(
            np.moveaxis(made.vertices.reshape(split) % rows, 1, 0),
            made.empty.reshape(count, rows),
            _grouped(rest, owner, count, rows).astype(np.int32),
            edge,
        )
    return Laplacian(edges.astype(np.int32), weights, degree, made)


def _with_cut(
    interior: Laplacian, pairs: Int64[np.ndarray, "cut 2"], weights: Float[np.ndarray, " cut"], size: int
) -> Shard:
    """Complete the stacked parts by the edges between them, and by the rows to be sent in each round."""
    count, rows = interior.degree.shape
    to, source = np.concatenate([pairs, pairs[:, ::-1]]).T  # each edge at both ends: the row that needs, the row needed
    # A vertex goes to a device once, however many edges lead there. Sorted by (from, to), then vertex:
    pair = source // rows * count + to // rows
    needed, where = np.unique(np.stack([pair, source]), axis=1, return_inverse=True)
    needed_pair, needed_vertex = needed
    flows, first, widths = np.unique(needed_pair, return_index=True, return_counts=True)
    rounds = _rounds(flows // count, flows % count, widths)
    sends, begins, offset = [], np.zeros(len(flows), np.int64), 0
    for members in rounds:
        width = int(widths[members[0]])
        rows_sent = np.zeros((count, width), np.int32)
        for flow in members:
            sent = needed_vertex[first[flow] : first[flow] + widths[flow]] % rows
            rows_sent[flows[flow] // count, : len(sent)] = sent
            begins[flow] = offset
        sends.append(rows_sent)
        offset += width
    flow = np.searchsorted(flows, needed_pair)
    received = (begins[flow] + np.arange(len(flow)) - first[flow])[where.ravel()]
    device = to // rows
    cut = _grouped(np.stack([to % rows, received], axis=1), device, count, 0).astype(np.int32)
    plan = Plan(
        vertices=size,
        cut=len(pairs),
        boundary=len(needed_vertex),
        rounds=tuple(tuple((int(f) // count, int(f) % count) for f in flows[members]) for members in rounds),
    )
    return Shard(interior, tuple(sends), cut, _grouped(np.tile(weights, 2), device, count, 0), plan)


def _rounds(
    source: Int64[np.ndarray, " flows"], target: Int64[np.ndarray, " flows"], widths: Int64[np.ndarray, " flows"]
) -> list[list[int]]:
    """Assign flows between pairs of devices to rounds, each as wide as its first and widest flow.

    Each flow joins the narrowest round in which its sender and its receiver are free, as far as padding is allowed.
    """
    rounds: list[list[int]] = []
    spare = 0.0
    for flow in np.argsort(-widths, kind="stable").tolist():
        # The allowance for padding grows flow by flow: otherwise wide flows would use it up, and each narrow one would
        # need a round of its own.
        spare += _MAX_PADDING * widths[flow]
        for members in reversed(rounds):
            padding = widths[members[0]] - widths[flow]
            if padding <= spare and source[flow] not in source[members] and target[flow] not in target[members]:
                members.append(flow)
                spare -= padding
                break
        else:
            rounds.append([flow])
    return rounds


def _grouped(
    values: Shaped[np.ndarray, " items *rest"], group: Int[np.ndarray, " items"], count: int, fill: ArrayLike
) -> Shaped[np.ndarray, " groups width *rest"]:
    """Arrange items in one row for each group, in their order, padded with `fill` to the longest."""
    order = np.argsort(group, kind="stable")
    group = group[order]
    sizes = np.bincount(group, minlength=count)
    stacked = np.full((count, sizes.max(initial=0), *values.shape[1:]), fill, values.dtype)
    stacked[group, np.arange(len(group)) - np.searchsorted(group, group)] = values[order]
    return stacked


def _on_devices(mesh: Mesh, part: Callable[[int], np.ndarray]) -> Array:
    """Make an array with a leading axis of devices; each process makes the parts that its devices hold."""
    here = [(k, device) for k, device in enumerate(mesh.devices.flat) if device.process_index == jax.process_index()]
    parts = [jax.device_put(part(k)[None], device) for k, device in here]
    placement = NamedSharding(mesh, PartitionSpec(_AXIS))
    return jax.make_array_from_single_device_arrays((mesh.size, *parts[0].shape[1:]), placement, parts)


def _placed(operator: ShardedLaplacian) -> Mesh:
    if operator.plan.mesh is None:
        raise JaxmarkError("A partition must be put on devices by jaxmark.spectral.sharding.place before it is used.")
    return operator.plan.mesh


def _check_values(name: str, operator: ShardedLaplacian, values: Array) -> None:
    if values.shape[:2] != operator.vertices.shape:
        devices, rows = operator.vertices.shape
        raise JaxmarkError(f"{name} needs values [{devices}, {rows}] or [{devices}, {rows}, C], got {values.shape}.")
