"""What a receiver learns of a suspect without the key: the host's part taken off, the rest weighed band by band.

Whatever acts on the *host* as a spectral filter, an affine map or a smooth warp leaves a residual in the span of a few
diffusion scales of the host and polynomials of the position. Projecting that nuisance off leaves the mark and noise.
How much of the mark each band still holds is seen from what the attack did to the host there.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from jaxmark.bands import diffusion
from jaxmark.chebyshev import band_components, filter, over_bands
from jaxmark.laplacian import Laplacian, per_row
from jaxmark.observation import Observation

_BLOCK = 2**14  # vertices whose nuisance is handled at a time


class Host(NamedTuple):
    """An original as the receiver sees it; free of the key."""

    operator: Laplacian
    signal: Float[Array, "vertices 3"]  # centred per component
    coefficients: Float[Array, "bands terms"]  # of the bands that the mark is written in
    nuisance: Float[Array, "vertices columns"]  # nearly orthonormal, for each coordinate


class Reception(NamedTuple):
    """A suspect as the receiver sees it; free of the key."""

    residual: Float[Array, "vertices 3"]  # weighed, free of nuisance, as strong along each direction as along any other
    gain: Float[Array, " bands"]  # what the attack left of the host, and so of the mark
    power: Float[Array, " bands"]  # residual energy per dimension, relative to the largest
    axes: Float[Array, "3 3"]  # what made it so, symmetric
    seen: Observation
    factor: Float[Array, "unknowns unknowns"]  # Cholesky factor of the nuisance as it is seen


@partial(jax.jit, static_argnames=("scales", "degree"))
def make_host(
    operator: Laplacian,
    signal: Float[Array, "vertices 3"],
    positions: Float[Array, "vertices 3"],
    coefficients: Float[Array | np.ndarray, "bands terms"],
    *,
    scales: int,
    degree: int,
) -> Host:
    """Prepare what the receiver projects off; can be traced and differentiated with respect to signal and positions.

    Args:
        operator: the Laplacian, of N vertices.
        signal: the host's coordinates, centred per component.
        positions: the host's coordinates.
        coefficients: the bands that the mark is written in.
        scales: how many diffusion scales of each coordinate are nuisance, from one smoothing step on.
        degree: total degree of the polynomials of the position that are nuisance, at least 1 (affine maps).
    """
    coefficients = jnp.asarray(coefficients).astype(signal.dtype)
    low, high = jax.lax.stop_gradient((positions.min(axis=0), positions.max(axis=0)))
    inside = (2 * positions - (high + low)) / jnp.where(high > low, high - low, 1)
    smooth = (
        band_components(operator, diffusion(scales, coefficients.shape[1]), signal)
        if scales
        else jnp.zeros((0, *signal.shape), signal.dtype)
    )

    def columns(inside: Array, smooth: Array) -> Array:
        return jnp.concatenate([_polynomials(inside, degree), smooth.reshape(len(inside), -1)], axis=1)

    return Host(operator, signal, coefficients, _basis(columns, inside, jnp.moveaxis(smooth, 0, 1)))


def extended(host: Host, seen: Observation) -> Host:
    """The host with what the suspect shows it to have gone through as nuisance, too."""
    if seen.nuisance is None:
        return host
    return host._replace(nuisance=_wider(host.nuisance, seen.nuisance))


@jax.jit
def _wider(first: Array, second: Array) -> Float[Array, "vertices columns"]:
    return _basis(lambda *both: jnp.concatenate(both, axis=1), first, second)


def _basis(columns: Callable[..., Array], *rows: Array) -> Float[Array, "vertices columns"]:
    """The span of columns(*rows), nearly orthonormal. They are formed block by block, never as a whole."""
    count, size = len(rows[0]), min(len(rows[0]), _BLOCK)
    starts = jnp.arange(0, count, size)

    def block(start: Array) -> tuple[Array, Array]:
        """Columns of so many rows; the last ones are rows of the block before, too, which does not count twice."""
        place = jnp.minimum(start, count - size)
        fresh = place + jnp.arange(size) >= start
        return columns(*(jax.lax.dynamic_slice_in_dim(part, place, size) for part in rows)), fresh

    def triangle(above: Array, start: Array) -> tuple[Array, None]:
        raw, fresh = block(start)
        return jnp.linalg.qr(jnp.concatenate([above, jnp.where(fresh[:, None], raw, 0)]), mode="r"), None

    def write(basis: Array, start: Array) -> tuple[Array, None]:
        part = jax.checkpoint(lambda: block(start)[0] @ change)()
        return jax.lax.dynamic_update_slice_in_dim(basis, part, jnp.minimum(start, count - size), 0), None

    # Only the span matters, so the change to a good basis is not differentiated. What depends on the columns before it
    # is rounding noise and is dropped.
    shape = jax.eval_shape(lambda: block(starts[0])[0])
    dtype, width = shape.dtype, shape.shape[1]
    whole = jax.lax.stop_gradient(jax.lax.scan(triangle, jnp.zeros((width, width), dtype), starts)[0])
    norm = jnp.linalg.norm(whole, axis=0)
    scale = 1 / jnp.where(norm > 0, norm, 1)
    sound = jnp.abs(jnp.diagonal(whole)) * scale > 10 * jnp.finfo(dtype).eps
    square = jnp.where(sound[:, None], whole * scale, jnp.eye(width, dtype=dtype))
    change = scale[:, None] * jsl.solve_triangular(square, jnp.diag(sound.astype(dtype)))
    return jax.lax.scan(write, jnp.zeros((count, width), dtype), starts)[0]


@jax.jit
def receive(host: Host, seen: Observation) -> Reception:
    """Project the nuisance off a residual, and measure gain and power of each band, and the power along each direction.

    Args:
        host: from `make_host`.
        seen: the suspect's residual, in the units of the host.
    """
    # Points that are far off once the nuisance is gone were edited, or lost: they count for less.
    strange = _robust(clean(host, seen, _factor(host, seen), seen.residual), seen.weights)
    seen = seen._replace(weights=seen.weights * strange)
    factor = _factor(host, seen)
    # Twice, because the ridge leaves a little of a large nuisance behind.
    nuisance = _explained(host, seen, factor, seen.residual)
    residual = clean(host, seen, factor, seen.residual - nuisance)
    # A reference that is as strong in every direction as in any other.
    probe = jax.random.rademacher(jax.random.key(0), residual.shape, residual.dtype)
    mass = per_row(host.operator.degree, residual)

    def energies(pair: Float[Array, "vertices 6"]) -> Float[Array, " 2"]:
        return jnp.sum((mass * pair**2).reshape(-1, 2, 3), axis=(0, 2))

    pair = jnp.concatenate([residual, clean(host, seen, factor, probe)], axis=1)
    bands, reference = over_bands(energies, host.operator, host.coefficients, pair).T
    tiny = 1e-6
    power = (bands + tiny * bands.sum()) / (reference + tiny * reference.sum() + jnp.finfo(bands.dtype).tiny)
    largest = power.max()
    power = jnp.where(largest > 0, jnp.maximum(power / jnp.where(largest > 0, largest, 1), 1e-9), 1)

    # Where nothing is seen, the host is taken to have moved as the nuisance says: a hole would leak into every band.
    def products(pair: Float[Array, "vertices 6"]) -> tuple[Array, Array]:
        return jnp.sum(mass * pair[:, 3:] * pair[:, :3]), jnp.sum(mass * pair[:, 3:] ** 2)

    pair = jnp.concatenate([residual + nuisance, host.signal], axis=1)
    change, whole = over_bands(products, host.operator, host.coefficients, pair)
    gain = 1 + jnp.where(whole > 0, change / jnp.where(whole > 0, whole, 1), 0)
    axes = _axes(filter(host.operator, whitening(host, power), residual), seen)
    return Reception(residual @ axes, jnp.clip(gain, 0, 2), power, axes, seen, factor)


def whitening(host: Host, power: Float[Array, " bands"]) -> Float[Array, " terms"]:
    """Coefficients of the filter that makes all bands equally strong."""
    return host.coefficients.T @ (1 / jnp.sqrt(power))


def _axes(white: Float[Array, "vertices 3"], seen: Observation) -> Float[Array, "3 3"]:
    """C^-1/2 of the covariance C of the three coordinates, which an inverted stretch leaves unequal; of mean 1."""
    if seen.normals is not None:
        return jnp.eye(3, dtype=white.dtype)
    products = white.T @ white
    total = jnp.trace(products)
    covariance = products / jnp.where(total > jnp.finfo(white.dtype).tiny, total, 1)
    # A direction in which nothing moved is not to count for everything.
    axes = _inverse_root(covariance + 1e-4 * jnp.eye(3, dtype=white.dtype))
    return axes / (jnp.trace(axes) / 3)


@jax.custom_jvp
def _inverse_root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A^-1/2 of a symmetric positive matrix; its derivative (Daleckii, Krein 1965) exists where eigenvalues meet."""
    values, vectors = jnp.linalg.eigh(matrix)
    return vectors / jnp.sqrt(values) @ vectors.T


