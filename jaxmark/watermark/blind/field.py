"""The scheme `field`: values at the anchors of a lattice, in the shape's own pose, which any meshing of it shows.

A suspect that was smoothed is looked at as if some smoothing was undone; one that was meshed anew, as if some blur was
there already. The pose that it shows is nearly the one that was marked, up to the ways of looking along its axes.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int

from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, edges
from jaxmark.geometry.surfaces import Moments, surface_moments, volume_moments
from jaxmark.spectral.bands import heat
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.padding import common_laplacian, pad_rows
from jaxmark.spectral.precision import matmul
from jaxmark.watermark.blind.anchors import Anchors, Pieces, changes, encloses, look, place, see, turned
from jaxmark.watermark.blind.scheme import AnchoredHost, BlindScheme, Look, measure
from jaxmark.watermark.coding.keys import Choices

_LEAST_AREA = 0.2  # of the mean: what vertices of smaller area count as
_FIRST_STEP = 0.05  # of the lattice of values, in widths, that is tried first
_MIN_GAP = 0.02  # difference of the variances along two axes, over the largest, from which on they are told apart
_UNDONE_STEPS = (0, 10, 30, 50)  # of smoothing, by a tenth of the way to the neighbours' mean each
_BLURS = (0.0, 0.2)  # of a suspect as it is, in shares of the narrow Gaussian's variance
_DEGREE = 64  # of the polynomial that undoes smoothing
_SMOOTHING = 0.5  # share of the narrow Gaussian's width by which displacements are smoothed
_LONGEST = 100.0  # steps of diffusion for that at most
_TERMS = 3.7  # terms of a series over the root of the time of diffusion
_REFINEMENTS = 8  # of the fixed point that it is
_STEP_SIZE = 0.1
#: Spread of small changes of pose that are tried: turns in radians, shifts and growth in sizes.
_SPREAD = (*(3.5e-3,) * 3, *(4e-4,) * 3, 2.5e-3)
#: The ways in which a shape may look along its axes; the last four are of its mirror image.
TURNS = np.array(
    [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]], np.int64
)


@dataclass(frozen=True)
class FieldScheme(BlindScheme):
    """Writes values at anchors in the shape's own pose; read without the original, and after any remeshing.

    Widths and steps are public ladders: of the steps, the largest that keeps the limits is written, and of the widths
    the one that is predicted to survive noise best. Whoever reads without a record tries all of them.
    """

    name: ClassVar[str] = "field"
    in_parts: ClassVar[bool] = False
    looks: ClassVar[int] = (len(_UNDONE_STEPS) - 1 + len(_BLURS)) * len(TURNS)
    widths: tuple[float, ...] = (0.018, 0.0125, 0.025)  # of the narrow Gaussian, about in diagonals
    steps: tuple[float, ...] = tuple(1e-4 * 2 ** (rung / 2) for rung in range(11))  # of the lattice, in the same unit
    hiding: bool = False  # whether points move where and as it is hidden; see `jaxmark.watermark.perception.masking`

    def hosts(self, original: Original, choices: Choices) -> dict[float, AnchoredHost]:
        """See `BlindScheme`.

        Raises:
            JaxmarkError: if the shape's pose cannot be told.
        """
        faces = np.asarray(original.points.faces)
        placed = place(Mesh(original.positions, faces))
        variances = np.diag(placed.moments.covariance)
        if (-np.diff(variances) < _MIN_GAP * variances[0]).any():
            raise JaxmarkError(
                "This shape is as wide in one direction as in another, or nearly, so that its pose cannot be told"
                " without the original; use the scheme 'keyed'."
            )
        dtype, rows = original.signal.dtype, original.to_traced(original.positions)
        faces = turned(faces) if placed.inside_out else faces
        matrix, shift = jnp.asarray(placed.pose.matrix, dtype), jnp.asarray(placed.pose.shift, dtype)
        closed, free, found = encloses(original.points), _inverse_areas(original), {}
        views = see(Mesh(placed.pose(original.positions), faces), self.widths, dtype)
        for width, (pieces, surface, anchors) in views.items():
            size = jnp.asarray(width, dtype)
            shape = Shape(matrix, shift, faces, pieces, anchors, size, closed)
            shown = look(surface, anchors, jnp.zeros(anchors.places.shape, dtype), size, jnp.zeros((), dtype))
            good = np.asarray(shown.good, np.float64)
            _, pose = measure(shape, rows)
            values = np.asarray(shown.values, np.float64)
            smoothing = _smoothing(original, width)
            found[width] = AnchoredHost(shape, anchors.cells, values, pose, good, free, smoothing, _FIRST_STEP * width)
        return found

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[Look]:
        """See `BlindScheme`.

        Raises:
            JaxmarkError: see `place` and `see`, of the suspect as it is.
        """
        dtype = jnp.result_type(float)
        for steps in _UNDONE_STEPS:
            try:
                placed = place(unsmoothed(suspect, steps))
                views = see(placed.mesh, self.widths, dtype)
            except JaxmarkError:
                if steps == 0:
                    raise
                continue  # it was noise, not smoothing, and is too rough now to be looked at
            for width, (_, surface, anchors) in views.items():
                for blur in _BLURS if steps == 0 else _BLURS[:1]:
                    found = changes(surface, anchors, jnp.asarray(width, dtype), jnp.asarray(blur, dtype))
                    at = jnp.asarray(anchors.places, dtype)
                    by = jnp.concatenate([jnp.cross(at, found.slope), found.slope, found.growth[:, None]], axis=1)
                    yield Look(
                        anchors.cells * TURNS[:, None],
                        found.shown.values,
                        np.asarray(found.shown.good),
                        by,
                        _SPREAD,
                        width,
                        placed.pose,
                        steps,
                        TURNS.prod(axis=1) < 0,
                    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Shape:
    """What the values of a mesh are computed from, but its vertices; a pytree."""

    matrix: Float[Array, "3 3"]  # to the mesh's own pose
    shift: Float[Array, " 3"]
    faces: Int[Array | np.ndarray, "faces 3"]
    pieces: Pieces
    anchors: Anchors
    width: Float[Array, ""]  # of the narrow Gaussian
    closed: bool = field(metadata={"static": True})  # whether the mesh encloses a volume

    def measure(self, vertices: Float[Array, "rows 3"]) -> tuple[Float[Array, " anchors"], Float[Array, " nine"]]:
        """Values of the anchors, and the centre and covariance of the mesh, in its own pose as it was."""
        placed = matmul(vertices, self.matrix.T) + self.shift
        nowhere = jnp.zeros(self.anchors.places.shape, vertices.dtype)
        values = look(self.pieces.of(placed), self.anchors, nowhere, self.width, jnp.zeros_like(self.width)).values
        found: Moments = (volume_moments if self.closed else surface_moments)(placed[self.faces])
        upper = jnp.triu_indices(3)
        return values, jnp.concatenate([found.centre, found.covariance[upper]])


def _inverse_areas(original: Original) -> Float[Array, " rows"]:
    """The inverse of the area around each point, relative to the mean."""
    points, faces = original.positions, np.asarray(original.points.faces)
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    around = np.bincount(faces.ravel(), np.repeat(area, 3), len(points))
    mean = around[original.used].mean()
    return original.to_traced(np.where(original.used, mean / np.maximum(around, _LEAST_AREA * mean), 0))


def _smoothing(original: Original, width: float) -> Float64[np.ndarray, " terms"]:
    """The series of diffusion by a share of a width, by which pieces of the surface do not show in displacements.

    Diffusion exp(-tΔ) takes a step along an edge t times on average: a point goes √(t/2) edges along each direction.
    """
    ends = original.positions[edges(np.asarray(original.points.faces))]
    edge = float(np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
    time = min(2 * (_SMOOTHING * width / edge) ** 2, _LONGEST)
    return heat([time], 4 * math.ceil(_TERMS * math.sqrt(time) / 4))[0]


def unsmoothed(mesh: Mesh, steps: int) -> Mesh:
    """Undo steps of smoothing as far as it goes: with one step s(λ) = 1 - λ/10, filter by (1 - (1 - s^n)^9)/s^n.

    That is what eight rounds of x ← x + (y - s^n x) give for the smoothed y. It enlarges nothing more than nine times.
    """
    if steps == 0:
        return mesh

    def gain(place: np.ndarray) -> np.ndarray:
        left = (1 - _STEP_SIZE * (place + 1)) ** steps
        return (1 - (1 - left) ** (_REFINEMENTS + 1)) / left

    places = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    series = np.polynomial.chebyshev.chebfit(places, gain(places), _DEGREE)
    operator = common_laplacian(mesh)
    middle = np.asarray(mesh.vertices).mean(axis=0)
    rows = jnp.asarray(pad_rows(np.asarray(mesh.vertices) - middle, len(operator.degree)), jnp.result_type(float))
    found = np.asarray(filter(operator, series, rows), np.float64)[: len(mesh.vertices)]
    return Mesh(found + middle, mesh.faces)
