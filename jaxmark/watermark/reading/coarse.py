"""Reading of coarse suspects by the heights of their own vertices; computed on the host.

The usual reading observes the point of the suspect's surface that is closest to each point of the original. The facets
of a coarse surface are chords of the original's surface, so that these points are far off. The vertices of a coarse
suspect are not: where few vertices are left, reading from them gives up to three times the evidence.

Each vertex of an aligned suspect has the height

    d = A w + B c + e

above the original's surface (`jaxmark.alignment.heights`). A gives the component of the mark's displacement w along the
surface normal at the foot of each vertex. B c is the height due to an affine map with unknown coefficients c. The
errors e are due to simplification. Their means E e and variances are estimated from simplifications of the original
with other marks, which have random signs instead of keyed ones. A keyed mark is w = T r with the keyed signs r. For
white errors and without B, the best linear score of a claim in this linear Gaussian model is r · a with

    a = Tᵀ Aᵀ (1 + ρ A T Tᵀ Aᵀ)⁻¹ (d - E e),

where the mark's size ρ is estimated from the energy of d. The key has no influence on a, so that the bound on the
probability of a claim holds whatever was done to the suspect.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import KDTree

from jaxmark import distortion
from jaxmark.alignment.heights import Numbers, Unknowns, VertexHeights, measure_heights
from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import Mesh, simplify
from jaxmark.geometry.surfaces import Surface
from jaxmark.watermark.interfaces import ChipCarrier, Displacement
from jaxmark.watermark.perception.budget import first_rms
from jaxmark.watermark.reading.reception import Extent, Reception, nuisance_basis

_OTHERS, _LEAST_OTHERS = 32, 8  # number of other marks
_MOST_POINTS = 2**21  # points of all originals with other marks together, which limits the time
_NEAREST = 16  # nearest vertices of their simplifications from which the error of a vertex is estimated
_FEWEST = 2 * _NEAREST  # a suspect with at most this number of vertices is not read by its heights
_ROUNDS = 3  # alternating fits of affine maps and variances
_PROBES = 4  # random heights from which the energy of a mark is estimated
_STEPS, _TOLERANCE = 40, 1e-2  # of the conjugate gradients


def receive_coarse(
    carrier: ChipCarrier, original: Original, there: VertexHeights, received: Reception
) -> Reception | None:
    """Receive a suspect by the heights of its vertices instead of closest points; independent of the key.

    Args:
        carrier: the carrier of the mark.
        original: the original.
        there: the heights of the suspect's vertices, from the alignment.
        received: the usual reception of the suspect.

    Returns:
        A reception whose residual is (1 + ρ A T Tᵀ Aᵀ)⁻¹ (d - E e), mapped to the original's points by Aᵀ, with equal
        weights for all bands and directions. None if the suspect has too few vertices, or the original too many.

    Raises:
        JaxmarkError: if fast-simplification is missing.
    """
    others = min(_OTHERS, _MOST_POINTS // len(original.positions))
    if others < _LEAST_OTHERS or len(there.height) <= _FEWEST:
        return None
    marks = [original.to_host(_any_mark(carrier, number)) for number in range(others)]
    unit = float(distortion.rms(marks[0][original.used]))
    strength = first_rms(original.points) / unit
    shifts = [strength * mark for mark in marks]
    faces = original.points.faces
    surface = Surface(Mesh(original.positions, faces))
    elsewhere = [
        measure_heights(surface, simplify(Mesh(original.positions + shift, faces), there.faces)) for shift in shifts
    ]
    errors = model_errors(carrier, original, there, elsewhere, shifts)
    if errors is None:
        return None
    deviation = errors.deviation
    basis = orthonormal(errors.nuisance / deviation[:, None])

    def project(white: Numbers) -> Numbers:
        return white - basis @ (basis.T @ white)

    def pull_back(white: Numbers) -> Float[Array, "rows 3"]:
        """Apply Aᵀ to heights in units of their standard deviation."""
        return original.to_traced(there.adjoint(project(white) / deviation))

    def apply_covariance(white: Numbers) -> Numbers:
        """Apply A T Tᵀ Aᵀ, for a mark of RMS 1."""
        moved = original.to_host(_covariance(carrier, pull_back(white))) / unit**2
        return project(there.along(moved) / deviation)

    white = project((there.height - errors.mean) / deviation)
    probes = np.random.default_rng(0).choice([-1.0, 1.0], (_PROBES, len(white)))
    energy = float(np.mean([probe @ apply_covariance(probe) for probe in probes]))
    size = max(float(white @ white) - len(white), 0.0) / energy if energy > 0 else 0.0

    def apply_system(white: Numbers) -> Numbers:
        return white + size * apply_covariance(white)

    shape = (len(white), len(white))
    system = LinearOperator(shape, apply_system, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    weights, _ = cg(system, white, rtol=_TOLERANCE, maxiter=_STEPS)
    pulled = pull_back(weights)
    largest = jnp.max(jnp.abs(pulled))
    flat = jnp.ones_like(received.power)
    return received._replace(
        residual=pulled / jnp.where(largest > 0, largest, 1),
        gain=flat,
        power=flat,
        axes=jnp.eye(3, dtype=pulled.dtype),
    )


def _any_mark(carrier: ChipCarrier, number: int) -> Displacement:
    """Make a mark of unit strength with random signs instead of keyed ones."""
    ones = jnp.ones(carrier.code_bits, carrier.host.signal.dtype)
    return carrier.redraw(number).displacement(ones)


@jax.jit
def _covariance(carrier: ChipCarrier, x: Displacement) -> Float[Array, "vertices 3"]:
    """Compute T Tᵀ x, in which the signs cancel; chips that do not move contribute nothing."""
    coefficients = carrier.coefficients(1.0)
    moving = jnp.abs(jnp.asarray(carrier.chips.signs)).astype(x.dtype)
    return carrier.filter_chips(moving * carrier.match_chips(x, coefficients), coefficients)


class Errors(NamedTuple):
    """A model of the heights of a suspect's vertices without the mark."""

    mean: Numbers  # mean of each error, in diagonals
    deviation: Numbers  # standard deviation of each error, in diagonals
    nuisance: Unknowns  # B: heights due to affine maps


