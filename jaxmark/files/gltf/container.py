"""A glTF document and its buffers: in one file (GLB, or JSON with data in it), or in several."""

import base64
import binascii
import hashlib
import json
import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple
from urllib.parse import quote, unquote, unquote_to_bytes

from jaxmark.errors import JaxmarkError
from jaxmark.files.gltf.json_text import rewrite
from jaxmark.files.source import Patched

#: Reads a file by its path relative to the folder of the document.
Read = Callable[[str], bytes]

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_MAGIC = b"glTF"


class Buffer(NamedTuple):
    """One buffer of a document."""

    place: range  # of its bytes in `Container.data`
    head: str  # the text before the data in the document, or another file's path; empty for the chunk of a GLB file


class Container:
    """A document and its buffers, whose bytes are laid one behind the other.

    Attributes:
        file: the bytes of a GLB or glTF file.
        content: the document.
        buffers: the buffers, or why a buffer cannot be read.
        data: the bytes of the buffers, and whatever is added behind them.
    """

    def __init__(self, file: bytes, read: Read) -> None:
        """Read a document and its buffers.

        Args:
            file: the bytes of a GLB or glTF file.
            read: reads the files that it refers to.

        Raises:
            JaxmarkError: if the document cannot be read.
        """
        chunk, where = range(0), "The document"
        if file.lstrip(b" \t\r\n\xef\xbb\xbf")[:1] == b"{":
            self._place = range(3 if file.startswith(b"\xef\xbb\xbf") else 0, len(file))
        else:
            where = "byte 20: the JSON chunk"
            self._place, chunk = _chunks(file)
        try:
            self._text = file[self._place.start : self._place.stop].decode()
            self.content: dict[str, Any] = json.loads(self._text)
        except (ValueError, RecursionError) as error:
            raise JaxmarkError(f"{where} cannot be read: {error}.") from None
        if not isinstance(self.content, dict):
            raise JaxmarkError(f"{where} is not an object.")
        asset = self.content.get("asset")
        version = asset.get("version", "2.0") if isinstance(asset, dict) else "2.0"
        if file[:4] != _MAGIC and str(version).split(".")[0] != "2":
            raise JaxmarkError(f"Only version 2 of glTF is supported, not {ascii(version)[:40]}.")
        self.file, self.buffers = file, list[Buffer | str]()
        pieces, size = list[bytes](), 0
        entries = self.content.get("buffers", [])
        for index, entry in enumerate(entries if isinstance(entries, list) else []):
            try:
                head, data = _content(entry, index, file[chunk.start : chunk.stop] if chunk else None, read)
            except JaxmarkError as error:
                self.buffers.append(str(error).rstrip("."))
                continue
            self.buffers.append(Buffer(range(size, size + len(data)), head))
            pieces.append(data)
            size += len(data)
        self.data = b"".join(pieces)

    def add(self, data: bytes) -> int:
        """Append bytes to the data, and return where they begin."""
        self.data += data
        return len(self.data) - len(data)

    def encode(self, document: dict[str, Any], contents: Sequence[bytes | None], name: str) -> Patched:
        """Write the file, and those beside it, with other buffers.

        Args:
            document: the document, still with the old places of its buffers; it is changed.
            contents: the bytes of each buffer; None for one that could not be read.
            name: name of the file that is written, without its suffix; changed buffers are named after it.
        """
        beside: dict[str, bytes] = {}
        companions: list[str] = []
        chunk: bytes | None = None
        for index, (buffer, content) in enumerate(zip(self.buffers, contents, strict=True)):
            if isinstance(buffer, str) or content is None:
                continue
            if content == self.data[buffer.place.start : buffer.place.stop]:
                companions += [buffer.head] if buffer.head and not buffer.head.startswith("data:") else []
                continue
            entry = document["buffers"][index]
            if len(content) != len(buffer.place):
                entry["byteLength"] = len(content)
            if not buffer.head:
                chunk = content
            elif buffer.head.startswith("data:"):
                entry["uri"] = buffer.head + base64.b64encode(content).decode()
            else:  # named by its content, too, so that no file that is there already is ever another one
                path = f"{name}.{hashlib.sha256(content).hexdigest()[:8]}.bin"
                entry["uri"] = quote(path)
                beside[path] = content
        images = self.content.get("images", [])
        for image in images if isinstance(images, list) else []:
            uri = image.get("uri") if isinstance(image, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:") and "://" not in uri:
                companions.append(unquote(uri))
        return Patched(self._file(rewrite(self._text, document), chunk), beside, companions=tuple(companions))

    def _file(self, text: str, chunk: bytes | None) -> bytes:
        """Write the file with another document and another binary chunk."""
        before, after = self.file[: self._place.start], self.file[self._place.stop :]
        coded = text.encode()
        if before[:4] != _MAGIC:
            return before + coded + after
        if text != self._text:
            coded = _padded(text.rstrip(" ").encode(), b" ")
            coded = coded.ljust(len(self._place), b" ")
        if chunk is not None:
            chunk = _padded(chunk, b"\0")
            size, _ = struct.unpack_from("<II", after)
            after = struct.pack("<II", len(chunk), _BIN) + chunk + after[8 + size :]
        version, total = struct.unpack_from("<II", before, 4)
        total += len(before) + len(coded) + len(after) - len(self.file)
        return struct.pack("<4sIIII", _MAGIC, version, total, len(coded), _JSON) + coded + after


def _padded(data: bytes, filling: bytes) -> bytes:
    """Pad to a multiple of four bytes."""
    return data + -len(data) % 4 * filling


def _chunks(data: bytes) -> tuple[range, range]:
    """Locate the JSON chunk and of the binary chunk of a GLB file."""
    if len(data) < 20 or data[:4] != _MAGIC:
        raise JaxmarkError("byte 0: a GLB file begins with glTF and a header of 20 bytes.")
    version, length, size, kind = struct.unpack_from("<IIII", data, 4)
    if version != 2:
        raise JaxmarkError(f"byte 4: only version 2 of glTF is supported, not {version}.")
    if length > len(data) or 20 + size > length:
        raise JaxmarkError(f"byte {len(data)}: the file is shorter than the lengths that it announces.")
    if kind != _JSON:
        raise JaxmarkError("byte 16: the first chunk is not JSON.")
    at = 20 + size
    if at + 8 > length:
        return range(20, at), range(0)
    size, kind = struct.unpack_from("<II", data, at)
    if at + 8 + size > length:
        raise JaxmarkError(f"byte {at}: the second chunk is longer than the file.")
    return range(20, at), range(at + 8, at + 8 + size) if kind == _BIN else range(0)


def _content(entry: Any, index: int, chunk: bytes | None, read: Read) -> tuple[str, bytes]:
    """Return the head of a buffer, see `Buffer`, and its bytes."""
    if not isinstance(entry, dict):
        raise JaxmarkError(f"buffers[{index}] is not an object")
    uri = entry.get("uri")
    if uri is None and index == 0 and chunk is not None:
        return "", chunk
    if not isinstance(uri, str):
        raise JaxmarkError(f"buffers[{index}] has no data")
    if uri.startswith("data:"):
        head, comma, coded = uri.partition(",")
        try:
            if not head.endswith(";base64"):
                return f"{head};base64{comma}", unquote_to_bytes(coded)
            return head + comma, base64.b64decode(unquote(coded), validate=True)
        except (ValueError, binascii.Error):
            raise JaxmarkError(f"buffers[{index}] is no data in base64") from None
    path = unquote(uri)
    return path, read(path)
