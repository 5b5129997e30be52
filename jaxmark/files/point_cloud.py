"""Parse point clouds: LAS and LAZ, the formats of laser scans, and XYZ, text with three or more columns of numbers."""

import io
import struct
from typing import Any

import numpy as np

from jaxmark.errors import JaxmarkError, require
from jaxmark.files import limits
from jaxmark.files.binary import BinaryNumbers, overlay
from jaxmark.files.source import Changes, Indices, Patched, Rows, Source, splice
from jaxmark.files.text import Lines, Text, blank, is_numeral, unix, without_comments
from jaxmark.files.unpacking import Unpacker
from jaxmark.geometry.pose import Points

_KIND, _PACKED = 104, 0x80  # byte offset of the kind of records, and the bit that is set where they are packed
_BOX = 179  # byte offset of the header's bounding box: largest and smallest x, then y, then z, as doubles
_INTEGER = np.dtype("<i4")
_HEADER_BYTES, _HEADER_BYTES_1_4 = 227, 375
_RECORD_BYTES, _EXTENDED_BYTES = 54, 60  # of a variable length record at least, and of one behind the points
_OCTREE = range(377, 381)  # byte offsets of the word that begins the octree of cloud-optimised point clouds
_NO_FACES = np.zeros((0, 3), np.int64)


def parse_xyz(data: bytes) -> Source:
    """Read the first three numbers of each line, between spaces, commas or semicolons; other columns are left alone.

    A first line that holds only the number of points, a line of column names after it, and what stands after `#` or
    `//` are passed over.

    Raises:
        JaxmarkError: if a line has fewer than three numbers; the message names the line.
    """
    text = Text(data, blank(rb"[,;]", blank(rb"//[^\n\r]*", without_comments(unix(data)))))
    first, count = text.lines()
    if len(first) and count[0] == 1:
        first, count = first[1:], count[1:]
    if len(first) and not is_numeral(float, text.token(int(first[0]))):
        first, count = first[1:], count[1:]
    if not len(first):
        raise JaxmarkError("The file has no points: it needs a line with three numbers for each.")
    return Source(data, text.triples(Lines(first, count), 0, "a point needs three numbers"), _NO_FACES)


def parse_las(data: bytes) -> Source:
    """Read the positions of all records, of LAS or LAZ; everything else is left alone.

    Raises:
        JaxmarkError: if laspy is missing or cannot read the file, or it has no points.
    """
    require("laspy", "files")
    count = _check_counts(data)
    if not data[_KIND] & _PACKED:
        return Source(data, ScaledNumbers(data, _read(data).header), _NO_FACES)
    try:
        unpacked = Unpacker("laz", len(data))(data)["las"].tobytes()
    except JaxmarkError as error:
        raise JaxmarkError(f"This is no LAZ file that laspy reads: {error}.") from None
    if _check_counts(unpacked) != count:
        raise JaxmarkError(f"This LAZ file is damaged: it does not hold the {count} points of its header.")
    octree = data[_OCTREE.start : _OCTREE.stop] == b"copc"
    return _Compressed(
        unpacked,
        ScaledNumbers(unpacked, _read(unpacked).header),
        _NO_FACES,
        fixed="The file is a cloud-optimised point cloud (COPC), which is not written; save it as plain LAZ or LAS."
        if octree
        else "",
    )


class ScaledNumbers(BinaryNumbers):
    """Positions in the records of a LAS file, integers with a scale and an offset; see `Numbers`."""

    def __init__(self, data: bytes, header: Any) -> None:
        """Read the integers of all records as the header says."""
        self._data, self._scales = data, np.asarray(header.scales, np.float64)
        records = int(header.offset_to_point_data) + int(header.point_format.size) * np.arange(header.point_count)
        offsets = records[:, None] + _INTEGER.itemsize * np.arange(3)
        super().__init__(data, offsets, (_INTEGER,) * 3, self._scales, np.asarray(header.offsets, np.float64))

    def edits(self, values: Rows) -> Changes:
        """Return the overlays, one a column, that write all numbers that changed, and the box around all of them."""
        overlays = super().edits(values)
        data = splice(self._data, overlays)
        if data != self._data:
            placed = self._read(data)
            box = np.stack([placed.max(axis=0), placed.min(axis=0)], axis=1).ravel().astype("<f8")
            overlays.append(overlay(_BOX + 8 * np.arange(6), box))
        return overlays

    def spacing(self, values: Rows, rows: Indices) -> float:
        """Return the largest scale, or the spacing of double precision if that is larger."""
        return max(super().spacing(values, rows), float(np.spacing(np.abs(values[rows]).max(initial=0.0))))

    def advice(self, step: float) -> str:
        """Advise a scale."""
        return f"save it with a scale of at most {step:.1g}"


class _Compressed(Source):
    """A LAZ file, whose records lie packed: `data` are those of the LAS file, and are packed again when written."""

    def patch(self, positions: Points, name: str) -> Patched:
        return Patched(_write(_read(super().patch(positions, name).file), packed=True))


def _write(cloud: Any, *, packed: bool) -> bytes:
    out = io.BytesIO()
    try:
        cloud.write(out, do_compress=packed)
    except Exception as error:  # laspy and its encoders raise various exceptions for what they cannot write
        raise JaxmarkError(f"laspy cannot write this LAZ file: {_reason(error)}; save it as LAS.") from error
    return out.getvalue()


def _read(data: bytes) -> Any:
    laspy = require("laspy", "files")
    try:
        return laspy.read(io.BytesIO(data))
    except Exception as error:  # laspy and its decoders raise various exceptions where bytes are wrong
        raise JaxmarkError(f"This is no LAS or LAZ file that laspy reads: {_reason(error)}.") from error


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()).rstrip(".") or type(error).__name__


def _check_counts(data: bytes) -> int:
    """Refuse a header that counts more than the file can hold, which laspy does not check; return its points."""
    if len(data) < _HEADER_BYTES:
        raise JaxmarkError(f"This is no LAS or LAZ file: it has {len(data)} bytes, and a header alone more.")
    begin, points, records, kind, size, count = struct.unpack_from("<H2IBHI", data, 94)
    later = extended = 0
    if data[25] >= 4 and len(data) >= _HEADER_BYTES_1_4:  # version 1.4
        later, extended, wide_count = struct.unpack_from("<QIQ", data, 235)
        count = max(count, wide_count)
    packed = bool(kind & _PACKED)
    if (
        begin + _RECORD_BYTES * records > min(points, len(data))
        or (extended and later + _EXTENDED_BYTES * extended > len(data))
        or (points + count * size > len(data) and not packed)
    ):
        raise JaxmarkError(
            f"This LAS or LAZ file is damaged: its header counts {count} points and {records + extended} other records,"
            f" more than its {len(data)} bytes hold."
        )
    if packed:
        limits.UNPACKED.check(count * size, len(data))
    return count
