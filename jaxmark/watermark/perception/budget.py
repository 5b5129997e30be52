"""Budgets for the strength of a mark: an RMS displacement, limits on any metrics of distortion, or both."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any, Literal, NamedTuple, SupportsFloat

import numpy as np
from jaxtyping import Float64

from jaxmark import distortion
from jaxmark.alignment.original import Original, displace, shift_of
from jaxmark.distortion import LOCAL, Metric, name_of
from jaxmark.distortion.dihedral import flat_faces
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, diagonal, edges, face_normals

Visibility = Literal["hidden", "careful look", "visible"]

#: Limits by visibility. `hidden`: on 99 % of the surface, the change of shading is below the just noticeable
#: difference, with a margin. DAME stays below 0.0092: from this value on, people notice noise three times in four on
#: models of human faces (Geo-metric study, 2022), at the spatial frequency that they see best. At other frequencies,
#: they notice it from values of up to 0.035. Edges, which only wireframes and textures show, change their lengths by at
#: most a tenth. `careful look`: two to three times as much, which is seen in a comparison with the original.
#: `visible`: at least five times as much.
VISIBILITY: Mapping[Visibility, Mapping[str, float]] = {
    "hidden": {"shading": 0.85, "dame": 0.008, "stretch": 0.1},
    "careful look": {"shading": 2.5, "dame": 0.02, "stretch": 0.15},
    "visible": {"shading": 6.0, "dame": 0.05, "stretch": 0.25},
}
#: The same for point clouds, which have no faces that shade. `hidden` is an RMS displacement of 0.02 % of the diagonal.
#: It is less where points are so dense that 5 % of them would move across their surface by more than 0.15 of the
#: distance between nearest points.
CLOUD_VISIBILITY: Mapping[Visibility, Mapping[str, float]] = {
    "hidden": {"rms": 2e-4, "point_to_plane": 0.15},
    "careful look": {"rms": 5e-4, "point_to_plane": 0.4},
    "visible": {"rms": 1e-3, "point_to_plane": 1.0},
}
_FACET, _MOST_OF_FACETS = (
    0.02,
    2.5,
)  # mean edge over the diagonal from which the limit of DAME grows; its largest factor
_MAX_RMS = 0.01  # largest displacement in diagonals if only limits are given; a larger one is no watermark
_USUAL_RMS = 0.003  # budget to advise for meshes whose metrics bound nothing
_FAR_LESS = 0.1  # of the displacement that limits usually allow; of 38 models, 4 are allowed less
_OUTLYING = 20  # times the median turn of faces
_FACES_NAMED = 3
_FIRST_OF_EDGES = 0.04  # displacement over the mean edge that is tried first: limits usually allow about as much
_FIRST_OF_CLOUDS = 2e-4  # displacement of point clouds that is tried first, in diagonals
_MIN_LIMIT_SHARE = 0.99  # share of a limit that must be reached
_SLIGHT_EXCESS = 1e-3  # share of a limit by which it may be exceeded unsaid
_SECANT_STEPS = 10  # number of secant steps, after which bisection follows, which cannot fail


#: The largest allowed values of metrics, by their names in `distortion.METRICS` or by functions of your own.
Limits = Mapping[str, float] | Mapping[Metric, float]


class Bounds(NamedTuple):
    """Upper bounds on the distortion of one mesh, from `Budget.bounds`."""

    rms: float | None  # unweighted RMS displacement of the welded vertices of faces, over the diagonal
    limits: Mapping[Metric, float]  # limits on metrics, by their names in `distortion.METRICS` or by your own functions

    def __str__(self) -> str:
        parts = [] if self.rms is None else [f"a budget of {self.rms:g}"]
        return " and ".join(
            parts + [f"{name_of(metric)} of at most {limit:g}" for metric, limit in self.limits.items()]
        )


@dataclass(frozen=True)
class Budget:
    """How strong a mark may be, and what it must survive; hidden without `rms`, `visibility` and `limits`.

    Functions that take a budget also accept a number for `Budget(rms=...)`, a name for `Budget(visibility=...)`, a
    mapping for `Budget(limits=...)`, and None for `Budget()`.

    Attributes:
        rms: unweighted RMS displacement of the welded vertices of faces, relative to the diagonal of their axis-aligned
            bounding box, in (0, 1): 0.0008 is 0.08 % of it. It is reached exactly, unless a limit is reached first.
        visibility: how well people may see the mark: `"hidden"`, `"careful look"` (seen next to the original) or
            `"visible"`; see `visibility_of` for the corresponding limits.
        limits: the largest allowed values of metrics: of metrics in `distortion.METRICS` by name, in the units of
            `distortion.Comparison`, or of your own metrics by function (see `distortion.measure`).
        noise: the noise that the message must survive if half of the vertices are lost, as half width over the mean
            distance of the vertices to their centre. With 0, only the number of dimensions must suffice; with None, the
            message must only be readable. It has no effect for schemes whose readers have no model of noise.
    """

    rms: float | None = None
    visibility: Visibility | None = None
    limits: Limits | None = None
    noise: float | None = None

    def __post_init__(self) -> None:
        """Check the fields.

        Raises:
            JaxmarkError: if there is no such metric or visibility, or a number is out of range.
        """
        if self.rms is not None and not (_is_number(self.rms) and 0 < self.rms < 1):
            raise JaxmarkError(
                f"The budget is relative to the bounding box's diagonal and in (0, 1), got {self.rms!r}."
            )
        if self.noise is not None and not (_is_number(self.noise) and 0 <= self.noise < math.inf):
            raise JaxmarkError(f"The noise to survive is a number of at least 0, got {self.noise!r}.")
        if self.limits is not None and not isinstance(self.limits, Mapping):
            raise JaxmarkError(
                f'Limits have names: give them as a mapping, such as {{"dame": 0.01}}, got {self.limits!r}.'
            )
        if self.visibility not in (None, *VISIBILITY):
            raise JaxmarkError(f"visibility is one of {', '.join(map(repr, VISIBILITY))}, not {self.visibility!r}.")
        for metric, limit in (self.limits or {}).items():
            if isinstance(metric, str) and metric not in distortion.METRICS:
                known = ", ".join(distortion.METRICS)
                raise JaxmarkError(f"There is no metric {metric!r} to limit; the metrics are {known}.")
            if not isinstance(metric, str) and not callable(metric):
                raise JaxmarkError(f"A metric to limit is a name or a function, got {metric!r}.")
            if not (_is_number(limit) and 0 < limit < math.inf):
                raise JaxmarkError(f"The limit of {name_of(metric)} must be a positive number, got {limit!r}.")
        if self.rms is None and self.visibility is None and self.limits is not None and not self.limits:
            raise JaxmarkError("A mark needs a budget or at least one limit.")
        for name in ("rms", "noise"):
            object.__setattr__(self, name, _plain(getattr(self, name)))
        if self.limits is not None:
            plain = {metric: _plain(limit) for metric, limit in self.limits.items()}
            object.__setattr__(self, "limits", plain)

    @classmethod
    def of(cls, given: "BudgetLike") -> "Budget":
        """Make a budget from a number, a name, limits or None; a budget is returned unchanged.

        Raises:
            JaxmarkError: see `Budget`.
        """
        match given:
            case Budget():
                return given
            case str():
                return cls(visibility=given)
            case Mapping():
                return cls(limits=given)
            case _:
                return cls(rms=given)

    def bounds(self, mesh: Mesh) -> Bounds:
        """Return the bounds for a mesh; each limit is the smaller one of the given one and that of the visibility."""
        return self._bounds(partial(visibility_of, mesh))

    def bounds_of(self, original: Original) -> Bounds:
        """Return the bounds for an original, whose limits by visibility are determined once."""
        return self._bounds(lambda: _visibility(original.derived(_mean_edge_of)))

    def _bounds(self, visibility: Callable[[], Mapping[Visibility, Mapping[str, float]]]) -> Bounds:
        is_hidden = self.rms is None and self.limits is None and self.visibility is None
        name = "hidden" if is_hidden else self.visibility
        limits: dict[Metric, float] = {} if name is None else {**visibility()[name]}
        for metric, limit in (self.limits or {}).items():
            limits[metric] = min(limit, limits.get(metric, math.inf))
        return Bounds(self.rms, limits)

    def __str__(self) -> str:
        """Return the name of the budget in studies: `0.0008`, `hidden` or `dame=0.008`, or several of these."""
        parts = [] if self.rms is None else [str(self.rms)]
        parts += [] if self.visibility is None else [self.visibility]
        parts += [f"{name_of(metric)}={limit}" for metric, limit in (self.limits or {}).items()]
        parts += [] if self.noise is None else [f"noise={self.noise}"]
        return " ".join(parts) or "hidden"


def _is_number(value: Any) -> bool:
    """Whether a value is a number, also one of NumPy or JAX, and no text, truth value or list."""
    return isinstance(value, SupportsFloat) and not isinstance(value, bool) and not getattr(value, "ndim", 0)


def _plain(value: Any) -> Any:
    """Convert a number of NumPy or JAX, which records cannot store."""
    return value if value is None or isinstance(value, int | float) else float(value)


#: A budget, or a short form of one: see `Budget`.
BudgetLike = Budget | float | Visibility | Limits | None


class Written(NamedTuple):
    """The result of `displace_within`: a mesh displaced as far as a budget allows."""

    mesh: Mesh  # the displaced mesh
    scale: float  # factor on the given displacement, in diagonals
    moved: distortion.DisplacementSize  # size of the displacement that was reached
    note: str = ""  # the limit and the faces that allow far less than usual, if there are such


def visibility_of(mesh: Mesh) -> Mapping[Visibility, Mapping[str, float]]:
    """Return the limits of each visibility for a mesh: `VISIBILITY`, or `CLOUD_VISIBILITY` for a point cloud.

    On a model of large facets, a change of angles is a change of few and large areas, which people see less well than
    changes of many small areas. The limit of DAME therefore grows with the mean edge if that is longer than 2 % of the
    diagonal, by a factor of at most 2.5, to 0.02 for `hidden`. The limit of shading does not change.
    `docs/visibility.md` has pictures.
    """
    return _visibility(_mean_edge(mesh))


def _visibility(mean_edge: float | None) -> Mapping[Visibility, Mapping[str, float]]:
    if mean_edge is None:
        return CLOUD_VISIBILITY
    factor = min(max(mean_edge / _FACET, 1.0), _MOST_OF_FACETS)
    return {name: {**limits, "dame": round(factor * limits["dame"], 4)} for name, limits in VISIBILITY.items()}


def first_rms(mesh: Mesh) -> float:
    """Return the RMS displacement, in diagonals, that is tried first if limits determine the displacement."""
    return _first_rms(_mean_edge(mesh))


def _first_rms(mean_edge: float | None) -> float:
    return _FIRST_OF_CLOUDS if mean_edge is None else _FIRST_OF_EDGES * mean_edge


def _mean_edge(mesh: Mesh) -> float | None:
    """Compute the mean length of an edge over the diagonal; None for a point cloud, which has no edges."""
    if not len(mesh.faces):
        return None
    points, pairs = np.asarray(mesh.vertices, np.float64), edges(mesh.faces)
    return float(np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1).mean()) / diagonal(mesh)


def _mean_edge_of(original: Original) -> float | None:
    return _mean_edge(original.mesh)


def reference_of(original: Original) -> distortion.Reference:
    """Return the original's mesh, prepared for metrics; it is prepared once for each original."""
    return original.derived(_reference)


