"""Suspects of few vertices, read by these; on the host.

Each of a suspect's vertices, where the original lies, is

    d = A w + B c + e

above the original's surface (`jaxmark.alignment.heights`). A takes the mark's displacement w along the normals at the
vertices' feet, and B affine maps, whose coefficients c nobody knows. The errors e are what simplification leaves: their
means and variances are those of simplifications of the original with other marks, of nobody's key. A keyed mark is
w = T r with random signs r. In white errors and without B, the best linear score of a claim is r · a with

    a = Tᵀ Aᵀ (1 + ρ A T Tᵀ Aᵀ)⁻¹ (d - E e),

as in any linear Gaussian model, with the mark's size ρ estimated from the energy of d. As closest points of a coarse
surface are chords, and vertices are not, it has up to three times the evidence of these where few vertices are left.
No key takes part in a, so that what a claim proves by it holds whatever was done to the suspect.
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

_OTHERS, _LEAST_OTHERS = 32, 8  # other marks
_MOST_POINTS = 2**21  # of all originals with other marks together: so much time is spent at most
_NEAREST = 16  # vertices of their simplifications that tell a vertex's error, those that are nearest to it
_FEWEST = 2 * _NEAREST  # vertices of a suspect, up to which its heights tell nothing
_ROUNDS = 3  # of fitting affine maps and variances in turn
_PROBES = 4  # random heights that tell how much energy a mark has
_STEPS, _TOLERANCE = 40, 1e-2  # of conjugate gradients


def receive_coarse(
    carrier: ChipCarrier, original: Original, there: VertexHeights, received: Reception
) -> Reception | None:
    """Receive a suspect by the heights of its vertices, in place of closest points; independent of the key.

    Args:
        carrier: of the mark.
        original: the original.
        there: what the alignment found of the suspect's vertices.
        received: the suspect as it is received otherwise.

    Returns:
        A reception whose residual is (1 + ρ A T Tᵀ Aᵀ)⁻¹ (d - E e), brought back to the original's points by Aᵀ, with
        bands and directions weighted alike; None if the suspect's vertices are too few, or the original's too many.

    Raises:
        JaxmarkError: if fast-simplification is missing.
    """
    others = min(_OTHERS, _MOST_POINTS // len(original.positions))
    if others < _LEAST_OTHERS or len(there.height) <= _FEWEST:
        return None
    marks = [original.to_host(_any_mark(carrier, number)) for number in range(others)]
    unit = float(distortion.rms(marks[0][original.used]))
    shifts = [first_rms(original.mesh) / unit * mark for mark in marks]
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

    def cleaned(white: Numbers) -> Numbers:
        return white - basis @ (basis.T @ white)

    def pulled(white: Numbers) -> Float[Array, "rows 3"]:
        """Aᵀ of heights in units of their deviation."""
        return original.to_traced(there.adjoint(cleaned(white) / deviation))

    def carried(white: Numbers) -> Numbers:
        """A T Tᵀ Aᵀ, for a mark of RMS 1."""
        moved = original.to_host(_covariance(carrier, pulled(white))) / unit**2
        return cleaned(there.along(moved) / deviation)

    white = cleaned((there.height - errors.mean) / deviation)
    probes = np.random.default_rng(0).choice([-1.0, 1.0], (_PROBES, len(white)))
    energy = float(np.mean([one @ carried(one) for one in probes]))
    size = max(float(white @ white) - len(white), 0.0) / energy if energy > 0 else 0.0

    def with_errors(white: Numbers) -> Numbers:
        return white + size * carried(white)

    shape = (len(white), len(white))
    system = LinearOperator(shape, with_errors, dtype=np.float64)  # pyright: ignore[reportCallIssue]
    weights, _ = cg(system, white, rtol=_TOLERANCE, maxiter=_STEPS)
    back = pulled(weights)
    largest = jnp.max(jnp.abs(back))
    flat = jnp.ones_like(received.power)
    return received._replace(
        residual=back / jnp.where(largest > 0, largest, 1), gain=flat, power=flat, axes=jnp.eye(3, dtype=back.dtype)
    )


def _any_mark(carrier: ChipCarrier, number: int) -> Displacement:
    """A mark of unit strength, of signs that are not keyed."""
    ones = jnp.ones(carrier.code_bits, carrier.host.signal.dtype)
    return carrier.redraw(number).displacement(ones)


@jax.jit
def _covariance(carrier: ChipCarrier, x: Displacement) -> Float[Array, "vertices 3"]:
    """T Tᵀ x; signs cancel, but for those of chips that do not move."""
    coefficients = carrier.coefficients(1.0)
    moving = jnp.abs(jnp.asarray(carrier.chips.signs)).astype(x.dtype)
    return carrier.filter_chips(moving * carrier.match_chips(x, coefficients), coefficients)


class Errors(NamedTuple):
    """What is known of the heights of a suspect's vertices besides the mark."""

    mean: Numbers  # of each error, in diagonals
    deviation: Numbers  # of each error, in diagonals
    nuisance: Unknowns  # heights by affine maps: B


