"""Read numbers of binary files by their byte offsets, and write them in the file's own type."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64, Shaped

from jaxmark.errors import JaxmarkError
from jaxmark.files.source import Changes, Indices, Overlay, Rows, SomeRows, changed

_HELD = 0.02  # how far beyond the range of integers a number may be, to be held at its end; see `BinaryNumbers`
INTEGER_ADVICE = "declare its coordinates as float or double instead of integers"


def gather(data: bytes | bytearray, offsets: Int64[np.ndarray, "..."], dtype: np.dtype) -> Shaped[np.ndarray, "..."]:
    """Read the numbers of a type at byte offsets, which must lie inside the data."""
    raw = np.frombuffer(data, np.uint8)
    rows = np.empty((*offsets.shape, dtype.itemsize), np.uint8)
    for byte in range(dtype.itemsize):
        rows[..., byte] = raw[offsets + byte]
    return rows.view(dtype)[..., 0]


def encode(values: Float64[np.ndarray, "..."], dtype: np.dtype, slack: float = 0.0) -> Shaped[np.ndarray, "..."]:
    """Convert finite numbers to a type, rounded to nearest; numbers beyond its range are refused.

    Integers that are out of range by at most `slack` are held at its end.
    """
    if dtype.kind == "f":
        with np.errstate(over="ignore", under="ignore"):
            coded = values.astype(dtype)
        fits = np.isfinite(coded)
    else:
        limits = np.iinfo(dtype)
        rounded = np.rint(values)
        clipped = np.clip(rounded, limits.min, limits.max)
        fits = np.abs(rounded - clipped) <= slack
        coded = np.where(fits, clipped, 0).astype(dtype)
    if not fits.all():
        raise JaxmarkError(f"The number {values[~fits][0]:g} is beyond the range of the file's {dtype.name} numbers.")
    return coded


def overlay(starts: Indices, coded: Shaped[np.ndarray, " numbers"]) -> Overlay:
    """Write encoded numbers at byte offsets."""
    return Overlay(starts, coded.view(np.uint8).reshape(-1, coded.dtype.itemsize))


class BinaryNumbers:
    """Triples of numbers in a binary file; see `Numbers`.

    Quantised positions often fill the range of their integers, so that a mark moves some beyond it. These are held at
    the end of the range if they are beyond it by at most 2 % of it, or, for integers of four bytes, whose range nothing
    fills, by 2 % of the extent of the numbers.
    """

    values: Rows

    def __init__(
        self,
        data: bytes,
        offsets: Int64[np.ndarray, "rows 3"],
        types: Sequence[np.dtype],
        unit: float | np.ndarray = 1.0,
        origin: np.ndarray | None = None,
    ) -> None:
        """Read the numbers at byte offsets, which must lie inside the data.

        Args:
            data: the file.
            offsets: of each number.
            types: of each column.
            unit: the number that a stored 1 stands for, or one a column.
            origin: the number that a stored 0 stands for in each column; by default 0.
        """
        self._offsets, self._types, self._unit, self._origin = offsets, types, unit, origin
        self.values = self._read(data)

    def _read(self, data: bytes) -> Rows:
        with np.errstate(over="ignore", invalid="ignore"):  # signalling NaNs; numbers that are not finite are refused
            columns = [gather(data, self._offsets[:, k], self._types[k]).astype(np.float64) for k in range(3)]
            values = np.stack(columns, axis=1) * self._unit
            return values if self._origin is None else values + self._origin

    def edits(self, values: Rows) -> Changes:
        """Return the overlays, one a column, that write all numbers that changed."""
        moved, overlays = changed(self.values, values), Changes()
        for axis in range(3):
            rows = np.flatnonzero(moved[:, axis])
            overlays.append(overlay(self._offsets[rows, axis], self._encode(values[rows, axis], axis)))
        return overlays

    def rounded(self, values: Rows, rows: Indices) -> SomeRows:
        """Return the numbers of some rows as they are read back once they are written."""
        unit, origin = self._scale
        moved = changed(self.values[rows], values[rows])
        result = self.values[rows]
        for axis in range(3):
            coded = self._encode(values[rows[moved[:, axis]], axis], axis)
            result[moved[:, axis], axis] = coded.astype(np.float64) * unit[axis] + origin[axis]
        return result

    @property
    def _scale(self) -> tuple[np.ndarray, np.ndarray]:
        """The number that a stored 1 stands for in each column, and the one that a 0 stands for."""
        return np.broadcast_to(self._unit, 3), np.zeros(3) if self._origin is None else self._origin

    def _encode(self, values: Float64[np.ndarray, " rows"], axis: int) -> Shaped[np.ndarray, " rows"]:
        (unit, origin), dtype = self._scale, self._types[axis]
        reach = 0.0
        if dtype.kind != "f" and dtype.itemsize > 2:
            reach = float(np.ptp(self.values[:, axis])) / unit[axis]
        elif dtype.kind != "f":
            reach = float(np.iinfo(dtype).max) - float(np.iinfo(dtype).min)
        return encode((values - origin[axis]) / unit[axis], dtype, _HELD * reach)

    def spacing(self, values: Rows, rows: Indices) -> float:
        """Return the largest distance from a column's largest number to the next one, a unit for integers."""
        largest = np.abs(values[rows]).max(axis=0, initial=0.0)
        steps = [
            float(np.spacing(encode(largest[axis : axis + 1], dtype)[0])) if dtype.kind == "f" else self._scale[0][axis]
            for axis, dtype in enumerate(self._types)
        ]
        return float(max(steps))

    def advice(self, step: float) -> str:
        """Advise a type that is fine enough."""
        if any(dtype.kind != "f" for dtype in self._types):
            return INTEGER_ADVICE
        return "centre the mesh on the origin, or use a format with doubles such as PLY with double properties or OBJ"
