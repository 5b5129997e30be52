"""A glTF document and its buffers: in one file (GLB, or JSON with data in it), or in several."""

import base64
import binascii
import hashlib
import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal
from urllib.parse import quote, unquote, unquote_to_bytes

from jaxmark.errors import JaxmarkError
from jaxmark.files.gltf.json_text import rewrite
from jaxmark.files.source import Patched

#: Reads a file by its path relative to the folder of the document.
Read = Callable[[str], bytes]

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_MAGIC = b"glTF"


@dataclass(frozen=True)
class Buffer:
    """One buffer of a document."""

    place: range  # of its bytes in `Container.data`
    kind: Literal["chunk", "data", "file"]  # a chunk of the file, in the document itself, or another file
    head: str = ""  # what stands before the data in the document, or the other file's path


@dataclass
class Container:
    """A document and its buffers, whose bytes are laid one behind the other."""

    file: bytes
    json: range  # of the document's text in the file
    text: str
    document: dict[str, Any]
    buffers: list[Buffer | str]  # or why a buffer cannot be read
    data: bytes  # the buffers, and whatever is added behind them

    def add(self, data: bytes) -> int:
        """Append bytes to the data, and return where they begin."""
        self.data += data
        return len(self.data) - len(data)

    def encode(self, document: dict[str, Any], contents: Sequence[bytes | None], name: str) -> Patched:
        """The bytes of the file, and of those beside it, with other buffers.

        Args:
            document: the document, still with the old places of its buffers.
            contents: the bytes of each buffer; None for one that could not be read.
            name: name of the file that is written, without its suffix; changed buffers are named after it.
        """
        beside: dict[str, bytes] = {}
        unchanged: list[str] = []
        chunk: bytes | None = None
        for index, (buffer, content) in enumerate(zip(self.buffers, contents, strict=True)):
            if isinstance(buffer, str) or content is None:
                continue
            old = self.data[buffer.place.start : buffer.place.stop]
            if content == old:
                if buffer.kind == "file":
                    unchanged.append(buffer.head)
                continue
            entry = document["buffers"][index] = {**document["buffers"][index]}
            if len(content) != len(old):
                entry["byteLength"] = len(content)
            match buffer.kind:
                case "chunk":
                    chunk = content
                case "data":
                    entry["uri"] = buffer.head + base64.b64encode(content).decode()
                case "file":
                    # Named by its content, too, so that no file that is there already is ever another one.
                    path = f"{name}.{hashlib.sha256(content).hexdigest()[:8]}.bin"
                    entry["uri"] = quote(path)
                    beside[path] = content
        return Patched(self._file(rewrite(self.text, document), chunk), beside, companions=self._companions(unchanged))

    def _file(self, text: str, chunk: bytes | None) -> bytes:
        """The bytes of the file with another document and another binary chunk."""
        before, after = self.file[: self.json.start], self.file[self.json.stop :]
        if before[:4] != _MAGIC:
            return before + text.encode() + after
        coded = text.encode()
        if text != self.text:
            coded = text.rstrip(" ").encode()
            coded = coded.ljust(max(len(self.json), -(-len(coded) // 4) * 4), b" ")
        if chunk is not None:
            chunk = chunk.ljust(-(-len(chunk) // 4) * 4, b"\0")
            size, _ = struct.unpack_from("<II", after)
            after = struct.pack("<II", len(chunk), _BIN) + chunk + after[8 + size :]
        version = struct.unpack_from("<I", before, 4)[0]
        total = struct.unpack_from("<I", before, 8)[0] + len(coded) + len(after)
        total -= len(self.json) + len(self.file) - self.json.stop
        return struct.pack("<4sIIII", _MAGIC, version, total, len(coded), _JSON) + coded + after

    def _companions(self, paths: list[str]) -> tuple[str, ...]:
        """The paths of these buffers, and of images."""
        images = self.document.get("images", [])
        for image in images if isinstance(images, list) else []:
            uri = image.get("uri") if isinstance(image, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:") and "://" not in uri:
                paths.append(unquote(uri))
        return tuple(paths)


def open_container(data: bytes, read: Read) -> Container:
    """Read a document and its buffers.

    Args:
        data: the bytes of a GLB or glTF file.
        read: reads the files that it refers to.

    Raises:
        JaxmarkError: if the document cannot be read.
    """
    chunk = range(0)
    if data.lstrip(b" \t\r\n\xef\xbb\xbf")[:1] != b"{":
        text_span, chunk = _chunks(data)
        where = "byte 20: the JSON chunk"
    else:
        start = 3 if data.startswith(b"\xef\xbb\xbf") else 0
        text_span, where = range(start, len(data)), "The document"
    try:
        text = data[text_span.start : text_span.stop].decode()
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise JaxmarkError(f"{where} cannot be read: {error}.") from None
    if not isinstance(document, dict):
        raise JaxmarkError(f"{where} is not an object.")
    asset = document.get("asset")
    version = asset.get("version", "2.0") if isinstance(asset, dict) else "2.0"
    if data[:4] != _MAGIC and str(version).split(".")[0] != "2":
        raise JaxmarkError(f"Only version 2 of glTF is supported, not {ascii(version)[:40]}.")
    pieces: list[bytes] = []
    buffers: list[Buffer | str] = []
    size = 0
    entries = document.get("buffers", [])
    for index, entry in enumerate(entries if isinstance(entries, list) else []):
        try:
            kind, head, content = _content(entry, index, data[chunk.start : chunk.stop] if chunk else None, read)
        except JaxmarkError as error:
            buffers.append(str(error).rstrip("."))
            continue
        buffers.append(Buffer(range(size, size + len(content)), kind, head))
        pieces.append(content)
        size += len(content)
    return Container(data, text_span, text, document, buffers, b"".join(pieces))


def _chunks(data: bytes) -> tuple[range, range]:
    """The places of the JSON chunk and of the binary chunk of a GLB file."""
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


def _content(entry: Any, index: int, chunk: bytes | None, read: Read) -> tuple[Any, str, bytes]:
    """The kind of a buffer, what stands before its data, and its bytes."""
    if not isinstance(entry, dict):
        raise JaxmarkError(f"buffers[{index}] is not an object")
    uri = entry.get("uri")
    if uri is None and index == 0 and chunk is not None:
        return "chunk", "", chunk
    if not isinstance(uri, str):
        raise JaxmarkError(f"buffers[{index}] has no data")
    if uri.startswith("data:"):
        head, comma, coded = uri.partition(",")
        try:
            if not head.endswith(";base64"):
                return "data", f"{head};base64{comma}", unquote_to_bytes(coded)
            return "data", head + comma, base64.b64decode(unquote(coded), validate=True)
        except (ValueError, binascii.Error):
            raise JaxmarkError(f"buffers[{index}] is no data in base64") from None
    path = unquote(uri)
    return "file", path, read(path)