def model_errors(
    carrier: ChipCarrier,
    original: Original,
    there: VertexHeights,
    elsewhere: Sequence[VertexHeights],
    shifts: Sequence[Float64[np.ndarray, "points 3"]],
) -> Errors | None:
    """Estimate the errors of a suspect's vertices from simplifications of the original with other marks.

    Args:
        carrier: the carrier of the mark.
        original: the original.
        there: the heights of the suspect's vertices.
        elsewhere: the heights of the vertices of each simplification.
        shifts: the other marks, in diagonals.

    Returns:
        The errors; None if there are so few vertices that an affine map may explain all their heights.
    """
    affine = original.to_host(nuisance_basis(carrier.host._replace(extent=Extent(scales=0, degree=1))))
    nuisance = there.columns(affine)
    if min(len(heights.height) for heights in (there, *elsewhere)) <= max(_FEWEST, 2 * nuisance.shape[1]):
        return None
    errors = [heights.height - heights.along(shift) for heights, shift in zip(elsewhere, shifts, strict=True)]
    mean, deviation = expected_errors(there, elsewhere, errors, [heights.columns(affine) for heights in elsewhere])
    rounding = original.grid / original.diagonal / np.sqrt(12)
    return Errors(mean, np.maximum(deviation, rounding), nuisance)


def expected_errors(
    there: VertexHeights,
    others: Sequence[VertexHeights],
    errors: Sequence[Float64[np.ndarray, " _"]],
    nuisance: Sequence[Float64[np.ndarray, "_ unknowns"]],
) -> tuple[Numbers, Numbers]:
    """Estimate mean and standard deviation of each vertex's error from simplifications with other marks.

    The nuisance is fitted to the errors of each simplification and subtracted, with weights from the variances of the
    previous round. Mean and deviation of a vertex are those of its nearest vertices in all simplifications together.
    The variance is increased by the variance of this mean, and by the squares that fitting the nuisance removes on
    average.

    Args:
        there: the heights of the suspect's vertices.
        others: the heights of the vertices of each simplification.
        errors: these heights without the mark.
        nuisance: the heights due to each column of the nuisance, for each simplification.
    """
    tree = KDTree(np.concatenate([heights.places for heights in others]))
    near = [np.asarray(tree.query(heights.places, _NEAREST)[1]) for heights in (*others, there)]
    *deviations, deviation_there = (np.ones(len(indices)) for indices in near)
    count, fitted = sum(map(len, errors)), sum(columns.shape[1] for columns in nuisance)
    wider = np.sqrt((1 + 1 / _NEAREST) * count / (count - fitted))
    pool = np.concatenate(errors)
    for _ in range(_ROUNDS):
        remainders = []
        for error, columns, deviation in zip(errors, nuisance, deviations, strict=True):
            basis, white = orthonormal(columns / deviation[:, None]), error / deviation
            remainders.append(deviation * (white - basis @ (basis.T @ white)))
        pool = np.concatenate(remainders)
        least = 1e-9 * pool.std() + np.finfo(float).tiny  # a lower limit, for equal errors
        *deviations, deviation_there = (wider * pool[indices].std(axis=1, ddof=1) + least for indices in near)
    return pool[near[-1]].mean(axis=1), deviation_there


def orthonormal(columns: Unknowns) -> Float64[np.ndarray, "vertices rank"]:
    """Compute an orthonormal basis of the columns' span."""
    # Decomposing the triangle of a QR decomposition takes a fraction of the time of decomposing all rows.
    tall, triangle = np.linalg.qr(columns)
    u, values, _ = np.linalg.svd(triangle, full_matrices=False)
    return tall @ u[:, values > 1e-9 * values.max()]
