"""A glTF document and its buffers, in one file (GLB, or JSON with data in it) or several: read, checked and written."""

import base64
import binascii
import hashlib
import json
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple
from urllib.parse import quote, unquote, unquote_to_bytes

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits
from jaxmark.files.binary import gather
from jaxmark.files.gltf.json_text import rewrite
from jaxmark.files.gltf.meshopt import Packing
from jaxmark.files.gltf.views import compression
from jaxmark.files.limits import RunningCount
from jaxmark.files.source import Indices, Patched
from jaxmark.files.unpacking import Unpacker

#: Reads so many bytes, or all, of a file by its path relative to the folder of the document; the same object for all
#: paths of one file.
Read = Callable[[str, int | None], bytes]

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_MAGIC = b"glTF"
FLOAT = np.dtype("<f4")
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MAX_COUNT = 2**31


class Elements(NamedTuple):
    """The places of the elements of an accessor."""

    starts: Indices  # byte offset of each in `Document.data`
    dtype: np.dtype  # of their components
    width: int  # number of components
    unit: float  # the number that a component of 1 stands for: less than 1 if integers are normalised

    @property
    def size(self) -> int:
        """Number of bytes of an element."""
        return self.dtype.itemsize * self.width

    @property
    def span(self) -> slice:
        """The bytes of `Document.data` from the first element to the last one."""
        return slice(int(self.starts[0]), int(self.starts[-1]) + self.size)

    @property
    def offsets(self) -> Int64[np.ndarray, "count width"]:
        """Byte offset of each component in `Document.data`."""
        return self.starts[:, None] + self.dtype.itemsize * np.arange(self.width)


class Buffer(NamedTuple):
    """One buffer of a document."""

    place: range  # of its bytes in `Document.data`, which other buffers of the same file share
    head: str  # the text before the data in the document, or another file's path; empty for the chunk of a GLB file


