"""Buffer views that are compressed with meshoptimizer: decoded, and encoded again. Needs the extra `files`."""

import json
from typing import Any, NamedTuple

import numpy as np

from jaxmark.errors import JaxmarkError, require
from jaxmark.files.gltf.views import compression, is_alone, replace

_MODES, _MOST_STRIDE = ("ATTRIBUTES", "TRIANGLES", "INDICES"), 256
_FILTERS = ("NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR")


class Packing(NamedTuple):
    """The form of a compressed buffer view, as the document states it."""

    elements: int
    stride: int  # bytes of each
    mode: str
    filter: str

    @classmethod
    def of(cls, extension: dict[str, Any], count: int, stride: int, where: str) -> "Packing":
        """Read the mode and the filter of a view's extension; unknown ones are refused, and impossible sizes."""
        mode, filter_ = extension.get("mode"), extension.get("filter", "NONE")
        if mode not in _MODES or filter_ not in _FILTERS or not 0 < stride <= _MOST_STRIDE or not count:
            raise JaxmarkError(f"{where} is compressed in an unknown way; save it without compression.")
        return cls(count, stride, str(mode), str(filter_))

    @property
    def size(self) -> int:
        """Number of decoded bytes."""
        return self.elements * self.stride

    def framed(self, data: bytes) -> bytes:
        """Return the block that the program for unpacking takes: this form as a line of JSON, and the data."""
        return json.dumps(self).encode() + b"\n" + data


def write(document: dict[str, Any], contents: list[bytes | None], number: int, data: bytes) -> None:
    """Write a changed buffer view into a document and its buffers, compressed without loss.

    It takes the place of the bytes that were there. If the file also has the view without compression, for programs
    that cannot decode it, that is changed, too.

    Args:
        document: the document, which is changed.
        contents: the bytes of its buffers, which change with it; None for one that could not be read.
        number: the index of the view.
        data: its new bytes, as decoded.

    Raises:
        JaxmarkError: if meshopt is missing or cannot encode the view, or its form without compression cannot be read.
    """
    view = document["bufferViews"][number]
    extension = compression(view)
    assert extension is not None
    old = contents[extension["buffer"]] or b""
    version = old[extension.get("byteOffset", 0)] & 15  # the first byte has it
    codec = require("meshopt", "files")
    rows = np.frombuffer(data, np.uint8).reshape(extension["count"], extension["byteStride"])
    try:
        coded = codec.encode_gltf_buffer(rows, "ATTRIBUTES", version)
    except ValueError as error:
        raise JaxmarkError(f"bufferViews[{number}] cannot be compressed again: {error}; save it without.") from None
    begin = replace(document, contents, extension, coded, alone=is_alone(document, extension))
    extension |= {"byteOffset": begin, "byteLength": len(coded), "mode": "ATTRIBUTES"}
    extension.pop("filter", None)  # filters lose digits
    _write_fallback(document, contents, view, data)


def _write_fallback(document: dict[str, Any], contents: list[bytes | None], view: dict[str, Any], data: bytes) -> None:
    """Write the bytes of a view into the buffer for programs that cannot decode, if there is such a buffer."""
    buffer, begin = view["buffer"], view.get("byteOffset", 0)
    content = contents[buffer]
    if content is None and "uri" in document["buffers"][buffer]:
        raise JaxmarkError(f"buffers[{buffer}], the form without compression, cannot be read; put it beside the file.")
    is_fallback = "fallback" in str(document["buffers"][buffer].get("extensions"))
    if content is not None and is_fallback and begin + len(data) <= len(content):
        contents[buffer] = content[:begin] + data + content[begin + len(data) :]
