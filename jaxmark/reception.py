"""What a receiver learns of a suspect without the key: the host's part taken off, the rest weighed band by band.

Whatever acts on the *host* as a spectral filter, an affine map or a smooth warp leaves a residual in the span of a few
diffusion scales of the host and polynomials of the position. Projecting that nuisance off leaves the mark and noise.
How much of the mark each band still holds is seen from what the attack did to the host there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmark.bands import diffusion
from jaxmark.chebyshev import band_components, filter, gram, over_bands
from jaxmark.laplacian import Laplacian, per_row
from jaxmark.observation import Observation
from jaxmark.precision import einsum, matmul

_BLOCK = 2**14  # vertices whose nuisance is handled at a time
_SAMPLE = 2**13  # that tell a basis well enough


@jax.tree_util.register_static
@dataclass(frozen=True)
class Extent:
    """What of an original's shape is nuisance."""

    scales: int  # diffusion scales of each coordinate, from one smoothing step on
    degree: int  # total degree of the polynomials of the position, at least 1 (affine maps)


class Host(NamedTuple):
    """An original as marks are written in it, and what says what of its shape is nuisance; free of the key."""

    operator: Laplacian
    signal: Float[Array, "vertices 3"]  # centred per component
    coefficients: Float[Array, "bands terms"]  # of the bands that the mark is written in
    positions: Float[Array, "vertices 3"]
    extent: Extent


class Receiver(NamedTuple):
    """An original as it is read with; free of the key."""

    operator: Laplacian
    signal: Float[Array, "vertices 3"]  # as of the host
    coefficients: Float[Array, "bands terms"]  # as of the host
    nuisance: Float[Array, "vertices columns"]  # nearly orthonormal, for each coordinate


class Reception(NamedTuple):
    """A suspect as the receiver sees it; free of the key."""

    host: Receiver  # with what the suspect shows it to have gone through as nuisance, too
    residual: Float[Array, "vertices 3"]  # weighed, free of nuisance, as strong along each direction as along any other
    gain: Float[Array, " bands"]  # what the attack left of the host, and so of the mark
    power: Float[Array, " bands"]  # residual energy per dimension, relative to the largest
    axes: Float[Array, "3 3"]  # what made it so, symmetric
    seen: Observation
    factor: Float[Array, "unknowns unknowns"]  # Cholesky factor of the nuisance as it is seen


def make_host(
    operator: Laplacian,
    signal: Float[Array, "vertices 3"],
    positions: Float[Array, "vertices 3"],
    coefficients: Float[Array | np.ndarray, "bands terms"],
    *,
    scales: int,
    degree: int,
) -> Host:
    """An original for writing; `make_receiver` prepares it for reading.

    Args:
        operator: the Laplacian, of N vertices.
        signal: the host's coordinates, centred per component.
        positions: the host's coordinates.
        coefficients: the bands that the mark is written in.
        scales: see `Extent`.
        degree: see `Extent`.
    """
    return Host(operator, signal, jnp.asarray(coefficients).astype(signal.dtype), positions, Extent(scales, degree))


def make_receiver(host: Host | Receiver) -> Receiver:
    """Form what is projected off, unless it has been; can be traced and differentiated with respect to the host."""
    if isinstance(host, Receiver):
        return host
    # A compiled function would return copies of the rest.
    return Receiver(host.operator, host.signal, host.coefficients, _nuisance(host))


@jax.jit
def _nuisance(host: Host) -> Float[Array, "vertices columns"]:
    low, high = jax.lax.stop_gradient((host.positions.min(axis=0), host.positions.max(axis=0)))
    inside = (2 * host.positions - (high + low)) / jnp.where(high > low, high - low, 1)
    smooth = (
        band_components(host.operator, diffusion(host.extent.scales, host.coefficients.shape[1]), host.signal)
        if host.extent.scales
        else jnp.zeros((0, *host.signal.shape), host.signal.dtype)
    )

    def columns(inside: Array, smooth: Array) -> Array:
        polynomials = _polynomials(inside, host.extent.degree)
        return jnp.concatenate([polynomials, smooth.reshape(len(inside), -1)], axis=1)

    return _basis(columns, inside, jnp.moveaxis(smooth, 0, 1))


