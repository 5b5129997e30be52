"""What a blind scheme is: what it shows of an original to write in, and of a suspect to read."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Float64, Int64

from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import Mesh
from jaxmark.geometry.pose import Pose
from jaxmark.watermark.coding.keys import Choices


@runtime_checkable
class Measured(Protocol):
    """What values are computed from, but the vertices; a pytree."""

    def measure(self, vertices: Float[Array, "rows 3"]) -> tuple[Float[Array, " anchors"], Float[Array, " held"]]:
        """The anchors' values, and what a mark must leave as it is."""
        ...


@jax.jit
def measure(
    shape: Measured, vertices: Float[Array, "rows 3"]
) -> tuple[Float[Array, " anchors"], Float[Array, " held"]]:
    """See `Measured.measure`."""
    return shape.measure(vertices)


class AnchoredHost(NamedTuple):
    """An original as its anchors of one width show it."""

    shape: Measured
    names: Int64[np.ndarray, "anchors parts"]  # what the key's choices of each anchor depend on
    values: Float64[np.ndarray, " anchors"]
    held: Float[Array, " held"]  # what a mark leaves as it is
    good: Float64[np.ndarray, " anchors"]  # 1 for each anchor that is written, else 0
    free: Float[Array, " rows"]  # how far each vertex moves for its part in a value
    smoothing: Float64[np.ndarray, " terms"]  # Chebyshev series of the filter that displacements go through
    step: float  # of the lattice of values, which is tried first

    @property
    def size(self) -> int:
        """Number of anchors that are written; those of one name count once."""
        return len(np.unique(self.names[self.good > 0], axis=0))


class Look(NamedTuple):
    """One way of looking at a suspect; independent of the key's signs."""

    names: Int64[np.ndarray, "turns anchors parts"]  # of the anchors, for each way in which the suspect may lie
    values: Float[Array, " anchors"]
    good: Bool[np.ndarray, " anchors"]  # whether an anchor counts; padding does not
    changes: Float[Array, "anchors changes"]  # of the values, as the suspect lies a little otherwise
    spread: tuple[float, ...]  # how large such changes are
    width: float  # of the averages
    pose: Pose  # from the suspect's file to where it was looked at
    undone: int  # steps of smoothing that were undone
    mirrored: Bool[np.ndarray, " turns"]  # whether it is then the mirror image of what was marked


@runtime_checkable
class BlindScheme(Protocol):
    """A frozen dataclass of public ladders: whoever reads without a record tries all of them.

    A scheme inherits from this class.
    """

    name: ClassVar[str]  # in records and on the command line
    in_parts: ClassVar[bool]  # whether a part of the shape is read as the whole is
    looks: ClassVar[int]  # number of ways of looking at a suspect with one width, and of its lying there
    __dataclass_fields__: ClassVar[dict[str, Any]]
    widths: tuple[float, ...]  # of the averages that values are differences of
    steps: tuple[float, ...]  # of the lattice that values are written to
    hiding: bool  # whether points move where and as it is hidden; see `jaxmark.watermark.perception.masking`

    def fixed(self, width: float, step: float) -> "BlindScheme":
        """Return the scheme with one width and step."""
        return replace(self, widths=(width,), steps=(step,))

    def hosts(self, original: Original, choices: Choices) -> dict[float, AnchoredHost]:
        """Look at an original by anchors of each width; all have arrays of the same shapes."""
        ...

    def views(self, suspect: Mesh, choices: Choices) -> Iterator[Look]:
        """Look at a suspect in all ways, the likeliest first.

        Args:
            suspect: from `jaxmark.watermark.blind.reading.register`.
            choices: the keyed choices of the mark.

        Raises:
            JaxmarkError: if it cannot be looked at.
        """
        ...
