"""Small pictures of originals, from points of their surfaces; they need nothing beyond the core."""

import struct
import zlib

import numpy as np
from jaxtyping import UInt8

from jaxmark.geometry.mesh import unit
from jaxmark.geometry.pose import Points

_PIXELS = 96  # on each side
_MARGIN = 4  # pixels
_CAMERA = unit(np.array([[0.87, 0.0, -0.5], [-0.17, 0.94, -0.3], [0.47, 0.34, 0.81]]))  # right, up, towards the eye
_LIGHT = unit(np.array([0.3, 0.5, 0.8]))  # in the camera's directions
_PAPER, _DARKEST = 255, 40


def thumbnail(points: Points, normals: Points) -> bytes:
    """Draw a shape from the front, a little from above and the right, as PNG.

    Args:
        points: some thousand points of its surface.
        normals: unit normals there, or zeros.
    """
    seen, facing = points @ _CAMERA.T, normals @ _CAMERA.T
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    size = max(float((high - low).max()), np.finfo(float).tiny)
    room = _PIXELS - 2 * _MARGIN - 1
    place = np.rint((seen[:, :2] - (low + high) / 2) / size * room + (_PIXELS - 1) / 2).astype(int)
    # Surfaces without an outside are lit from either side.
    light = np.abs(facing @ _LIGHT)
    shade = (_DARKEST + (225 - _DARKEST) * light).astype(np.uint8)
    picture = np.full((_PIXELS, _PIXELS), _PAPER, np.uint8)
    nearest_last = np.argsort(seen[:, 2])
    rows, columns = _PIXELS - 1 - place[nearest_last, 1], place[nearest_last, 0]
    for down, across in ((0, 1), (1, 0), (1, 1), (0, 0)):  # each point covers four pixels
        picture[np.minimum(rows + down, _PIXELS - 1), np.minimum(columns + across, _PIXELS - 1)] = shade[nearest_last]
    return encode_png(picture)


def encode_png(picture: UInt8[np.ndarray, "rows columns"]) -> bytes:
    """Encode a grey picture as PNG (ISO/IEC 15948)."""
    rows, columns = picture.shape
    lines = np.concatenate([np.zeros((rows, 1), np.uint8), picture], axis=1).tobytes()  # 0: lines as they are
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0),
        b"IDAT": zlib.compress(lines),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks.items()
    )