def extended(host: Receiver, seen: Observation) -> Receiver:
    """The receiver with what the suspect shows the host to have gone through as nuisance, too."""
    if seen.nuisance is None:
        return host
    return host._replace(nuisance=_wider(host.nuisance, seen.nuisance))


@jax.jit
def _wider(first: Array, second: Array) -> Float[Array, "vertices columns"]:
    return _basis(lambda *both: jnp.concatenate(both, axis=1), first, second)


def _basis(columns: Callable[..., Array], *rows: Array) -> Float[Array, "vertices columns"]:
    """The span of columns(*rows), nearly orthonormal. They are formed block by block, never as a whole."""
    count = len(rows[0])
    # Only the span matters, so the change to a good basis is not differentiated. A sample makes one that is nearly
    # good, and normal equations do the rest. What depends on the columns before it is rounding noise and is dropped.
    still = jax.lax.stop_gradient(rows)
    some = np.sort(np.random.default_rng(0).permutation(count)[:_SAMPLE])
    raw = columns(*(part[some] for part in still))
    norm = jnp.linalg.norm(raw, axis=0)
    scale = 1 / jnp.where(norm > 0, norm, 1)
    triangle = jnp.linalg.qr(raw * scale, mode="r")
    eye = jnp.eye(len(norm), dtype=raw.dtype)
    pivot = jnp.zeros_like(norm).at[: len(triangle)].set(jnp.abs(jnp.diagonal(triangle)))
    sound = pivot > 10 * jnp.finfo(raw.dtype).eps
    square = jnp.where(sound[:, None], eye.at[: len(triangle)].set(triangle), eye)
    nearly = scale[:, None] * jsl.solve_triangular(square, jnp.diag(sound.astype(raw.dtype)))

    def products(fresh: Array, *block: Array) -> Array:
        part = matmul(columns(*block), nearly)
        return matmul(part.T, fresh[:, None] * part)

    normal = jnp.where(sound[:, None] & sound, _sum_over_blocks(products, *still), eye)
    change = jsl.solve_triangular(jnp.linalg.cholesky(normal), nearly.T, lower=True).T

    def write(basis: Array, start: Array) -> tuple[Array, None]:
        place, block = _block(start, rows)
        part = jax.checkpoint(lambda *block: matmul(columns(*block), change))(*block)
        return jax.lax.dynamic_update_slice_in_dim(basis, part, place, 0), None

    return jax.lax.scan(write, jnp.zeros((count, len(norm)), raw.dtype), _starts(count))[0]


def _starts(count: int) -> Int[Array, " blocks"]:
    return jnp.arange(0, count, min(count, _BLOCK))


def _block(start: Array, rows: Sequence[Array]) -> tuple[Array, list[Array]]:
    """So many rows from a start on, and where they begin: the last block takes some of the block before, too."""
    size = min(len(rows[0]), _BLOCK)
    place = jnp.minimum(start, len(rows[0]) - size)
    return place, [jax.lax.dynamic_slice_in_dim(part, place, size) for part in rows]


def _sum_over_blocks(function: Callable[..., Array], *rows: Array) -> Array:
    """Σ function(fresh, *block) over blocks of rows; fresh is 0 where a row was in the block before, else 1."""

    def one(start: Array) -> Array:
        place, block = _block(start, rows)
        fresh = place + jnp.arange(len(block[0])) >= start
        return function(fresh.astype(rows[0].dtype), *block)

    starts = _starts(len(rows[0]))
    zero = jnp.zeros_like(jax.eval_shape(one, starts[0]))
    return jax.lax.scan(lambda total, start: (total + one(start), None), zero, starts)[0]


