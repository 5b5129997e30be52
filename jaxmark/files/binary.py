"""Read numbers of binary files by their byte offsets, and write them in the file's own type."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from jaxmark.errors import JaxmarkError
from jaxmark.files.source import Edits, Numbers, Overlay, changed

_MAX_CLIPPED = 1e-3  # of the range of integers


def gather(data: bytes, offsets: Int64[np.ndarray, "..."], dtype: np.dtype) -> Shaped[np.ndarray, "..."]:
    """Read the numbers of a type at byte offsets, which must lie inside the data."""
    raw = np.frombuffer(data, np.uint8)
    rows = np.empty((*offsets.shape, dtype.itemsize), np.uint8)
    for byte in range(dtype.itemsize):
        rows[..., byte] = raw[offsets + byte]
    return rows.view(dtype)[..., 0]


def encode(values: Float64[np.ndarray, "..."], dtype: np.dtype) -> Shaped[np.ndarray, "..."]:
    """Convert finite numbers to a type, rounded to nearest; integers that are hardly out of range, to its end.

    Raises:
        JaxmarkError: if a number is beyond the type's range.
    """
    if dtype.kind == "f":
        with np.errstate(over="ignore", under="ignore"):
            coded = values.astype(dtype)
        fits = np.isfinite(coded)
    else:
        limits = np.iinfo(dtype)
        rounded = np.rint(values)
        # What lies at the end of the range may be moved beyond it, by next to nothing.
        over = _MAX_CLIPPED * (float(limits.max) - float(limits.min))
        rounded = np.where(rounded > limits.max + over, rounded, np.minimum(rounded, limits.max))
        rounded = np.where(rounded < limits.min - over, rounded, np.maximum(rounded, limits.min))
        fits = (rounded >= limits.min) & (rounded <= limits.max)
        coded = np.where(fits, rounded, 0).astype(dtype)
    if not fits.all():
        raise JaxmarkError(f"The number {values[~fits][0]:g} is beyond the range of the file's {dtype.name} numbers.")
    return coded


class BinaryNumbers:
    """Triples of numbers in a binary file; see `Numbers`."""

    values: Float64[np.ndarray, "rows 3"]

    def __init__(
        self,
        data: bytes,
        offsets: Int64[np.ndarray, "rows 3"],
        types: tuple[np.dtype, ...],
        unit: float = 1.0,
    ) -> None:
        """Read the numbers at byte offsets, which must lie inside the data.

        Args:
            data: the file.
            offsets: of each number.
            types: of each column.
            unit: what a stored 1 stands for.
        """
        self._offsets = offsets
        self._types = types
        self._unit = unit
        with np.errstate(invalid="ignore"):  # signalling NaNs
            columns = [gather(data, offsets[:, axis], types[axis]).astype(np.float64) for axis in range(3)]
        self.values = np.stack(columns, axis=1) * unit

    def edits(self, values: Float64[np.ndarray, "rows 3"]) -> list[Edits | Overlay]:
        """The overlays, one a column, that write all numbers that changed.

        Raises:
            JaxmarkError: if a number is beyond the type's range.
        """
        moved = changed(self.values, values)
        overlays: list[Edits | Overlay] = []
        for axis, dtype in enumerate(self._types):
            rows = np.flatnonzero(moved[:, axis])
            coded = encode(values[rows, axis] / self._unit, dtype)
            overlays.append(Overlay(self._offsets[rows, axis], coded.view(np.uint8).reshape(-1, dtype.itemsize)))
        return overlays

    def spacing(self, values: Float64[np.ndarray, "rows 3"], rows: Int64[np.ndarray, " some"]) -> float:
        """The distance from the largest number of a column to the next one, a unit for integers; the largest of all.

        Raises:
            JaxmarkError: if a number is beyond the type's range.
        """
        largest = np.abs(values[rows]).max(axis=0, initial=0.0) / self._unit
        coded = [encode(largest[axis : axis + 1], dtype) for axis, dtype in enumerate(self._types)]
        return self._unit * max(float(np.spacing(top[0])) if top.dtype.kind == "f" else 1.0 for top in coded)

    def advice(self, step: float) -> str:
        """Advise a type that is fine enough."""
        if any(dtype.kind != "f" for dtype in self._types):
            return "declare its coordinates as float or double instead of integers"
        return "centre the mesh on the origin, or use a format with doubles such as PLY with double properties or OBJ"


class JoinedNumbers:
    """Triples of numbers that follow each other in several parts; see `Numbers`."""

    def __init__(self, parts: Sequence[Numbers]) -> None:
        self._parts = parts
        self._ends = np.cumsum([len(part.values) for part in parts])
        self.values = np.concatenate([part.values for part in parts])

    def edits(self, values: Float64[np.ndarray, "rows 3"]) -> list[Edits | Overlay]:
        """See `Numbers`."""
        pieces = zip(self._parts, np.split(values, self._ends[:-1]), strict=True)
        return [edit for part, piece in pieces for edit in part.edits(piece)]

    def spacing(self, values: Float64[np.ndarray, "rows 3"], rows: Int64[np.ndarray, " some"]) -> float:
        """See `Numbers`."""
        place = np.searchsorted(self._ends, rows, side="right")
        starts = np.concatenate([[0], self._ends])
        return max(
            self._parts[part].spacing(values[starts[part] : starts[part + 1]], rows[place == part] - starts[part])
            for part in np.unique(place)
        )

    def advice(self, step: float) -> str:
        """See `Numbers`."""
        return self._parts[0].advice(step)
