"""Reception: the data that a receiver extracts from a suspect without using the key.

The receiver projects the nuisance off and weights the bands. Spectral filters, affine maps and smooth warps of the
*host* leave a residual in the span of a few diffusion scales of the host and polynomials of the position, which is the
nuisance. After it is projected off, the mark and noise remain. The gain of the mark in each band is estimated from the
attack's effect on the host in that band.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmark.alignment.observation import Observation
from jaxmark.seeds import probe_signs
from jaxmark.spectral.bands import diffusion
from jaxmark.spectral.chebyshev import band_components, filter, gram, over_bands
from jaxmark.spectral.laplacian import Laplacian, per_row
from jaxmark.spectral.precision import check_precision, einsum, matmul

# A filter that averages over about a hundred points: sixteen steps, each of which goes halfway to the neighbours' mean.
_AROUND = (np.polynomial.chebyshev.Chebyshev([0.5, -0.5]) ** 16).coef
_LEAST_AROUND = 1e-3  # lower limit on the observed share of a point's surroundings, by which an average is divided
_LEAST_ENERGY = 0.25  # of the median, added to every energy: making single places quiet gains an attacker little weight
_PRECISION_ROUNDS = 3
_BLOCK_VERTICES = 2**14  # number of vertices whose nuisance is formed at a time
_SAMPLE_VERTICES = 2**13  # number of vertices that suffice to make a basis nearly orthonormal


@jax.tree_util.register_static
@dataclass(frozen=True)
class Extent:
    """The size of the nuisance that is projected off."""

    scales: int  # number of diffusion scales of each coordinate, from one smoothing step on
    degree: int  # total degree of the polynomials of the position, at least 1 (affine maps)


class Host(NamedTuple):
    """An original prepared for writing marks, with the size of its nuisance; independent of the key."""

    operator: Laplacian
    signal: Float[Array, "vertices 3"]  # the original's coordinates, centred per connected component
    coefficients: Float[Array, "bands terms"]  # Chebyshev coefficients of the bands that the mark is written in
    positions: Float[Array, "vertices 3"]  # the original's coordinates
    extent: Extent


class Receiver(NamedTuple):
    """An original prepared for reading marks; independent of the key."""

    operator: Laplacian
    signal: Float[Array, "vertices 3"]  # see `Host`
    coefficients: Float[Array, "bands terms"]  # see `Host`
    nuisance: Float[Array, "vertices columns"]  # nearly orthonormal basis of the nuisance of each coordinate


class Reception(NamedTuple):
    """The data that the receiver extracts from a suspect; independent of the key."""

    receiver: Receiver  # its nuisance includes that of the observation
    observed: Observation  # the observation as it was given
    residual: Float[Array, "vertices 3"]  # weighted, without nuisance, and equally strong along all directions
    gain: Float[Array, " bands"]  # share of the host's amplitude, hence of the mark's, that the attack left in the band
    power: Float[Array, " bands"]  # residual energy per dimension, relative to the largest
    axes: Float[Array, "3 3"]  # the symmetric matrix that made the residual equally strong along all directions
    observation: Observation  # the observation with lower weights for points that were edited or lost
    factor: Float[Array, "unknowns unknowns"]  # Cholesky factor of the nuisance's normal equations with these weights


def make_host(
    operator: Laplacian,
    signal: Float[Array, "vertices 3"],
    positions: Float[Array, "vertices 3"],
    coefficients: Float[Array | np.ndarray, "bands terms"],
    *,
    scales: int,
    degree: int,
) -> Host:
    """Prepare an original for writing; `make_receiver` prepares it for reading.

    Args:
        operator: the Laplacian, of N vertices.
        signal: the host's coordinates, centred per connected component, `[N, 3]`.
        positions: the host's coordinates, `[N, 3]`.
        coefficients: Chebyshev coefficients of the bands that the mark is written in, `[bands, degree + 1]`.
        scales: number of diffusion scales, see `Extent`.
        degree: total degree of the polynomials, see `Extent`.
    """
    return Host(operator, signal, jax.device_put(coefficients.astype(signal.dtype)), positions, Extent(scales, degree))


def make_receiver(host: Host) -> Receiver:
    """Prepare a host for reading, with a basis of its nuisance; can be traced and differentiated with respect to it."""
    # This function is not compiled, because a compiled function would return copies of the other arrays.
    return Receiver(host.operator, host.signal, host.coefficients, nuisance_basis(host))


def nuisance_basis(host: Host) -> Float[Array, "vertices columns"]:
    """Form a nearly orthonormal basis of the nuisance of each coordinate: polynomials and diffusion scales."""
    return _nuisance_basis(host._replace(coefficients=no_filters(host.coefficients)))


def no_filters(bank: Float[Array, "bands terms"]) -> Float[np.ndarray, "none terms"]:
    """Return a bank of as many terms without filters, for programs that all banks of as many terms share."""
    return np.empty((0, bank.shape[1]), bank.dtype)


@jax.jit
def _nuisance_basis(host: Host) -> Float[Array, "vertices columns"]:
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


def extend(receiver: Receiver, observation: Observation) -> Receiver:
    """Add the nuisance of an observation, if it has one, to that of the receiver."""
    if observation.nuisance is None:
        return receiver
    return receiver._replace(nuisance=_join_bases(receiver.nuisance, observation.nuisance))


@jax.jit
def _join_bases(first: Array, second: Array) -> Float[Array, "vertices columns"]:
    return _basis(lambda *both: jnp.concatenate(both, axis=1), first, second)


def _basis(columns: Callable[..., Array], *rows: Array) -> Float[Array, "vertices columns"]:
    """Form a nearly orthonormal basis of the span of columns(*rows), which is evaluated block by block."""
    count = len(rows[0])
    # Only the span matters, so the change of basis is not differentiated. A QR decomposition of a sample gives a nearly
    # orthonormal basis, which the normal equations of all rows then correct. A column that depends linearly on earlier
    # columns is rounding noise and is dropped.
    constant = jax.lax.stop_gradient(rows)
    sample = np.sort(np.random.default_rng(0).permutation(count)[:_SAMPLE_VERTICES])
    sampled = columns(*(part[sample] for part in constant))
    norm = jnp.linalg.norm(sampled, axis=0)
    scale = 1 / jnp.where(norm > 0, norm, 1)
    triangle = jnp.linalg.qr(sampled * scale, mode="r")
    eye = jnp.eye(len(norm), dtype=sampled.dtype)
    pivot = jnp.zeros_like(norm).at[: len(triangle)].set(jnp.abs(jnp.diagonal(triangle)))
    independent = pivot > 10 * jnp.finfo(sampled.dtype).eps
    square = jnp.where(independent[:, None], eye.at[: len(triangle)].set(triangle), eye)
    change = scale[:, None] * jsl.solve_triangular(square, jnp.diag(independent.astype(sampled.dtype)))

    def products(fresh: Array, *block: Array) -> Array:
        part = matmul(columns(*block), change)
        return matmul(part.T, fresh[:, None] * part)

    normal = jnp.where(independent[:, None] & independent, _sum_over_blocks(products, *constant), eye)
    correction = jsl.solve_triangular(jnp.linalg.cholesky(normal), change.T, lower=True).T

    def write(basis: Array, start: Array) -> tuple[Array, None]:
        place, block = _block(start, rows)
        part = jax.checkpoint(lambda *block: matmul(columns(*block), correction))(*block)
        return jax.lax.dynamic_update_slice_in_dim(basis, part, place, 0), None

    return jax.lax.scan(write, jnp.zeros((count, len(norm)), sampled.dtype), _starts(count))[0]


def _starts(count: int) -> Int[Array, " blocks"]:
    """Return the first row of each block; the last block may extend beyond the end, see `_block`."""
    return jnp.arange(0, count, min(count, _BLOCK_VERTICES))


def _block(start: Array, rows: Sequence[Array]) -> tuple[Array, list[Array]]:
    """Return the first row and the rows of a block; the last block begins earlier, so that it is full."""
    size = min(len(rows[0]), _BLOCK_VERTICES)
    place = jnp.minimum(start, len(rows[0]) - size)
    return place, [jax.lax.dynamic_slice_in_dim(part, place, size) for part in rows]


def _sum_over_blocks(function: Callable[..., Array], *rows: Array) -> Array:
    """Sum function(fresh, *block) over blocks of rows; fresh is 0 for rows of the previous block, else 1."""

    def block_sum(start: Array) -> Array:
        place, block = _block(start, rows)
        fresh = place + jnp.arange(len(block[0])) >= start
        return function(fresh.astype(rows[0].dtype), *block)

    starts = _starts(len(rows[0]))
    zero = jnp.zeros_like(jax.eval_shape(block_sum, starts[0]))
    return jax.lax.scan(lambda total, start: (total + block_sum(start), None), zero, starts)[0]


def receive(receiver: Receiver, observation: Observation) -> Reception:
    """Project the nuisance off a residual, and measure gain and power of each band, and the power along each direction.

    Args:
        receiver: the original, from `make_receiver`.
        observation: the observed displacement of the suspect, in the units of the host.

    Raises:
        JaxmarkError: if the residual is neither float32 nor float64.
    """
    check_precision("receive", observation.residual)
    extended = extend(receiver, observation)
    # The probe comes from a program that all probes of this shape share.
    (probe,) = probe_signs("reception", observation.residual.shape, dtype=observation.residual.dtype)
    # Only two steps are compiled, because a compiled function would return copies of its arguments. The first is the
    # same for all pass bands.
    weighed, factor, residual, nuisance = _project(
        extended._replace(coefficients=no_filters(receiver.coefficients)), observation
    )
    residual, gain, power, axes = _measure(extended, weighed, factor, residual, nuisance, probe)
    return Reception(extended, observation, residual, gain, power, axes, weighed, factor)


@jax.jit
def _project(receiver: Receiver, observation: Observation) -> tuple[Observation, Array, Array, Array]:
    """Weigh the points, and project the nuisance off the residual.

    Returns:
        The observation with these weights, the factor of its normal equations, the residual without the nuisance, and
        the nuisance.
    """
    # An isolated vertex, such as a row that pads the mesh, carries nothing: it is unknown, whatever its weight.
    weights = jnp.where(receiver.operator.linked(observation.weights), observation.weights, 0)
    observation, factor = _weigh_points(receiver, observation._replace(weights=weights))
    # The nuisance is projected off twice, because the ridge leaves a small part of a large nuisance.
    nuisance = _fit_nuisance(receiver, observation, factor, observation.residual)
    return observation, factor, clean(receiver, observation, factor, observation.residual - nuisance), nuisance


@jax.jit
def _measure(
    receiver: Receiver,
    observation: Observation,
    factor: Array,
    residual: Float[Array, "vertices 3"],
    nuisance: Float[Array, "vertices 3"],
    probe: Float[Array, "vertices 3"],
) -> tuple[Array, Array, Array, Array]:
    """Measure gain and power of each band, and the power along each direction; see `Reception` for the results."""
    # White noise is the reference for the power of each band.
    pair = jnp.concatenate([residual, clean(receiver, observation, factor, probe)], axis=1)
    squares = gram(receiver.operator, receiver.coefficients, pair, method="moments")
    # Rounding may make the energy of a band negative.
    bands, reference = jnp.maximum(einsum("pcjj->pj", squares.reshape(2, 3, *squares.shape[1:])), 0)
    floor = 1e-6
    power = (bands + floor * bands.sum()) / (reference + floor * reference.sum() + jnp.finfo(bands.dtype).tiny)
    largest = power.max()
    power = jnp.where(largest > 0, jnp.maximum(power / jnp.where(largest > 0, largest, 1), 1e-9), 1)

    # Unobserved points of the host are assumed to have moved with the nuisance, because a hole would leak into every
    # band. The host's bands differ by orders of magnitude, which moments cannot resolve, so each band is filtered.
    mass = per_row(receiver.operator.mass, residual)

    def products(pair: Float[Array, "vertices 6"]) -> tuple[Array, Array]:
        return jnp.sum(mass * pair[:, 3:] * pair[:, :3]), jnp.sum(mass * pair[:, 3:] ** 2)

    pair = jnp.concatenate([residual + nuisance, receiver.signal], axis=1)
    change, whole = over_bands(products, receiver.operator, receiver.coefficients, pair)
    gain = 1 + jnp.where(whole > 0, change / jnp.where(whole > 0, whole, 1), 0)
    axes = _axes(filter(receiver.operator, whitening(receiver, power), residual), observation)
    return matmul(residual, axes), jnp.clip(gain, 0, 2), power, axes


def weigh_evenly(received: Reception) -> Reception:
    """Give all bands and directions the same weight.

    The usual weights grow as the power of a band falls. An attacker who has the key can therefore empty a band and
    reverse the mark in it, so that this band outweighs all others. Equal weights exclude this attack.
    """
    # Made by NumPy, so that no programs are compiled for it.
    flat = jax.device_put(np.ones(received.power.shape, received.power.dtype))
    return received._replace(gain=flat, power=flat, axes=jax.device_put(np.eye(3, dtype=received.axes.dtype)))


def whitening(receiver: Receiver, power: Float[Array, " bands"]) -> Float[Array, " terms"]:
    """Compute the Chebyshev coefficients of the filter that makes all bands equally strong."""
    return matmul(receiver.coefficients.T, 1 / jnp.sqrt(power))


def _axes(white: Float[Array, "vertices 3"], observation: Observation) -> Float[Array, "3 3"]:
    """Compute C^-1/2 with mean eigenvalue 1; undoing a stretch makes the covariance C of coordinates anisotropic."""
    if observation.normals is not None:
        return jnp.eye(3, dtype=white.dtype)
    products = matmul(white.T, white)
    total = jnp.trace(products)
    covariance = products / jnp.where(total > jnp.finfo(white.dtype).tiny, total, 1)
    # Without the ridge, a direction without any displacement would outweigh the others.
    axes = _inverse_root(covariance + 1e-4 * jnp.eye(3, dtype=white.dtype))
    return axes / (jnp.trace(axes) / 3)


@jax.custom_jvp
def _inverse_root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Compute A^-1/2 of a symmetric positive matrix; the derivative (Daleckii, Krein 1965) allows equal eigenvalues."""
    values, vectors = jnp.linalg.eigh(matrix)
    return matmul(vectors / jnp.sqrt(values), vectors.T)


