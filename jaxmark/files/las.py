"""Parse LAS and LAZ, the formats of laser scans: positions are integers with a scale and an offset."""

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.extras import require
from jaxmark.files.binary import encode
from jaxmark.files.source import Edits, Overlay, Patched, Source, changed

_BOX = 179  # byte offset of the header's bounding box: largest and smallest x, then y, then z, as doubles
_INTEGER = np.dtype("<i4")


class ScaledNumbers:
    """Positions in the records of a LAS file; see `Numbers`."""

    values: Float64[np.ndarray, "rows 3"]

    def __init__(self, integers: Int64[np.ndarray, "rows 3"], header: Any) -> None:
        """Scale the integers of all records as the header says."""
        self._integers = integers
        self.scales, self.offsets = (np.asarray(part, np.float64) for part in (header.scales, header.offsets))
        self._start, self._size = int(header.offset_to_point_data), int(header.point_format.size)
        self.values = integers * self.scales + self.offsets

    def integers(self, values: Float64[np.ndarray, "rows 3"]) -> Int64[np.ndarray, "rows 3"]:
        """The integers of new values; those of numbers that did not change stay.

        Raises:
            JaxmarkError: if a number is beyond the range of 32 bits.
        """
        coded = encode((values - self.offsets) / self.scales, _INTEGER).astype(np.int64)
        return np.where(changed(self.values, values), coded, self._integers)

    def edits(self, values: Float64[np.ndarray, "rows 3"]) -> list[Edits | Overlay]:
        """The overlays, one a column, that write all numbers that changed, and the box around all of them.

        Raises:
            JaxmarkError: if a number is beyond the range of 32 bits.
        """
        integers = self.integers(values)
        overlays: list[Edits | Overlay] = []
        for axis in range(3):
            rows = np.flatnonzero(integers[:, axis] != self._integers[:, axis])
            coded = integers[rows, axis].astype(_INTEGER)
            places = self._start + self._size * rows + _INTEGER.itemsize * axis
            overlays.append(Overlay(places, coded.view(np.uint8).reshape(-1, _INTEGER.itemsize)))
        if (integers != self._integers).any():
            placed = integers * self.scales + self.offsets
            box = np.stack([placed.max(axis=0), placed.min(axis=0)], axis=1).ravel().astype("<f8")
            overlays.append(Overlay(_BOX + 8 * np.arange(6), box.view(np.uint8).reshape(-1, 8)))
        return overlays

    def spacing(self, values: Float64[np.ndarray, "rows 3"], rows: Int64[np.ndarray, " some"]) -> float:
        """The largest scale, or of double precision if that is larger."""
        return max(float(self.scales.max()), float(np.spacing(np.abs(values[rows]).max(initial=0.0))))

    def advice(self, step: float) -> str:
        """Advise a scale."""
        return f"save it with a scale of at most {step:.1g}"


@dataclass
class _Compressed(Source):
    """A LAZ file, whose records lie packed: they are unpacked, and packed again with other positions."""

    def patch(self, positions: Float64[np.ndarray, "points 3"], name: str) -> Patched:
        """See `Source`; everything but the positions and their box is what it was, once it is unpacked."""
        cloud = _read(self.data)
        assert isinstance(self.coordinates, ScaledNumbers)
        integers = self.coordinates.integers(positions)
        for axis, column in enumerate("XYZ"):
            cloud[column] = integers[:, axis]
        out = io.BytesIO()
        cloud.write(out, do_compress=True)
        return Patched(out.getvalue())


def parse(data: bytes) -> Source:
    """Read the positions of all records, of LAS or LAZ; everything else is left alone.

    Raises:
        JaxmarkError: if laspy is missing or cannot read the file, or it has no points.
    """
    cloud = _read(data)
    integers = np.stack([np.asarray(cloud[name], np.int64) for name in "XYZ"], axis=1)
    kind = _Compressed if cloud.header.are_points_compressed else Source
    return kind(data, ScaledNumbers(integers, cloud.header), np.zeros((0, 3), np.int64))


def _read(data: bytes) -> Any:
    laspy = require("laspy", "files")
    try:
        return laspy.read(io.BytesIO(data))
    except Exception as error:  # laspy and its decoders raise what they like where bytes are wrong
        raise JaxmarkError(f"This is no LAS or LAZ file that laspy reads: {' '.join(str(error).split())}.") from error