def _reference(original: Original) -> distortion.Reference:
    return distortion.Reference(original.mesh)


def excesses(original: Original, mesh: Mesh, bounds: Bounds) -> list[str]:
    """Measure a displaced mesh, and describe each bound that it exceeds by more than 0.1 %, as after rounding.

    Raises:
        JaxmarkError: see `jaxmark.distortion.measure`.
    """
    measured = reference_of(original).measure(mesh, {*bounds.limits, "rms"})
    values = [(name_of(metric), measured[metric], limit) for metric, limit in bounds.limits.items()]
    if bounds.rms is not None:
        values.append(("the RMS displacement", measured["rms"], bounds.rms))
    return [
        f"{name} is {value:.3g}, above {limit:.3g}"
        for name, value, limit in values
        if value is not None and value > (1 + _SLIGHT_EXCESS) * limit
    ]


def displace_within(
    original: Original,
    shift: Float64[np.ndarray, "points 3"],
    bounds: Bounds,
    reference: distortion.Reference | None = None,
    *,
    first: float | None = None,
    share: float = _MIN_LIMIT_SHARE,
) -> Written:
    """Displace an original as far as a budget allows: to the RMS exactly, or to limits within 1 %, never beyond.

    Args:
        original: the mesh to displace.
        shift: displacement of each point, in diagonals, up to a common factor; not all zero.
        bounds: the bounds on the distortion.
        reference: the mesh that limits are measured against, prepared for metrics; by default the original's.
        first: RMS displacement in diagonals that is tried first, if there are limits; by default `first_rms`.
        share: share of the limits that must be reached; with a smaller one, fewer displacements are tried.

    Raises:
        JaxmarkError: if the displacement is lost in rounding; if limits alone allow an RMS displacement of 0.01; see
            also `distortion.measure`.
    """
    # Budgets are relative to the diagonal of the file's mesh; the original's points may be rounded.
    size = float(distortion.rms(shift[original.used])) * original.diagonal / diagonal(original.mesh)

    compared = reference or reference_of(original)
    measured: dict[float, dict[Metric, float | None]] = {}  # by RMS displacement

    def worst(values: Mapping[Metric, float | None]) -> Metric:
        """Find the metric that is largest relative to its limit."""
        return max(values, key=lambda metric: (values[metric] or 0.0) / bounds.limits[metric])

    def limit_ratio(metrics: Collection[Metric], rms: float) -> float:
        """Compute the largest ratio of a metric to its limit."""
        values = measured.setdefault(rms, {})
        if missing := [metric for metric in metrics if metric not in values]:
            values.update(compared.measure(displace(original, rms / size * shift), missing))
        return max((values[metric] or 0.0) / bounds.limits[metric] for metric in metrics)

    rms = largest = bounds.rms or _MAX_RMS
    if bounds.limits:
        first = first or _first_rms(original.derived(_mean_edge_of))
        # Metrics of single edges are fast. Usually they determine the displacement, and the others are measured once.
        for metrics in dict.fromkeys(
            (tuple(metric for metric in bounds.limits if metric in LOCAL), tuple(bounds.limits))
        ):
            if metrics:
                rms = largest_within(partial(limit_ratio, metrics), rms, first if rms == largest else rms, share)
                if rms == 0:
                    metric = worst(measured[least := min(measured)])
                    raise JaxmarkError(
                        f"The limit of {name_of(metric)}, {bounds.limits[metric]:g}, allows no displacement, however"
                        f" small: at {least:.1g} of the diagonal (RMS) it is {measured[least][metric] or 0:.3g}. Use a"
                        " larger limit."
                    )
        if bounds.rms is None and rms == _MAX_RMS:
            raise JaxmarkError(
                f"A displacement of {_MAX_RMS:g} of the diagonal still keeps {bounds}; give a budget for the RMS"
                f" displacement, too, such as --budget {_USUAL_RMS:g}, or Budget(rms={_USUAL_RMS:g}) in Python."
            )
    marked = displace(original, rms / size * shift)
    reached = distortion.DisplacementSize.of(shift_of(original, marked)[original.used])
    if abs(reached.rms - rms) > 0.01 * rms:
        raise JaxmarkError(f"A budget of {rms:g} is lost in the rounding of this mesh's coordinates; use a larger one.")
    note = ""
    if rms in measured and rms < _FAR_LESS * _first_rms(original.derived(_mean_edge_of)):
        metric = worst(measured[rms])
        if faces := _outlying_faces(original.mesh, marked):
            note = (
                f"The limit of {name_of(metric)}, {bounds.limits[metric]:g}, allows only {rms:.2g} of the diagonal"
                f" (RMS), because a few faces turn far more than others: {faces}. Repair them if they are thin or"
                " folded."
            )
    return Written(marked, rms / size, reached, note)