class Document:
    """A document, every access to which is checked, and its buffers, whose bytes are laid one behind the other.

    Attributes:
        file: the bytes of a GLB or glTF file.
        content: the document.
        buffers: the buffers, or why a buffer cannot be read.
        data: the bytes of the buffers, and whatever is added behind them.
        located: the elements of accessors that were read or decoded, by index.
        decoded: the indices of those that were compressed.
        accessed: counts the elements of accessors that are read, and the corners of faces that are made of them.
        unpacked: counts the bytes of those that are decompressed.
        draco: decodes primitives that are compressed with Draco.
        packed: the decoded bytes in `data` of buffer views that are compressed with meshoptimizer and were read.
    """

    def __init__(self, file: bytes, read: Read) -> None:
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
        pieces, places, size, whole_size = list[bytes](), dict[int, range](), 0, len(file)
        binary = file[chunk.start : chunk.stop] if chunk else None
        for index, entry in enumerate(_listed(self.content, "buffers")):
            try:
                head, data = _content(entry, index, binary, read)
            except JaxmarkError as error:
                self.buffers.append(str(error).rstrip("."))
                continue
            if id(data) not in places:
                places[id(data)] = range(size, size + len(data))
                pieces.append(data)
                size += len(data)
                whole_size += len(data) if _is_path(head) else 0
            self.buffers.append(Buffer(places[id(data)], head))
        self.data: bytes | bytearray = b"".join(pieces)
        self.located: dict[int, Elements] = {}
        self.decoded: set[int] = set()
        self._lists: dict[str, list[dict[str, Any]]] = {}
        # Elements lie in buffers: a long list of primitives that read the same ones does not allow more of them.
        self.accessed = RunningCount(limits.ACCESSED, size)
        self.unpacked = RunningCount(limits.UNPACKED, whole_size)
        self.draco, self._meshopt = Unpacker("draco", whole_size), Unpacker("meshopt", whole_size)
        self.packed: dict[int, range] = {}

    def copy_content(self) -> dict[str, Any]:
        """Return a copy of the document's content, which may be nested more deeply than `copy.deepcopy` can copy."""
        return json.loads(self._text)

    def add(self, data: bytes) -> int:
        """Append bytes to the data, and return where they begin."""
        if isinstance(self.data, bytes):
            self.data = bytearray(self.data)  # grows without being copied each time
        self.data += data
        return len(self.data) - len(data)

    def items(self, kind: str) -> list[dict[str, Any]]:
        """Return a list of objects at the top of the document, empty if absent."""
        if kind not in self._lists:
            self._lists[kind] = objects(self.content, kind, "the document")
        return self._lists[kind]

    def item(self, kind: str, index: int) -> dict[str, Any]:
        """Return one object of a list at the top of the document."""
        items = self.items(kind)
        if index >= len(items):
            raise JaxmarkError(f"{kind}[{index}] is referred to, but there are {len(items)}.")
        return items[index]

    def form(self, index: int) -> tuple[np.dtype, int, float, int]:
        """Return the component type of an accessor, its width, the number that 1 stands for, and its count."""
        where = f"accessors[{index}]"
        accessor = self.item("accessors", index)
        component, width = accessor.get("componentType"), accessor.get("type")
        if component not in list(COMPONENTS) or width not in list(WIDTHS):
            raise JaxmarkError(f"{where} is of an unknown type.")
        dtype = np.dtype(COMPONENTS[int(component)])
        unit = 1 / float(np.iinfo(dtype).max) if dtype.kind != "f" and accessor.get("normalized") is True else 1.0
        count = whole(accessor, "count", where)
        if not 0 < count < _MAX_COUNT:
            raise JaxmarkError(f"{where} has {count} elements.")
        return dtype, WIDTHS[str(width)], unit, count

    def elements(self, index: int) -> Elements:
        """Locate the elements of an accessor, which must lie inside its buffer."""
        if index in self.decoded:
            self.accessed.add(len(self.located[index].starts))
            return self.located[index]
        where = f"accessors[{index}]"
        dtype, width, unit, count = self.form(index)
        size = dtype.itemsize * width
        self.accessed.add(count)
        accessor = self.item("accessors", index)
        if "sparse" in accessor:
            raise JaxmarkError(f"{where} is sparse, which is not supported.")
        number = whole(accessor, "bufferView", where)
        begin, length = self.view(number)
        stride = whole(self.item("bufferViews", number), "byteStride", f"bufferViews[{number}]", size)
        first = whole(accessor, "byteOffset", where, 0)
        if stride < size or first + (count - 1) * stride + size > length:
            raise JaxmarkError(f"{where} does not lie inside its buffer view and its buffer.")
        self.located[index] = Elements(begin + first + stride * np.arange(count), dtype, width, unit)
        return self.located[index]

    def view(self, number: int) -> tuple[int, int]:
        """Locate a buffer view: where it begins in `Document.data`, and its length."""
        where = f"bufferViews[{number}]"
        view = self.item("bufferViews", number)
        extension = compression(view)
        if extension is None:
            return self._stretch(view, where)
        if number not in self.packed:
            self.packed[number] = self._unpack(view, extension, where)
        return self.packed[number].start, len(self.packed[number])

    def is_unread(self, number: int) -> bool:
        """Whether a buffer view is compressed, and was not read."""
        views = self.items("bufferViews")
        return number not in self.packed and number < len(views) and compression(views[number]) is not None

    def _unpack(self, view: dict[str, Any], extension: dict[str, Any], where: str) -> range:
        """Decode a buffer view, and return the place of its bytes in `Document.data`."""
        begin, length = self._stretch(extension, where)
        count, stride = (whole(extension, key, where) for key in ("count", "byteStride"))
        stated = Packing.of(extension, count, stride, where)
        if stated.size != whole(view, "byteLength", where):
            raise JaxmarkError(f"{where} has another length than its compressed elements.")
        index = whole(view, "buffer", where)
        length_of_buffer = whole(self.item("buffers", index), "byteLength", f"buffers[{index}]")
        if whole(view, "byteOffset", where, 0) + stated.size > length_of_buffer:
            raise _outside(where)
        # The announced size must be possible, before the decoder reserves memory for it; views may share their source.
        self.unpacked.add(stated.size + length)
        try:
            found = self._meshopt(stated.framed(bytes(self.data[begin : begin + length])))
        except JaxmarkError as error:
            raise JaxmarkError(f"{where} cannot be decoded by meshopt: {error}.") from None
        place = self.add(found["bytes"].tobytes())
        return range(place, place + stated.size)

    def _stretch(self, place: dict[str, Any], where: str) -> tuple[int, int]:
        """Locate the bytes of a buffer view, or of its compressed form."""
        index = whole(place, "buffer", where)
        if index >= len(self.buffers):
            raise JaxmarkError(f"buffers[{index}] is referred to, but there are {len(self.buffers)}.")
        buffer = self.buffers[index]
        if isinstance(buffer, str):
            raise JaxmarkError(f"{buffer}.")
        offset, length = whole(place, "byteOffset", where, 0), whole(place, "byteLength", where)
        if offset + length > len(buffer.place):
            raise _outside(where)
        return buffer.place.start + offset, length

    def numbers(self, index: int) -> Float64[np.ndarray, "count width"]:
        """Read the numbers of an accessor."""
        rows = self.elements(index)
        return gather(self.data, rows.offsets, rows.dtype).astype(np.float64) * rows.unit

    def encode(self, document: dict[str, Any], contents: Sequence[bytes | None], name: str) -> Patched:
        """Write the file, and those beside it, with other buffers.

        Args:
            document: the document, still with the old places of its buffers; it is changed.
            contents: the bytes of each buffer; None for one that could not be read.
            name: the beginning of the names of changed files.
        """
        beside: dict[str, bytes] = {}
        companions: list[str] = []
        chunk: bytes | None = None
        for index, (buffer, content) in enumerate(zip(self.buffers, contents, strict=True)):
            if isinstance(buffer, str) or content is None:
                continue
            if content == self.data[buffer.place.start : buffer.place.stop]:
                companions += [buffer.head] if _is_path(buffer.head) else []
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
        for image in _listed(self.content, "images"):
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