@_inverse_root.defjvp
def _inverse_root_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    values, vectors = jnp.linalg.eigh(primals[0])
    root = jnp.sqrt(values)
    slopes = -1 / (jnp.outer(root, root) * (root[:, None] + root))
    change = slopes * einsum("ki,kl,lj->ij", vectors, tangents[0], vectors)
    return matmul(vectors / root, vectors.T), einsum("ik,kl,jl->ij", vectors, change, vectors)


def _weigh_points(receiver: Receiver, observation: Observation) -> tuple[Observation, Array]:
    """Give lower weights to points that were edited or lost: whose residual is still large without the nuisance.

    Returns the observation with these weights, and the factor of its normal equations, see `normal_factor`.
    """
    weigh, rounds = (_huber_weights, 1) if observation.normals is None else (_precision, _PRECISION_ROUNDS)

    # One step computes weights from the residual, and first the residual by the weights of the step before. The last
    # step's residual is not needed, but all steps are one program, so that there is less to compile.
    def step(state: tuple[Array, Any, Any], _: None) -> tuple[tuple[Array, Array, Array], None]:
        weights = observation.weights * state[0]
        weighted = observation._replace(weights=weights)
        factor = normal_factor(receiver, weighted)
        rest = clean(receiver, weighted, factor, observation.residual)
        return (weigh(receiver, weighted, rest), weights, factor), None

    unknowns = receiver.nuisance.shape[1] * (1 if observation.normals is None else 3)
    dtype = receiver.nuisance.dtype
    start = jnp.ones_like(observation.weights), observation.weights, jnp.zeros((unknowns, unknowns), dtype)
    (_, weights, factor), _ = jax.lax.scan(step, start, None, length=rounds + 1)
    return observation._replace(weights=weights), factor