def receive(host: Host | Receiver, seen: Observation) -> Reception:
    """Project the nuisance off a residual, and measure gain and power of each band, and the power along each direction.

    Args:
        host: from `make_receiver`, to form the nuisance only once; or from `make_host`.
        seen: the suspect's residual, in the units of the host.
    """
    host = extended(make_receiver(host), seen)
    # A compiled function would return a copy of the host.
    return Reception(host, *_receive(host, seen))


@jax.jit
def _receive(host: Receiver, seen: Observation) -> tuple[Array, Array, Array, Array, Observation, Array]:
    # Points that are far off once the nuisance is gone were edited, or lost: they count for less.
    strange = _robust(clean(host, seen, normal_factor(host, seen), seen.residual), seen.weights)
    seen = seen._replace(weights=seen.weights * strange)
    factor = normal_factor(host, seen)
    # Twice, because the ridge leaves a little of a large nuisance behind.
    nuisance = _explained(host, seen, factor, seen.residual)
    residual = clean(host, seen, factor, seen.residual - nuisance)
    # A reference that is as strong in every direction as in any other.
    probe = jax.random.rademacher(jax.random.key(0), residual.shape, residual.dtype)
    pair = jnp.concatenate([residual, clean(host, seen, factor, probe)], axis=1)
    squares = gram(host.operator, host.coefficients, pair, method="moments")
    # Rounding may leave less than nothing in a band.
    bands, reference = jnp.maximum(einsum("pcjj->pj", squares.reshape(2, 3, *squares.shape[1:])), 0)
    tiny = 1e-6
    power = (bands + tiny * bands.sum()) / (reference + tiny * reference.sum() + jnp.finfo(bands.dtype).tiny)
    largest = power.max()
    power = jnp.where(largest > 0, jnp.maximum(power / jnp.where(largest > 0, largest, 1), 1e-9), 1)

    # Where nothing is seen, the host is taken to have moved as the nuisance says: a hole would leak into every band.
    # These bands differ by orders of magnitude, more than moments tell apart.
    mass = per_row(host.operator.degree, residual)

    def products(pair: Float[Array, "vertices 6"]) -> tuple[Array, Array]:
        return jnp.sum(mass * pair[:, 3:] * pair[:, :3]), jnp.sum(mass * pair[:, 3:] ** 2)

    pair = jnp.concatenate([residual + nuisance, host.signal], axis=1)
    change, whole = over_bands(products, host.operator, host.coefficients, pair)
    gain = 1 + jnp.where(whole > 0, change / jnp.where(whole > 0, whole, 1), 0)
    axes = _axes(filter(host.operator, whitening(host, power), residual), seen)
    return (matmul(residual, axes), jnp.clip(gain, 0, 2), power, axes, seen, factor)


def even(received: Reception) -> Reception:
    """The same with all bands and directions weighed alike.

    Bands are weighed by what little is in them, so who can empty a band, and turn what is left of a mark there, makes
    it speak for all. With these weights nobody can.
    """
    flat = jnp.ones_like(received.power)
    return received._replace(gain=flat, power=flat, axes=jnp.eye(3, dtype=received.axes.dtype))


def whitening(host: Receiver, power: Float[Array, " bands"]) -> Float[Array, " terms"]:
    """Coefficients of the filter that makes all bands equally strong."""
    return matmul(host.coefficients.T, 1 / jnp.sqrt(power))


def _axes(white: Float[Array, "vertices 3"], seen: Observation) -> Float[Array, "3 3"]:
    """C^-1/2 of the covariance C of the three coordinates, which an inverted stretch leaves unequal; of mean 1."""
    if seen.normals is not None:
        return jnp.eye(3, dtype=white.dtype)
    products = matmul(white.T, white)
    total = jnp.trace(products)
    covariance = products / jnp.where(total > jnp.finfo(white.dtype).tiny, total, 1)
    # A direction in which nothing moved is not to count for everything.
    axes = _inverse_root(covariance + 1e-4 * jnp.eye(3, dtype=white.dtype))
    return axes / (jnp.trace(axes) / 3)


