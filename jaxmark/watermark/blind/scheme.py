"""The interface of blind schemes: the anchors of an original to write in, and the views of a suspect to read.

An *anchor* is a place on the surface that a reader finds again without the original. A *value* is measured at each
anchor, and the mark changes the values. Keyed choices depend on the anchor's *name*. See `docs/blind.md`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from numbers import Real
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64

from jaxmark.alignment.original import Original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.coding.keys import Choices

STARTS = 256  # small changes of a view that are tried, unless the view needs more
LOOKS_AGAIN = 2  # number of times that a reader sees the suspect again in the likeliest view of a group


@runtime_checkable
class Measured(Protocol):
    """A mesh prepared for measuring the values of its anchors as a function of its vertices; a pytree."""

    def measure(self, vertices: Float[Array, "rows 3"]) -> tuple[Float[Array, " anchors"], Float[Array, " held"]]:
        """Measure the anchors' values, and the quantities that a mark must not change."""
        ...


@jax.jit
def measure(
    shape: Measured, vertices: Float[Array, "rows 3"]
) -> tuple[Float[Array, " anchors"], Float[Array, " held"]]:
    """See `Measured.measure`."""
    return shape.measure(vertices)


class AnchoredHost(NamedTuple):
    """The anchors of an original for one width, with their values."""

    shape: Measured
    names: Int64[np.ndarray, "anchors parts"]  # the names of anchors, from which their keyed choices are derived
    values: Float64[np.ndarray, " anchors"]
    held: Float[Array, " held"]  # quantities that a mark does not change
    good: Float64[np.ndarray, " anchors"]  # 1 for each anchor that is written, else 0
    free: Float[Array, " rows"]  # weight of each vertex's displacement for its contribution to a value
    smoothing: Float64[np.ndarray, " terms"]  # Chebyshev series of the filter for displacements
    step: float  # the quantisation step that is tried first

    @property
    def size(self) -> int:
        """The number of anchors that are written; anchors of the same name count once."""
        return len(np.unique(self.names[self.good > 0], axis=0))


def _nothing_more(change: Float64[np.ndarray, " changes"]) -> None:
    """See nothing more after a small change of a view."""


class Look(NamedTuple):
    """A view of a suspect: its anchors and their values; independent of the key's signs.

    A view is read in several turns, which are half turns and reflections about the axes of its pose.
    """

    names: Int64[np.ndarray, "turns anchors parts"]  # the names of the anchors in each turn
    values: Float[Array, " anchors"]
    good: Bool[np.ndarray, " anchors"]  # whether an anchor counts; padding does not
    changes: Float[Array, "anchors changes"]  # derivatives of the values with respect to small changes of the pose
    spread: tuple[float, ...]  # standard deviations of such changes
    width: float  # width of the averages
    pose: Pose  # the map from the coordinates of the suspect's file to those of the view
    undone: int  # number of smoothing steps that were undone
    mirrored: Bool[np.ndarray, " turns"]  # whether the suspect is a mirror image in this turn
    by_hint: bool = False  # whether the pose was found by the hint of a record
    error: Float64[np.ndarray, " anchors"] | float = 0.0  # standard deviation of values because of a border beside them
    starts: int = STARTS  # number of small changes that are tried
    steps: tuple[float, ...] = ()  # the only quantisation steps that it is read with; all of the scheme's by default
    #: Sees the suspect again after a small change of the view; returns None if that would show nothing more.
    again: "Callable[[Float64[np.ndarray, ' changes']], Look | None]" = _nothing_more


@runtime_checkable
class BlindScheme(Protocol):
    """A blind scheme: a frozen dataclass with public lists of widths and quantisation steps.

    Readers without a record try all widths and steps. A scheme inherits from this class.
    """

    name: ClassVar[str]  # the scheme's name in records and on the command line
    in_parts: ClassVar[bool]  # whether a part of the shape can be read alone
    #: Whether a reader finds the anchors by the key: it takes long, and finds none in an unmarked mesh.
    by_key: ClassVar[bool] = False
    #: Whether it is written after other schemes: their displacements change its values more than its own change theirs.
    written_last: ClassVar[bool] = False
    least_alpha: ClassVar[float] = 0.6  # least fraction α of the way to the lattice that values are moved
    remembered: ClassVar[tuple[str, ...]] = ()  # names of the texts that `recorded` may return
    __dataclass_fields__: ClassVar[dict[str, Any]]
    widths: tuple[float, ...]  # widths of the averages whose differences are the values
    steps: tuple[float, ...]  # quantisation steps of the values
    hiding: bool  # whether displacements are masked perceptually; see `jaxmark.watermark.perception.masking`

    def __post_init__(self) -> None:
        """Check the lists of widths and steps.

        Raises:
            JaxmarkError: if one of them is empty, is no tuple, or holds anything but positive numbers.
        """
        for name, values in (("widths", self.widths), ("steps", self.steps)):
            is_list = isinstance(values, tuple) and bool(values)
            if not is_list or not all(isinstance(value, Real) and 0 < value < math.inf for value in values):
                raise JaxmarkError(f"The {name} of {self.name!r} are a tuple of positive numbers, got {values!r}.")

    @property
    def looks(self) -> int:
        """The largest number of views of a suspect with one width, also of those seen again, times that of turns."""
        ...

    def fixed(self, width: float, step: float, **recorded: str) -> "BlindScheme":
        """Return the scheme with one width and step, and with the parameters that `recorded` returned, if any."""
        return replace(self, widths=(width,), steps=(step,), **recorded)

    def recorded(self, original: Original) -> dict[str, str]:
        """Return further parameters that a record stores and `fixed` takes; they depend on the original only.

        Raises:
            JaxmarkError: see `hosts`.
        """
        return {}

    def hosts(self, original: Original, choices: Choices) -> dict[float, AnchoredHost]:
        """Find the anchors of an original for each width; their arrays have the same shapes for all widths."""
        ...

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[list[Look]]:
        """Iterate over all views of a suspect, in groups that are read together, the likeliest first.

        Args:
            suspect: from `jaxmark.watermark.blind.reading.register`.
            choices: the keyed choices of the mark.

        Raises:
            JaxmarkError: if the suspect has no views.
        """
        ...
