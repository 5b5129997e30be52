"""How strong a mark may be: an RMS displacement, limits on any metrics of distortion, or both."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmark import distortion
from jaxmark.alignment.original import Original, displace, shift_of
from jaxmark.distortion import LOCAL, Metric, name_of
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, diagonal, edges

Visibility = Literal["hidden", "careful look", "visible"]

#: Limits by what people see. Hidden: nowhere, on 99 % of the surface, does shading change by what is just noticed, less
#: a notch; and in the Geo-metric study (2022), people notice noise in a face three times in four from a DAME of 0.0092
#: on, at the spatial frequency at which they see it best, at other frequencies from up to 0.035 on. Edges, which only
#: wireframes and textures show, change by no more than a tenth. On a careful look: two to three times that is seen by
#: who compares with the original. Visible: five times and more.
VISIBILITY: Mapping[Visibility, Mapping[str, float]] = {
    "hidden": {"shading": 0.85, "dame": 0.008, "stretch": 0.1},
    "careful look": {"shading": 2.5, "dame": 0.02, "stretch": 0.15},
    "visible": {"shading": 6.0, "dame": 0.05, "stretch": 0.25},
}
#: The same for point clouds, which have no faces that shade: hidden is an RMS displacement of 0.02 % of the diagonal,
#: or less where points are so dense that 5 % of them would move across their surface by more than 0.15 of the distance
#: between nearest points.
CLOUD_VISIBILITY: Mapping[Visibility, Mapping[str, float]] = {
    "hidden": {"rms": 2e-4, "point_to_plane": 0.15},
    "careful look": {"rms": 5e-4, "point_to_plane": 0.4},
    "visible": {"rms": 1e-3, "point_to_plane": 1.0},
}
_FACET, _MOST_OF_FACETS = 0.02, 2.5  # mean edge over the diagonal beyond which a model is one of facets
_MAX_RMS = 0.01  # displacement in diagonals, if only limits are given; a larger one is no watermark
_FIRST_OF_EDGES = 0.04  # displacement over the mean edge that is tried first: limits mostly allow about as much
_FIRST_OF_CLOUDS = 2e-4  # the same of point clouds, in diagonals
_MIN_LIMIT_SHARE = 0.99  # share of a limit that is as good as all of it
_SECANT_STEPS = 10  # then bisection, which cannot fail


#: The largest values of metrics, by their names in `distortion.METRICS` or by functions of your own.
Limits = Mapping[str, float] | Mapping[Metric, float]


class Bounds(NamedTuple):
    """Upper bounds on the distortion of one mesh, from `Budget.bounds`."""

    rms: float | None  # RMS displacement of the welded vertices that faces use, unweighted, over the diagonal
    limits: Mapping[Metric, float]  # on metrics, by their names in `distortion.METRICS`, or on functions of your own

    def __str__(self) -> str:
        parts = [] if self.rms is None else [f"a budget of {self.rms:g}"]
        return " and ".join(
            parts + [f"{name_of(metric)} of at most {limit:g}" for metric, limit in self.limits.items()]
        )


@dataclass(frozen=True)
class Budget:
    """How strong a mark may be, and what it must survive. Without `rms`, `visibility` and `limits`, it is hidden.

    Where a budget is expected, a number stands for `Budget(rms=...)`, a name for `Budget(visibility=...)`, a mapping
    for `Budget(limits=...)`, and None for `Budget()`.

    Attributes:
        rms: RMS displacement of the welded vertices that faces use, unweighted, relative to the diagonal of their
            axis-aligned bounding box, in (0, 1): 0.0008 is 0.08 % of it. Met exactly, unless a limit is reached first.
        visibility: how well people may see the mark: `"hidden"`, `"careful look"` (seen beside the original) or
            `"visible"`; see `visibility_of` for the limits that these stand for.
        limits: the largest values that metrics of `distortion.METRICS` may reach, by name, in the units of
            `distortion.Comparison`; or that metrics of your own may, by function (see `distortion.measure`).
        noise: the noise that the message must survive when half of the vertices are lost, as half width over the mean
            distance of the vertices to their centre; 0 requires only that there are enough dimensions, None nothing
            but that the message reads. It has no effect for schemes whose readers have no model of noise.
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
        if self.rms is not None and not 0 < self.rms < 1:
            raise JaxmarkError(f"The budget is relative to the bounding box's diagonal and in (0, 1), got {self.rms}.")
        if self.noise is not None and not 0 <= self.noise < math.inf:
            raise JaxmarkError(f"The noise to survive is a number of at least 0, got {self.noise}.")
        if self.visibility not in (None, *VISIBILITY):
            raise JaxmarkError(f"visibility is one of {', '.join(map(repr, VISIBILITY))}, not {self.visibility!r}.")
        for metric, limit in (self.limits or {}).items():
            if isinstance(metric, str) and metric not in distortion.METRICS:
                known = ", ".join(distortion.METRICS)
                raise JaxmarkError(f"There is no metric {metric!r} to limit; there are {known}.")
            if not 0 < limit < math.inf:
                raise JaxmarkError(f"The limit of {name_of(metric)} must be a positive number, got {limit}.")
        if self.rms is None and self.visibility is None and self.limits is not None and not self.limits:
            raise JaxmarkError("A mark needs a budget or at least one limit.")

    @classmethod
    def of(cls, given: "BudgetLike") -> "Budget":
        """Make a budget from a number, a name, limits or None; a budget is returned as it is.

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
        """Return the bounds for a mesh: the least of the limits that are given and those of the visibility."""
        is_hidden = self.rms is None and self.limits is None and self.visibility is None
        name = "hidden" if is_hidden else self.visibility
        wanted: dict[Metric, float] = {} if name is None else {**visibility_of(mesh)[name]}
        for metric, limit in (self.limits or {}).items():
            wanted[metric] = min(limit, wanted.get(metric, math.inf))
        return Bounds(self.rms, wanted)

    def __str__(self) -> str:
        """The name by which a study calls the budget: `0.0008`, `hidden` or `dame=0.008`, or several of these."""
        parts = [] if self.rms is None else [str(self.rms)]
        parts += [] if self.visibility is None else [self.visibility]
        parts += [f"{name_of(metric)}={limit}" for metric, limit in (self.limits or {}).items()]
        parts += [] if self.noise is None else [f"noise={self.noise}"]
        return " ".join(parts) or "hidden"


#: What stands for a budget: see `Budget`.
BudgetLike = Budget | float | Visibility | Limits | None


class Written(NamedTuple):
    """The result of `displace_within`: a mesh displaced as far as a budget allows."""

    mesh: Mesh  # the displaced mesh
    scale: float  # factor on the given displacement, in diagonals
    moved: distortion.DisplacementSize  # size of the displacement that was reached


def visibility_of(mesh: Mesh) -> Mapping[Visibility, Mapping[str, float]]:
    """The limits by what people see of such a mesh: `VISIBILITY`, or of a point cloud `CLOUD_VISIBILITY`.

    On a model of large facets, a change of angles is a change of few and large areas, which people see less well than
    of many small ones: the limit of DAME grows with the mean edge where that is longer than 2 % of the diagonal, up to
    two and a half times, 0.02 for what is hidden. What shading allows stays; `docs/visibility.md` has pictures.
    """
    if not len(mesh.faces):
        return CLOUD_VISIBILITY
    factor = min(max(_mean_edge(mesh) / _FACET, 1.0), _MOST_OF_FACETS)
    return {name: {**limits, "dame": round(factor * limits["dame"], 4)} for name, limits in VISIBILITY.items()}


def first_rms(mesh: Mesh) -> float:
    """The RMS displacement in diagonals that is tried first, where limits say how far a mesh may be displaced."""
    return _FIRST_OF_EDGES * _mean_edge(mesh) if len(mesh.faces) else _FIRST_OF_CLOUDS


def _mean_edge(mesh: Mesh) -> float:
    """Mean length of an edge over the diagonal."""
    points, pairs = np.asarray(mesh.vertices, np.float64), edges(mesh.faces)
    return float(np.linalg.norm(points[pairs[:, 1]] - points[pairs[:, 0]], axis=1).mean()) / diagonal(mesh)


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
        bounds: the bounds to keep.
        reference: of the original's mesh, if there is one already: limits are measured against it.
        first: RMS displacement in diagonals that is tried first, if there are limits; by default see `first_rms`.
        share: of the limits, as good as all of them: with less, fewer displacements are tried.

    Raises:
        JaxmarkError: if the displacement is lost in rounding; if limits alone allow an RMS displacement of 0.01; or see
            `distortion.measure`.
    """
    # Budgets are relative to the file's diagonal; the original's points may be rounded.
    size = float(distortion.rms(shift[original.used])) * original.diagonal / diagonal(original.mesh)

    compared = reference or distortion.Reference(original.mesh)

    def limit_ratio(metrics: Collection[Metric], rms: float) -> float:
        """The largest ratio of a metric to its limit."""
        found = compared.measure(displace(original, rms / size * shift), metrics)
        return max((found[metric] or 0.0) / bounds.limits[metric] for metric in metrics)

    rms = most = bounds.rms or _MAX_RMS
    if bounds.limits:
        first = first or first_rms(original.mesh)
        # What single edges tell is quickly found; mostly it is as little as all limits allow, and they are tried once.
        for metrics in dict.fromkeys((tuple(one for one in bounds.limits if one in LOCAL), tuple(bounds.limits))):
            if metrics:
                rms = largest_within(partial(limit_ratio, metrics), rms, first if rms == most else rms, share)
        if bounds.rms is None and rms == _MAX_RMS:
            raise JaxmarkError(
                f"Moved by {_MAX_RMS:g} of its diagonal, this mesh still keeps {bounds}; give a budget, too."
            )
    marked = displace(original, rms / size * shift)
    reached = distortion.DisplacementSize.of(shift_of(original, marked)[original.used])
    if abs(reached.rms - rms) > 0.01 * rms:
        raise JaxmarkError(f"A budget of {rms:g} is lost in the rounding of this mesh's coordinates; use a larger one.")
    return Written(marked, rms / size, reached)


def largest_within(
    within: Callable[[float], float], most: float, first: float, share: float = _MIN_LIMIT_SHARE
) -> float:
    """Find the largest size, up to `most`, at which a rising function is at most 1; `share` of that will do.

    Secant steps in logarithms, because metrics are nearly powers of the size; each step stays between a size that fits
    and one that does not.
    """
    low, high = 0.0, math.inf
    size, slope, before = min(first, most), 1.0, None
    for tries in count():
        value = within(size)
        if value <= 1:
            low = size
            if value >= share or size == most:
                return size
        else:
            high = size
        if high <= low * (2 - share):
            return low
        if before is not None and value > 0 and before[1] > 0 and size != before[0] and value != before[1]:
            slope = math.log(value / before[1]) / math.log(size / before[0])
        before = size, value
        aim = (1 + share) / 2
        guess = size * (aim / value) ** (1 / slope) if value > 0 and slope > 0.2 else most
        if tries >= _SECANT_STEPS or not low < guess < high:
            guess = math.sqrt(low * high) if low > 0 and high < math.inf else 2 * low if low else high / 4
        size = min(guess, most)
        if size < 1e-12:
            break
    raise JaxmarkError("No displacement, however small, keeps the limits; use larger ones.")
