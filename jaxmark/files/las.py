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
_HEADER_BYTES, _HEADER_BYTES_1_4 = 227, 375
_RECORD_BYTES, _EXTENDED_BYTES = 54, 60  # of a variable length record at least, and of one behind the points
_MAX_PACKING = 2_000  # bytes of points for each byte of a LAZ file; scans have 5 to 20, made ones some hundreds


class ScaledNumbers:
    """Positions in the records of a LAS file; see `Numbers`."""

    values: Float64[np.ndarray, "rows 3"]

    def __init__(self, integers: Int64[np.ndarray, "rows 3"], header: Any) -> None:
        """Scale the integers of all records as the header says."""
        self._integers = integers
        self.scales, self.offsets = (np.asarray(part, np.float64) for part in (header.scales, header.offsets))
        self._start, self._size = int(header.offset_to_point_data), int(header.point_format.size)
        with np.errstate(over="ignore", invalid="ignore"):  # numbers that are not finite are refused later
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
    _check_counts(data)
    try:
        return laspy.read(io.BytesIO(data))
    except Exception as error:  # laspy and its decoders raise what they like where bytes are wrong
        reason = " ".join(str(error).split()) or type(error).__name__
        raise JaxmarkError(f"This is no LAS or LAZ file that laspy reads: {reason}.") from error


def _check_counts(data: bytes) -> None:
    """Refuse a header that counts more than the file can hold, which laspy believes.

    Raises:
        JaxmarkError: if it does.
    """
    if len(data) < _HEADER_BYTES:
        raise JaxmarkError(f"This is no LAS or LAZ file: it has {len(data)} bytes, and a header alone more.")
    minor, kind = data[25], data[104]
    begin, points = int.from_bytes(data[94:96], "little"), int.from_bytes(data[96:100], "little")
    records, size = int.from_bytes(data[100:104], "little"), int.from_bytes(data[105:107], "little")
    count = int.from_bytes(data[107:111], "little")
    later = extended = 0
    if minor >= 4 and len(data) >= _HEADER_BYTES_1_4:
        later, extended = int.from_bytes(data[235:243], "little"), int.from_bytes(data[243:247], "little")
        count = max(count, int.from_bytes(data[247:255], "little"))
    held = len(data) * (_MAX_PACKING if kind & 0x80 else 1)  # of compressed points, the highest bit is set
    if (
        begin + _RECORD_BYTES * records > min(points, len(data))
        or (extended and later + _EXTENDED_BYTES * extended > len(data))
        or count * size > held
    ):
        raise JaxmarkError(
            f"This LAS or LAZ file is damaged: its header counts {count} points and {records + extended} other records,"
            f" more than its {len(data)} bytes hold."
        )