def _outlying_faces(original: Mesh, marked: Mesh) -> str:
    """Name the faces that turn most, if that is far more than half of the faces turn; otherwise ""."""
    if not len(original.faces):
        return ""
    turns = np.degrees(np.arccos(np.clip(np.sum(face_normals(original) * face_normals(marked), axis=1), -1, 1)))
    turns[flat_faces(original.vertices, original.faces)] = 0.0  # metrics leave them out
    most = np.argsort(-turns)[:_FACES_NAMED]
    if turns[most[0]] < _OUTLYING * np.median(turns):
        return ""
    return ", ".join(f"{face} (by {turns[face]:.2g}°)" for face in most.tolist())


def largest_within(
    within: Callable[[float], float], most: float, first: float, share: float = _MIN_LIMIT_SHARE
) -> float:
    """Find the largest size, up to `most`, at which an increasing function is at most 1; 0 if there is none.

    The search stops when the function is at least `share`. It takes secant steps in logarithms, because metrics are
    nearly powers of the size; each step stays between a size that fits and one that does not.
    """
    low, high = 0.0, math.inf
    size, slope, previous = min(first, most), 1.0, None
    for step in count():
        value = within(size)
        if value <= 1:
            low = size
            if value >= share or size == most:
                return size
        else:
            high = size
        if high <= low * (2 - share):
            return low
        if previous is not None and value > 0 and previous[1] > 0 and size != previous[0] and value != previous[1]:
            slope = math.log(value / previous[1]) / math.log(size / previous[0])
        previous = size, value
        target = (1 + share) / 2
        guess = size * (target / value) ** (1 / slope) if value > 0 and slope > 0.2 else most
        if step >= _SECANT_STEPS or not low < guess < high:
            guess = math.sqrt(low * high) if low > 0 and high < math.inf else 2 * low if low else high / 4
        size = min(guess, most)
        if size < 1e-12:
            break
    return 0.0