@jax.custom_jvp
def _inverse_root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A^-1/2 of a symmetric positive matrix; its derivative (Daleckii, Krein 1965) exists where eigenvalues meet."""
    values, vectors = jnp.linalg.eigh(matrix)
    return matmul(vectors / jnp.sqrt(values), vectors.T)


@_inverse_root.defjvp
def _inverse_root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    values, vectors = jnp.linalg.eigh(primals[0])
    root = jnp.sqrt(values)
    slopes = -1 / (jnp.outer(root, root) * (root[:, None] + root))
    change = slopes * einsum("ki,kl,lj->ij", vectors, tangents[0], vectors)
    return matmul(vectors / root, vectors.T), einsum("ik,kl,jl->ij", vectors, change, vectors)


def _robust(residual: Float[Array, "vertices 3"], weights: Float[Array, " vertices"]) -> Float[Array, " vertices"]:
    """Huber's weights, on the squared length: 1 up to four times the median, which Gaussian noise rarely exceeds."""
    square = jnp.sum(residual**2, axis=1)
    limit = 4 * jnp.nanmedian(jnp.where(weights > 0, square, jnp.nan))
    return jnp.where(square > limit, limit / jnp.where(square > limit, square, 1), 1)


def normal_factor(host: Receiver, seen: Observation) -> Float[Array, "unknowns unknowns"]:
    """Cholesky factor of the nuisance's normal equations, with a ridge for what looks alike where it is seen."""

    def products(weights: Array) -> Array:
        return _sum_over_blocks(
            lambda fresh, rows, weight: matmul(rows.T, (fresh * weight)[:, None] * rows), host.nuisance, weights
        )

    if seen.normals is None:
        normal = products(seen.weights)
    else:
        # Each column along each coordinate: one block for each pair of these, alike for a pair and its reverse.
        pairs, which = np.triu_indices(3), np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
        along = seen.normals.T
        blocks = jax.lax.map(products, seen.weights * along[pairs[0]] * along[pairs[1]])[which]
        normal = blocks.transpose(2, 0, 3, 1).reshape(3 * blocks.shape[2], -1)
    ridge = jnp.finfo(normal.dtype).eps * (jnp.trace(normal) + 1)
    return jnp.linalg.cholesky(normal + ridge * jnp.eye(len(normal), dtype=normal.dtype))


def clean(
    host: Receiver, seen: Observation, factor: Float[Array, "unknowns unknowns"], x: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """ΩPx: a displacement without its nuisance, weighed; symmetric in the plain inner product."""
    return seen.weigh(x - _explained(host, seen, factor, x))


def _explained(host: Receiver, seen: Observation, factor: Array, x: Array) -> Array:
    """The nuisance that fits a displacement best, where and as it is seen."""
    matched = matmul(host.nuisance.T, seen.weigh(x))
    if seen.normals is None:
        return matmul(host.nuisance, jsl.cho_solve((factor, True), matched))
    return matmul(host.nuisance, jsl.cho_solve((factor, True), matched.ravel()).reshape(-1, 3))


def _polynomials(inside: Float[Array, "vertices 3"], degree: int) -> Float[Array, "vertices columns"]:
    """Products of Chebyshev polynomials of the position in its box, up to a total degree."""
    powers = [jnp.ones_like(inside), inside]
    while len(powers) <= degree:
        powers.append(2 * inside * powers[-1] - powers[-2])
    power = np.indices([degree + 1] * 3).reshape(3, -1)
    i, j, k = power[:, power.sum(axis=0) <= degree]
    x, y, z = jnp.moveaxis(jnp.stack(powers), 2, 0)
    return (x[i] * y[j] * z[k]).T