def _huber_weights(receiver: Receiver, weighted: Observation, rest: Array) -> Float[Array, " vertices"]:
    """Compute Huber weights of squared lengths: 1 up to four times the median, which Gaussian noise rarely exceeds."""
    del receiver
    square = jnp.sum(rest**2, axis=1)
    limit = 4 * _median_where(weighted.weights > 0, square)
    return jnp.where(square > limit, limit / jnp.where(square > limit, square, 1), 1)


def _precision(receiver: Receiver, weighted: Observation, rest: Array) -> Float[Array, " vertices"]:
    """Compute the inverse energy of the residual around each point, at most five times that at the median.

    The residuals of a remeshed surface are small on planar regions and large along edges, by orders of magnitude on
    machine parts, and S/‖b‖ is largest with these weights. Each projection with better weights leaves less of the
    nuisance of the bad regions in the good ones, so that energies are computed again.
    """
    is_known = weighted.weights > 0
    known = is_known.astype(rest.dtype)
    square = jnp.sum(rest**2, axis=1) / jnp.where(is_known, weighted.weights, 1) ** 2
    pair = filter(receiver.operator, jnp.asarray(_AROUND, rest.dtype), jnp.stack([known * square, known], axis=1))
    energy = jnp.maximum(pair[:, 0], 0) / jnp.maximum(pair[:, 1], _LEAST_AROUND)
    middle = _median_where(is_known, energy)
    return 1 / (energy / jnp.where(middle > 0, middle, 1) + _LEAST_ENERGY)


