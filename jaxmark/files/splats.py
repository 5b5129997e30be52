"""Read positions of compressed Gaussian splats: packed PLY, as SuperSplat writes it, and SPZ; neither is written."""

import gzip
import io
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.errors import JaxmarkError, require
from jaxmark.files import limits
from jaxmark.files.source import Changes, Indices, Rows, SomeRows, Source

Boxes = Float64[np.ndarray, "chunks 3"]  # their lower or upper corners
_CHUNK = 256  # splats of packed PLY that share a box
_FIELDS = ((21, 11), (11, 10), (0, 11))  # of a packed position: the lowest bit of x, y and z, and the number of bits
_MAGIC, _SIZES = b"NGSP", 16  # bytes that begin SPZ, and that each of its streams has in their table
_HEADER = struct.Struct("<4s2IxBxB")
_FIXED = (
    "The file is a compressed splat, which is read but not written; mark the splat as uncompressed PLY, and compress"
    " that."
)


@dataclass
class ReadNumbers:
    """Triples of numbers that are read only; see `Numbers`."""

    values: Rows

    def edits(self, values: Rows) -> Changes:
        """Return no edits."""
        return []

    def rounded(self, values: Rows, rows: Indices) -> SomeRows:
        """Return the new values of some rows as they are."""
        return values[rows]

    def spacing(self, values: Rows, rows: Indices) -> float:
        """Return 0, because nothing is written."""
        return 0.0

    def advice(self, step: float) -> str:
        """Advise nothing."""
        return ""


def cloud(data: bytes, positions: Rows) -> Source:
    """Make the source of a compressed splat, which cannot be written."""
    return Source(data, ReadNumbers(positions), np.zeros((0, 3), np.int64), fixed=_FIXED)


def unpack(words: Int64[np.ndarray, " splats"], low: Boxes, high: Boxes) -> Rows:
    """Unpack positions of 32 bits, which lie in the boxes of their chunks.

    Raises:
        JaxmarkError: if there are fewer boxes than the positions need.
    """
    if _CHUNK * len(low) < len(words):
        raise JaxmarkError(f"A compressed splat of {len(words)} points needs a chunk for each {_CHUNK} of them.")
    parts = [(words >> shift) % (1 << bits) / ((1 << bits) - 1) for shift, bits in _FIELDS]
    chunk = np.arange(len(words)) // _CHUNK
    return low[chunk] + np.stack(parts, axis=1) * (high - low)[chunk]


def parse_spz(data: bytes) -> Source:
    """Read the positions of an SPZ file, as they are stored.

    Raises:
        JaxmarkError: if the file is damaged or of an unknown version, or zstandard is missing for one of version 4.
    """
    apart = data.startswith(_MAGIC)  # version 4 packs each property on its own, earlier ones the whole file
    read = io.BytesIO(data).read if apart else gzip.GzipFile(fileobj=io.BytesIO(data)).read
    magic, version, count, fraction, streams = _HEADER.unpack(_take(read, _HEADER.size))
    if magic != _MAGIC or version not in ((4,) if apart else (1, 2, 3)):
        raise JaxmarkError(f"This is no SPZ file of version 1 to 4, but of {magic!a} {version}.")
    if not count:
        raise JaxmarkError("The file has no points.")
    size = count * (6 if version == 1 else 9)
    limits.UNPACKED.check(size, len(data))
    if apart:
        table = int.from_bytes(_take(read, 4), "little")  # of the sizes of the streams, of which positions are first
        codec = require("zstandard", "files").ZstdDecompressor()
        read = codec.stream_reader(data[table + _SIZES * streams :]).read
    body = np.frombuffer(_take(read, size), np.uint8)
    if version == 1:
        return cloud(data, body.view("<f2").reshape(-1, 3).astype(np.float64))
    low, middle, high = body.reshape(-1, 3).T
    whole = high.astype(np.int8).astype(np.int32) << 16  # 24 bits, of which the first is the sign
    whole |= middle.astype(np.int32) << 8
    whole |= low
    return cloud(data, np.ldexp(whole.reshape(-1, 3).astype(np.float64), -fraction))


def _take(read: Callable[[int], bytes], size: int) -> bytes:
    """Read so many bytes of an SPZ file, and unpack no more."""
    try:
        found = read(size)
    except Exception as error:  # each unpacker has exceptions of its own
        raise JaxmarkError(f"This SPZ file cannot be unpacked: {error}.") from None
    if len(found) < size:
        raise JaxmarkError(f"This SPZ file ends after {len(found)} bytes of {size} that its header announces.")
    return found