def model_errors(
    carrier: ChipCarrier,
    original: Original,
    there: VertexHeights,
    elsewhere: Sequence[VertexHeights],
    shifts: Sequence[Float64[np.ndarray, "points 3"]],
) -> Errors | None:
    """Estimate the errors of a suspect's vertices from meshes of the original with other marks.

    Args:
        carrier: of the mark.
        original: the original.
        there: the suspect's vertices.
        elsewhere: those of meshes with other marks.
        shifts: these marks, in diagonals.

    Returns:
        The errors; None if vertices are so few that an affine map may explain all their heights.
    """
    affine = original.to_host(nuisance_basis(carrier.host._replace(extent=Extent(scales=0, degree=1))))
    nuisance = there.columns(affine)
    if min(len(one.height) for one in (there, *elsewhere)) <= max(_FEWEST, 2 * nuisance.shape[1]):
        return None
    errors = [one.height - one.along(shift) for one, shift in zip(elsewhere, shifts, strict=True)]
    mean, deviation = expected_errors(there, elsewhere, errors, [one.columns(affine) for one in elsewhere])
    rounding = original.grid / original.diagonal / np.sqrt(12)
    return Errors(mean, np.maximum(deviation, rounding), nuisance)


def expected_errors(
    there: VertexHeights,
    others: Sequence[VertexHeights],
    errors: Sequence[Float64[np.ndarray, " _"]],
    nuisance: Sequence[Float64[np.ndarray, "_ unknowns"]],
) -> tuple[Numbers, Numbers]:
    """Estimate mean and standard deviation of each vertex's error from those of simplifications with other marks.

    The nuisance is fitted to the errors of each of these and subtracted, with weights by the variances of the round
    before. Mean and deviation are those of the nearest vertices, of all of these together; the variance is larger by
    the mean's own, and by what the fit of the nuisance takes of squares on average.

    Args:
        there: the suspect's vertices.
        others: those of simplifications with other marks.
        errors: heights of each of those without its mark.
        nuisance: heights of each of those by each column of the nuisance.
    """
    tree = KDTree(np.concatenate([one.places for one in others]))
    near = [np.asarray(tree.query(one.places, _NEAREST)[1]) for one in (*others, there)]
    *deviations, mine = (np.ones(len(some)) for some in near)
    count, fitted = sum(map(len, errors)), sum(columns.shape[1] for columns in nuisance)
    wider = np.sqrt((1 + 1 / _NEAREST) * count / (count - fitted))
    pool = np.concatenate(errors)
    for _ in range(_ROUNDS):
        left = []
        for error, columns, deviation in zip(errors, nuisance, deviations, strict=True):
            basis, white = orthonormal(columns / deviation[:, None]), error / deviation
            left.append(deviation * (white - basis @ (basis.T @ white)))
        pool = np.concatenate(left)
        least = 1e-9 * pool.std() + np.finfo(float).tiny  # where errors are the same, as if exact
        *deviations, mine = (wider * pool[some].std(axis=1, ddof=1) + least for some in near)
    return pool[near[-1]].mean(axis=1), mine


def orthonormal(columns: Unknowns) -> Float64[np.ndarray, "vertices rank"]:
    """An orthonormal basis of the columns' span."""
    u, values, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, values > 1e-9 * values.max()]