def _median_where(mask: Bool[Array, " vertices"], values: Float[Array, " vertices"]) -> Float[Array, ""]:
    return jnp.nanmedian(jnp.where(mask, values, jnp.nan))


def normal_factor(receiver: Receiver, observation: Observation) -> Float[Array, "unknowns unknowns"]:
    """Compute the Cholesky factor of the nuisance's normal equations, with a ridge for linearly dependent columns."""

    def products(weights: Array) -> Array:
        return _sum_over_blocks(
            lambda fresh, rows, weight: matmul(rows.T, (fresh * weight)[:, None] * rows), receiver.nuisance, weights
        )

    if observation.normals is None:
        normal = products(observation.weights)
    else:
        # There is an unknown for each column and coordinate. Each pair of coordinates has a block of the matrix; it is
        # the same for a pair and its reverse.
        pairs, which = np.triu_indices(3), np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
        along = observation.normals.T
        blocks = jax.lax.map(products, observation.weights * along[pairs[0]] * along[pairs[1]])[which]
        normal = blocks.transpose(2, 0, 3, 1).reshape(3 * blocks.shape[2], -1)
    ridge = jnp.finfo(normal.dtype).eps * (jnp.trace(normal) + 1)
    return jnp.linalg.cholesky(normal + ridge * jnp.eye(len(normal), dtype=normal.dtype))