@_inverse_root.defjvp
def _inverse_root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    values, vectors = jnp.linalg.eigh(primals[0])
    root = jnp.sqrt(values)
    slopes = -1 / (jnp.outer(root, root) * (root[:, None] + root))
    change = vectors @ (slopes * (vectors.T @ tangents[0] @ vectors)) @ vectors.T
    return vectors / root @ vectors.T, change


def _robust(residual: Float[Array, "vertices 3"], weights: Float[Array, " vertices"]) -> Float[Array, " vertices"]:
    """Huber's weights, on the squared length: 1 up to four times the median, which Gaussian noise rarely exceeds."""
    square = jnp.sum(residual**2, axis=1)
    limit = 4 * jnp.nanmedian(jnp.where(weights > 0, square, jnp.nan))
    return jnp.where(square > limit, limit / jnp.where(square > limit, square, 1), 1)


def _factor(host: Host, seen: Observation) -> Float[Array, "unknowns unknowns"]:
    """Cholesky factor of the nuisance's normal equations, with a ridge for what looks alike where it is seen."""
    count, size = len(host.nuisance), min(len(host.nuisance), _BLOCK)

    def products(weights: Array) -> Array:
        def add(total: Array, start: Array) -> tuple[Array, None]:
            place = jnp.minimum(start, count - size)
            rows, weight = (jax.lax.dynamic_slice_in_dim(one, place, size) for one in (host.nuisance, weights))
            weight = jnp.where(place + jnp.arange(size) >= start, weight, 0)
            return total + rows.T @ (weight[:, None] * rows), None

        width = host.nuisance.shape[1]
        return jax.lax.scan(add, jnp.zeros((width, width), weights.dtype), jnp.arange(0, count, size))[0]

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
    host: Host, seen: Observation, factor: Float[Array, "unknowns unknowns"], x: Float[Array, "vertices 3"]
) -> Float[Array, "vertices 3"]:
    """ΩPx: a displacement without its nuisance, weighed; symmetric in the plain inner product."""
    return seen.weigh(x - _explained(host, seen, factor, x))


def _explained(host: Host, seen: Observation, factor: Array, x: Array) -> Array:
    """The nuisance that fits a displacement best, where and as it is seen."""
    matched = host.nuisance.T @ seen.weigh(x)
    if seen.normals is None:
        return host.nuisance @ jsl.cho_solve((factor, True), matched)
    return host.nuisance @ jsl.cho_solve((factor, True), matched.ravel()).reshape(-1, 3)


def _polynomials(inside: Float[Array, "vertices 3"], degree: int) -> Float[Array, "vertices columns"]:
    """Products of Chebyshev polynomials of the position in its box, up to a total degree."""
    powers = [jnp.ones_like(inside), inside]
    while len(powers) <= degree:
        powers.append(2 * inside * powers[-1] - powers[-2])
    power = np.indices([degree + 1] * 3).reshape(3, -1)
    i, j, k = power[:, power.sum(axis=0) <= degree]
    x, y, z = jnp.moveaxis(jnp.stack(powers), 2, 0)
    return (x[i] * y[j] * z[k]).T