def _outside(where: str) -> JaxmarkError:
    return JaxmarkError(f"{where} does not lie inside its buffer, so that the accessors in it do not either.")


def _is_path(head: str) -> bool:
    """Whether the head of a buffer is the path of another file, see `Buffer`."""
    return bool(head) and not head.startswith("data:")


def uses(mesh: dict[str, Any]) -> Iterator[tuple[str, int]]:
    """Yield the accessors that a mesh uses, each after its role, such as POSITION; malformed entries are left out."""
    for primitive in _listed(mesh, "primitives"):
        if isinstance(primitive, dict):
            attributes = primitive.get("attributes")
            found: list[tuple[str, Any]] = [("indices", primitive.get("indices"))]
            found += attributes.items() if isinstance(attributes, dict) else ()
            for target in _listed(primitive, "targets"):
                found += [("target", index) for index in target.values()] if isinstance(target, dict) else []
            yield from (use for use in found if isinstance(use[1], int))


def _listed(parent: dict[str, Any], key: str) -> list[Any]:
    """Return a list in an object, empty if it is none."""
    items = parent.get(key)
    return items if isinstance(items, list) else []


def objects(parent: dict[str, Any], key: str, where: str) -> list[dict[str, Any]]:
    """Return a list of objects in an object, empty if absent."""
    items = parent.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise JaxmarkError(f"{key} of {where} is not a list of objects.")
    return items


def whole(parent: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
    """Return an index or a length in an object."""
    value = parent.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
        raise JaxmarkError(f"{key} of {where} is {ascii(value)[:40]}, not an index or a length.")
    return value


def attribute(primitive: dict[str, Any], name: str) -> int | None:
    """Return the accessor of an attribute of a primitive; None if it has none."""
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise JaxmarkError("A primitive has no attributes.")
    return whole(attributes, name, "attributes") if name in attributes else None


def _padded(data: bytes, filling: bytes) -> bytes:
    """Pad to a multiple of four bytes."""
    return data + -len(data) % 4 * filling


def _chunks(data: bytes) -> tuple[range, range]:
    """Locate the JSON chunk and the binary chunk of a GLB file."""
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
    return path, read(path, whole(entry, "byteLength", f"buffers[{index}]") if "byteLength" in entry else None)