def clean(
    receiver: Receiver,
    observation: Observation,
    factor: Float[Array, "unknowns unknowns"],
    x: Float[Array, "vertices 3"],
) -> Float[Array, "vertices 3"]:
    """Compute ΩPx: project the nuisance off a displacement, and weight the rest; symmetric without D."""
    return observation.weigh(x - _fit_nuisance(receiver, observation, factor, x))


def _fit_nuisance(receiver: Receiver, observation: Observation, factor: Array, x: Array) -> Array:
    """Fit the nuisance to a displacement by least squares, with the weights and normals of the observation."""
    matched = matmul(receiver.nuisance.T, observation.weigh(x))
    if observation.normals is None:
        return matmul(receiver.nuisance, jsl.cho_solve((factor, True), matched))
    return matmul(receiver.nuisance, jsl.cho_solve((factor, True), matched.ravel()).reshape(-1, 3))


def _polynomials(inside: Float[Array, "vertices 3"], degree: int) -> Float[Array, "vertices columns"]:
    """Compute products of Chebyshev polynomials of the position in its bounding box, up to a total degree."""
    powers = [jnp.ones_like(inside), inside]
    while len(powers) <= degree:
        powers.append(2 * inside * powers[-1] - powers[-2])
    power = np.indices([degree + 1] * 3).reshape(3, -1)
    i, j, k = power[:, power.sum(axis=0) <= degree]
    x, y, z = jnp.moveaxis(jnp.stack(powers), 2, 0)
    return (x[i] * y[j] * z[k]).T
