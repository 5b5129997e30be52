"""The blind scheme `field`: values at the anchors of a lattice, in the shape's own pose, which remeshing preserves.

A suspect is read in several views: as it is, with some blur that remeshing may have caused, and with several numbers
of smoothing steps undone. Its pose is nearly that of the marked mesh, up to half turns and reflections along its axes.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Pose
from jaxmark.spectral.chebyshev import filter
from jaxmark.spectral.padding import common_laplacian, pad_rows
from jaxmark.watermark.blind.anchors import WIDER, Anchors, Changes, changes, encloses, look, place, see, turned
from jaxmark.watermark.blind.hint import GROUPS, MOST_POSES, Hint, Posed
from jaxmark.watermark.blind.landmarks import Border
from jaxmark.watermark.blind.scheme import LOOKS_AGAIN, AnchoredHost, BlindScheme, Look, measure
from jaxmark.watermark.blind.shape import Shape, inverse_areas, smoothing_of
from jaxmark.watermark.coding.keys import Choices

_FIRST_STEP = 0.05  # quantisation step that is tried first, in widths
_MIN_GAP = 0.02  # least difference of the variances along two axes, over the largest, with which axes are distinct
_UNDONE_STEPS = (0, 10, 30, 50)  # numbers of smoothing steps to undo; each step is a tenth of the way to the mean
_BLURS = (0.0, 0.2)  # blurs of a suspect that was not smoothed, in shares of the narrow Gaussian's variance
_DEGREE = 64  # degree of the polynomial that undoes smoothing
_REFINEMENTS = 8  # iterations of the fixed-point iteration that undoes smoothing
_STEP_SIZE = 0.1
#: Standard deviations of the small changes of pose that are tried: turns in radians, shifts and growth in sizes.
_SPREAD = (*(3.5e-3,) * 3, *(4e-4,) * 3, 2.5e-3)
#: The same for a pose that a hint gave, with shifts in widths.
_TURN, _SHIFT, _GROWTH = 6e-3, 0.12, 2.5e-3
_STARTS, _SMALLER = 4096, 0.5  # changes of such a pose that are tried; factor on them where a suspect is seen again
_RIM = 2.0  # least distance of the anchors of a part from its border, in widths
_LOST = 1.2  # error of a value, in widths, over the share of the wide average that lies beyond a border
#: The half turns of a shape about its axes; the last four are of its mirror image.
TURNS = np.array(
    [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, -1]], np.int64
)


@dataclass(frozen=True)
class FieldScheme(BlindScheme):
    """A blind scheme that writes values at anchors in the shape's own pose; read after any remeshing.

    Widths and steps are public lists. The largest step that keeps the limits is written, with the width that is
    predicted to survive noise best. Readers without a record try all of them.

    Raises:
        JaxmarkError: if the hint is damaged.
    """

    name: ClassVar[str] = "field"
    in_parts: ClassVar[bool] = False
    remembered: ClassVar[tuple[str, ...]] = ("hint",)
    widths: tuple[float, ...] = (0.018, 0.0125, 0.025)  # widths of the narrow Gaussian, approximately in diagonals
    steps: tuple[float, ...] = tuple(1e-4 * 2 ** (rung / 2) for rung in range(11))  # quantisation steps, in this unit
    hiding: bool = False  # whether displacements are masked perceptually; see `jaxmark.watermark.perception.masking`
    with_hint: bool = True  # whether records get a hint, with which parts are read; see `jaxmark.watermark.blind.hint`
    hint: str = ""  # the hint of a record, for reading

    def __post_init__(self) -> None:
        """Check the hint, and see `BlindScheme`."""
        super().__post_init__()
        if self.hint:
            Hint.from_text(self.hint)

    @property
    def looks(self) -> int:
        """See `BlindScheme`."""
        in_own_pose = (len(_UNDONE_STEPS) - 1 + len(_BLURS)) * len(TURNS)
        return in_own_pose + (MOST_POSES * len(_BLURS) + GROUPS * LOOKS_AGAIN if self.hint else 0)

    def hosts(self, original: Original, choices: Choices) -> dict[float, AnchoredHost]:
        """See `BlindScheme`.

        Raises:
            JaxmarkError: if the shape's pose is not unique.
        """
        faces = np.asarray(original.points.faces)
        placement = place(Mesh(original.positions, faces))
        variances = np.diag(placement.moments.covariance)
        if (-np.diff(variances) < _MIN_GAP * variances[0]).any():
            raise JaxmarkError(
                "This shape is (nearly) equally wide in two directions, so that its pose cannot be found without the"
                " original; use the scheme 'local', which is blind, too, or 'keyed'."
            )
        dtype, rows = original.signal.dtype, original.to_traced(original.positions)
        faces = turned(faces) if placement.inside_out else faces
        matrix, shift = jnp.asarray(placement.pose.matrix, dtype), jnp.asarray(placement.pose.shift, dtype)
        closed, free, hosts = encloses(original.points), inverse_areas(original), {}
        views = see(Mesh(placement.pose(original.positions), faces), self.widths, dtype)
        for width, (pieces, surface, anchors) in views.items():
            size = jnp.asarray(width, dtype)
            shape = Shape(matrix, shift, faces, pieces, anchors, size, closed)
            measured = look(surface, anchors, jnp.zeros(anchors.places.shape, dtype), size, jnp.zeros((), dtype))
            good = np.asarray(measured.good, np.float64)
            _, pose = measure(shape, rows)
            values = np.asarray(measured.values, np.float64)
            smoothing = smoothing_of(original, width)
            hosts[width] = AnchoredHost(shape, anchors.cells, values, pose, good, free, smoothing, _FIRST_STEP * width)
        return hosts

    def recorded(self, original: Original) -> dict[str, str]:
        """See `BlindScheme`: a hint, unless the scheme leaves it out."""
        if not self.with_hint:
            return {}
        placement = place(Mesh(original.positions, np.asarray(original.points.faces)))
        return {"hint": Hint.of(placement.mesh, placement.pose.scale / original.diagonal).to_text()}

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[list[Look]]:
        """See `BlindScheme`.

        Raises:
            JaxmarkError: see `place` and `see`, for the suspect as it is.
        """
        smooth, *rough = _UNDONE_STEPS
        refusal, is_seen = None, False
        try:
            yield self._in_own_pose(suspect, smooth)
        except JaxmarkError as error:
            refusal = error
        if self.hint:
            for poses in Hint.from_text(self.hint).poses(suspect):
                looks = [look for posed in poses for look in self._in_pose(suspect, posed)]
                is_seen |= bool(looks)
                yield looks
        if refusal is not None and not is_seen:
            raise refusal
        for steps in rough:
            # A suspect that has noise and was not smoothed is too rough for some views.
            with suppress(JaxmarkError):
                yield self._in_own_pose(suspect, steps)

    def _in_own_pose(self, suspect: Mesh, undone: int) -> list[Look]:
        """See a suspect in its own pose, after undoing smoothing steps.

        Raises:
            JaxmarkError: see `place` and `see`.
        """
        placement = place(unsmoothed(suspect, undone))
        return [
            Look(
                anchors.cells * TURNS[:, None],
                view.shown.values,
                np.asarray(view.shown.good),
                _by_pose(view, np.asarray(anchors.places)),
                _SPREAD,
                width,
                placement.pose,
                undone,
                TURNS.prod(axis=1) < 0,
            )
            for width, _, anchors, view in self._seen(placement.mesh, _BLURS if undone == 0 else _BLURS[:1])
        ]

    def _in_pose(self, suspect: Mesh, posed: Posed, blurs: Sequence[float] = _BLURS, factor: float = 1.0) -> list[Look]:
        """See a suspect, which may be a part, in a pose that a hint gave; none if its surface is too large for it.

        Args:
            suspect: the suspect in the coordinates of its file.
            posed: its pose.
            blurs: the blurs that remeshing may have caused.
            factor: factor on the small changes of pose that are tried.
        """
        mesh = posed.apply(suspect)
        border, looks = Border(mesh), []
        with suppress(JaxmarkError):
            for width, blur, anchors, view in self._seen(mesh, blurs):
                places = np.asarray(anchors.places)
                distance = border.distances(places)
                good = np.asarray(view.shown.good) & (distance >= _RIM * width)
                # A turn about the centre of the part moves it less than a turn about the origin.
                centre = places[good].mean(axis=0) if good.any() else np.zeros(3)
                spread = np.array((*(_TURN,) * 3, *(_SHIFT * width,) * 3, _GROWTH))
                looks.append(
                    Look(
                        anchors.cells[None],
                        view.shown.values,
                        good,
                        _by_pose(view, places - centre),
                        tuple((factor * spread).tolist()),
                        width,
                        posed.pose,
                        0,
                        np.array([posed.pose.mirrors]),
                        by_hint=True,
                        error=_LOST * width * ndtr(-distance / (WIDER * width)),
                        starts=_STARTS,
                        again=partial(self._again, suspect, posed, width, centre, blur),
                    )
                )
        return looks

    def _again(
        self,
        suspect: Mesh,
        posed: Posed,
        width: float,
        centre: Float64[np.ndarray, " 3"],
        blur: float,
        change: Float64[np.ndarray, " changes"],
    ) -> Look | None:
        """See a suspect again after a small change of its pose about a centre, which moved the anchors; see `Look`."""
        matrix = (1 + change[6]) * Rotation.from_rotvec(change[:3]).as_matrix()
        motion = Pose(matrix, centre - matrix @ centre + change[3:6])
        changed = posed._replace(pose=posed.pose.then(motion.inverse()))
        looks = replace(self, widths=(width,))._in_pose(suspect, changed, (blur,), _SMALLER)
        return looks[0] if looks else None

    def _seen(self, mesh: Mesh, blurs: Sequence[float]) -> Iterator[tuple[float, float, Anchors, Changes]]:
        """Measure the values of a surface for each width and blur.

        Raises:
            JaxmarkError: see `see`.
        """
        dtype = jnp.result_type(float)
        for width, (_, surface, anchors) in see(mesh, self.widths, dtype).items():
            for blur in blurs:
                yield (
                    width,
                    blur,
                    anchors,
                    changes(surface, anchors, jnp.asarray(width, dtype), jnp.asarray(blur, dtype)),
                )


def _by_pose(view: Changes, places: Float64[np.ndarray, "anchors 3"]) -> Float[Array, "anchors 7"]:
    """Compute the derivatives of values with respect to turns, shifts and growth, as `_SPREAD` lists them."""
    positions = jnp.asarray(places, view.slope.dtype)
    return jnp.concatenate([jnp.cross(positions, view.slope), view.slope, view.growth[:, None]], axis=1)


def unsmoothed(mesh: Mesh, steps: int) -> Mesh:
    """Undo smoothing steps as far as possible: filter by (1 - (1 - s^n)^9)/s^n, where s(λ) = 1 - λ/10 is one step.

    The filter is equivalent to eight iterations of x ← x + (y - s^n x) for the smoothed mesh y. Its gain is at most 9.
    """
    if steps == 0:
        return mesh

    def gain(place: np.ndarray) -> np.ndarray:
        remaining = (1 - _STEP_SIZE * (place + 1)) ** steps
        return (1 - (1 - remaining) ** (_REFINEMENTS + 1)) / remaining

    places = np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    series = np.polynomial.chebyshev.chebfit(places, gain(places), _DEGREE)
    operator = common_laplacian(mesh)
    centre = np.asarray(mesh.vertices).mean(axis=0)
    rows = jnp.asarray(pad_rows(np.asarray(mesh.vertices) - centre, len(operator.degree)), jnp.result_type(float))
    filtered = np.asarray(filter(operator, series, rows), np.float64)[: len(mesh.vertices)]
    return Mesh(filtered + centre, mesh.faces)
