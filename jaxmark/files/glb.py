"""Parse GLB 2.0, the binary form of glTF."""

import json
import re
import struct
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files.binary import BinaryNumbers, encode, gather
from jaxmark.files.normals import Transported
from jaxmark.files.source import Edits, Overlay, Source

_FLOAT = np.dtype("<f4")
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")


def parse(data: bytes) -> Source:
    """Read the one mesh of a GLB file.

    Positions are the mesh's local coordinates: the transformations of nodes are not applied. Where several primitives
    have several POSITION accessors, their vertices follow each other in order of first use.

    Raises:
        JaxmarkError: if the file cannot be read, or holds what cannot be marked: several meshes, instances,
            compressed, sparse or quantised positions, primitives other than triangles, or data in other files.
    """
    file = _File(data)
    primitives = _primitives(file)
    points = _joined(file, [primitive.position for primitive in primitives])
    normals = _joined(file, [primitive.normal for primitive in primitives if primitive.normal is not None])
    _refuse_overlaps(file, points.indices + normals.indices)
    faces, corners, textures = [], [], []
    for primitive in primitives:
        index = _triangles(file, primitive.data, points.rows(primitive.position))
        faces.append(index + points.first_row(primitive.position))
        textures.append(partial(_texture, file, primitive.data, index))
        if primitive.normal is None or normals.rows(primitive.normal) != points.rows(primitive.position):
            corners.append(np.full_like(index, -1))
        else:
            corners.append(index + normals.first_row(primitive.normal))
    types = (_FLOAT,) * 3
    turned = None
    if normals.indices:
        turned = Transported(BinaryNumbers(file.data, normals.offsets, types), np.concatenate(corners))
    coordinates = BinaryNumbers(file.data, points.offsets, types)
    source = _GlbSource(file.data, coordinates, np.concatenate(faces), turned, file=file, points=points)
    source.texture = lambda: np.concatenate([read() for read in textures])
    return source


class _File:
    """The chunks of a GLB file; every access to its JSON is checked."""

    def __init__(self, data: bytes) -> None:
        if len(data) < 20 or data[:4] != b"glTF":
            raise JaxmarkError("byte 0: a GLB file begins with glTF and a header of 20 bytes.")
        version, length, size, kind = struct.unpack_from("<IIII", data, 4)
        if version != 2:
            raise JaxmarkError(f"byte 4: only version 2 of glTF is supported, not {version}.")
        if length > len(data) or 20 + size > length:
            raise JaxmarkError(f"byte {len(data)}: the file is shorter than the lengths that it announces.")
        if kind != 0x4E4F534A:
            raise JaxmarkError("byte 16: the first chunk is not JSON.")
        self.data = data
        self.json_end = at = 20 + size
        self.bin = range(0)
        if at + 8 <= length:
            size, kind = struct.unpack_from("<II", data, at)
            if at + 8 + size > length:
                raise JaxmarkError(f"byte {at}: the second chunk is longer than the file.")
            if kind == 0x004E4942:
                self.bin = range(at + 8, at + 8 + size)
        try:
            self.text = data[20 : self.json_end].decode()
            self.document = json.loads(self.text)
        except (ValueError, RecursionError) as error:
            raise JaxmarkError(f"byte 20: the JSON chunk cannot be read: {error}.") from None
        if not isinstance(self.document, dict):
            raise JaxmarkError("byte 20: the JSON chunk is not an object.")

    def items(self, kind: str) -> list[dict[str, Any]]:
        """A list of objects at the top of the document, empty if absent."""
        return _objects(self.document, kind, "the document")

    def item(self, kind: str, index: int) -> dict[str, Any]:
        """One object of a list at the top of the document."""
        items = self.items(kind)
        if index >= len(items):
            raise JaxmarkError(f"{kind}[{index}] is referred to, but there are {len(items)}.")
        return items[index]

    def elements(self, index: int) -> tuple[Int64[np.ndarray, " count"], np.dtype, int]:
        """The byte offsets of an accessor's elements, the type of their components, and how many an element has."""
        where = f"accessors[{index}]"
        accessor = self.item("accessors", index)
        component, width = accessor.get("componentType"), accessor.get("type")
        if component not in list(_COMPONENTS) or width not in list(_WIDTHS):
            raise JaxmarkError(f"{where} is of an unknown type.")
        dtype = np.dtype(_COMPONENTS[int(component)])
        size = dtype.itemsize * _WIDTHS[str(width)]
        view_index = _whole(accessor, "bufferView", where)
        view = self.item("bufferViews", view_index)
        if _whole(view, "buffer", f"bufferViews[{view_index}]") != 0 or "uri" in self.item("buffers", 0):
            raise JaxmarkError(f"{where} has its data in another file (an external buffer), which is not supported.")
        stride = _whole(view, "byteStride", f"bufferViews[{view_index}]", size)
        count = _whole(accessor, "count", where)
        first, offset = _whole(accessor, "byteOffset", where, 0), _whole(view, "byteOffset", where, 0)
        last = first + (count - 1) * stride + size
        if count == 0 or stride < size or last > _whole(view, "byteLength", where) or offset + last > len(self.bin):
            raise JaxmarkError(f"{where} does not lie inside its buffer view and the binary chunk.")
        return self.bin.start + offset + first + stride * np.arange(count), dtype, _WIDTHS[str(width)]


@dataclass
class _Accessors:
    """Accessors of triples, joined one after the other into rows."""

    indices: list[int]  # the accessors' indices in the file
    ends: list[int]  # the row behind the last one of each accessor
    offsets: Int64[np.ndarray, "rows 3"]  # byte offset of each number

    def first_row(self, index: int) -> int:
        """The row where an accessor begins."""
        return [0, *self.ends][self.indices.index(index)]

    def rows(self, index: int) -> int:
        """The number of rows of an accessor."""
        return self.ends[self.indices.index(index)] - self.first_row(index)


class _Primitive(NamedTuple):
    data: dict[str, Any]
    position: int  # index of the accessor
    normal: int | None  # likewise; None if absent, or not of plain triples of floats: such normals are left alone


def _primitives(file: _File) -> list[_Primitive]:
    """The primitives of the one mesh; refused unless they can be marked."""
    meshes = file.items("meshes")
    if len(meshes) != 1:
        raise JaxmarkError(f"The file has {len(meshes)} meshes; only files with one mesh are supported.")
    users = sum("mesh" in node for node in file.items("nodes"))
    if users > 1:
        raise JaxmarkError(f"The mesh is used by {users} nodes; instances are not supported.")
    primitives = _objects(meshes[0], "primitives", "meshes[0]")
    if not primitives:
        raise JaxmarkError("meshes[0] has no primitives.")
    checked = []
    for number, primitive in enumerate(primitives):
        where = f"meshes[0].primitives[{number}]"
        _refuse_compressed(primitive, where)
        if primitive.get("mode", 4) != 4:
            raise JaxmarkError(
                f"{where} has mode {ascii(primitive['mode'])[:40]}; only triangles (mode 4) are supported."
            )
        position = _attribute(primitive, "POSITION")
        if position is None:
            raise JaxmarkError(f"{where} has no POSITION.")
        accessor = file.item("accessors", position)
        if "sparse" in accessor:
            raise JaxmarkError(f"accessors[{position}] is sparse, which is not supported.")
        if accessor.get("componentType") != 5126 or accessor.get("type") != "VEC3":
            raise JaxmarkError(f"accessors[{position}] holds no three floats; quantised positions are not supported.")
        if "bufferView" in accessor:
            view = _whole(accessor, "bufferView", f"accessors[{position}]")
            _refuse_compressed(file.item("bufferViews", view), f"bufferViews[{view}]")
        normal = _attribute(primitive, "NORMAL")
        checked.append(
            _Primitive(primitive, position, normal if normal is not None and _is_plain(file, normal) else None)
        )
    return checked


def _refuse_compressed(item: dict[str, Any], where: str) -> None:
    extensions = item.get("extensions")
    for name in _COMPRESSED:
        if isinstance(extensions, dict) and name in extensions:
            raise JaxmarkError(f"{where} is compressed with {name}, which is not supported; save it without.")


def _attribute(primitive: dict[str, Any], name: str) -> int | None:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise JaxmarkError("A primitive has no attributes.")
    return _whole(attributes, name, "attributes") if name in attributes else None


def _is_plain(file: _File, index: int) -> bool:
    """Whether an accessor holds triples of floats and nothing else."""
    accessor = file.item("accessors", index)
    plain = accessor.get("componentType") == 5126 and accessor.get("type") == "VEC3" and "bufferView" in accessor
    return plain and "sparse" not in accessor


def _joined(file: _File, indices: list[int]) -> _Accessors:
    """Join distinct accessors of triples of floats, in order of first use."""
    distinct = list(dict.fromkeys(indices))
    starts = [file.elements(index)[0] for index in distinct]
    ends = np.cumsum([len(start) for start in starts], dtype=np.int64).tolist()
    first = np.concatenate([*starts, np.zeros(0, np.int64)])
    return _Accessors(distinct, ends, first[:, None] + np.arange(0, 12, 4))


def _refuse_overlaps(file: _File, patched: list[int]) -> None:
    """Refuse a file in which another accessor reads a byte that is going to change."""
    taken = np.zeros(len(file.bin), dtype=bool)
    others = [index for index in range(len(file.items("accessors"))) if index not in patched]
    for index in (*patched, *others):
        accessor = file.item("accessors", index)
        view = accessor.get("bufferView")
        if index not in patched and (
            view is None or file.item("bufferViews", _whole(accessor, "bufferView", "accessors")).get("buffer") != 0
        ):
            continue  # this accessor reads nothing of the binary chunk
        starts, dtype, width = file.elements(index)
        for byte in range(dtype.itemsize * width):
            place = starts - file.bin.start + byte
            if taken[place].any():
                raise JaxmarkError(f"accessors[{index}] shares bytes with positions or normals of another accessor.")
            if index in patched:
                taken[place] = True


def _triangles(file: _File, primitive: dict[str, Any], count: int) -> Int64[np.ndarray, "faces 3"]:
    """The faces of a primitive as indices into its own vertices."""
    if "indices" in primitive:
        number = _whole(primitive, "indices", "primitives")
        where = f"accessors[{number}]"
        offsets, dtype, width = file.elements(number)
        if width != 1 or dtype.kind != "u" or "sparse" in file.item("accessors", number):
            raise JaxmarkError(f"{where} holds no plain unsigned integers, as indices must.")
        index = gather(file.data, offsets, dtype).astype(np.int64)
    else:
        where = "a primitive without indices"
        index = np.arange(count)
    if len(index) % 3:
        raise JaxmarkError(f"{where} has {len(index)} corners, which is no multiple of three.")
    if (index >= count).any():
        raise JaxmarkError(f"{where} refers to vertex {index.max()}, but there are {count}, numbered from 0.")
    return index.reshape(-1, 3)


def _texture(
    file: _File, primitive: dict[str, Any], index: Int64[np.ndarray, "faces 3"]
) -> Float64[np.ndarray, "faces 3 2"]:
    """Texture coordinates of the corners of a primitive's faces; NaN unless they are plain pairs of floats."""
    nothing = np.full((*index.shape, 2), np.nan)
    try:
        number = _attribute(primitive, "TEXCOORD_0")
        if number is None:
            return nothing
        starts, dtype, width = file.elements(number)
    except JaxmarkError:  # a wrong texture is no reason to refuse the file
        return nothing
    if width != 2 or dtype != _FLOAT or index.max(initial=-1) >= len(starts):
        return nothing
    pairs = gather(file.data, (starts[:, None] + [0, 4]).ravel(), _FLOAT).astype(np.float64)
    return pairs.reshape(-1, 2)[index]


def _objects(parent: dict[str, Any], key: str, where: str) -> list[dict[str, Any]]:
    items = parent.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise JaxmarkError(f"{key} of {where} is not a list of objects.")
    return items


def _whole(parent: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
    value = parent.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
        raise JaxmarkError(f"{key} of {where} is {ascii(value)[:40]}, not an index or a length.")
    return value


@dataclass(kw_only=True)
class _GlbSource(Source):
    """A source that also keeps the `min` and `max` of its position accessors true, as glTF demands."""

    file: _File
    points: _Accessors

    def edits(self, positions: Float64[np.ndarray, "points 3"]) -> list[Edits | Overlay]:
        """The edits of the numbers, of the bounds in the JSON chunk, and of the lengths if that chunk grows."""
        edits = super().edits(positions)
        text, data = self._with_bounds(positions), self.data
        if text != self.file.text:
            old = data[20 : self.file.json_end]
            new = text.rstrip(" ").encode()
            new = new.ljust(max(len(old), -(-len(new) // 4) * 4), b" ")
            grown = len(new) - len(old)
            total = struct.unpack_from("<I", data, 8)[0]
            lengths = struct.pack("<I", total + grown), struct.pack("<I", len(new))
            edits.append(Edits(np.array([8, 12, 20]), np.array([12, 16, 20 + len(old)]), [*lengths, new]))
        return edits

    def _with_bounds(self, positions: Float64[np.ndarray, "points 3"]) -> str:
        """The JSON text with new bounds for the accessors that moved."""
        text = self.file.text
        accessors = _spans(text, _spans(text, _begin(text))["accessors"][0])
        replaced: list[tuple[int, int, str]] = []
        for index, low, high in zip(self.points.indices, [0, *self.points.ends], self.points.ends, strict=False):
            rows = encode(positions[low:high], _FLOAT)
            if (rows == self.positions[low:high]).all():
                continue
            members = _spans(text, accessors[index][0])
            for key, bound in (("min", rows.min(axis=0)), ("max", rows.max(axis=0))):
                if key in members and not _same(self.file.item("accessors", index)[key], bound):
                    replaced.append((*members[key], json.dumps(bound.tolist(), separators=(",", ":"))))
        for begin, end, new in sorted(replaced, reverse=True):
            text = text[:begin] + new + text[end:]
        return text


def _same(written: Any, bound: np.ndarray) -> bool:
    """Whether the JSON already states this bound."""
    if not isinstance(written, list) or len(written) != 3:
        return False
    numbers = [item for item in written if isinstance(item, int | float) and abs(item) < 3.4e38]
    return len(numbers) == 3 and bool((np.array(numbers, np.float64).astype(_FLOAT) == bound).all())


def _begin(text: str, at: int = 0) -> int:
    """The index of the next character that is not white space."""
    match = re.compile(r"[ \t\n\r]*").match(text, at)
    return at if match is None else match.end()


def _spans(text: str, at: int) -> dict[str | int, tuple[int, int]]:
    """The spans of the values of the object or list that begins at `at`, by key or number; the JSON must be valid."""
    decode = json.JSONDecoder().raw_decode
    keyed = text[at] == "{"
    spans: dict[str | int, tuple[int, int]] = {}
    at = _begin(text, at + 1)
    while text[at] not in "}]":
        key: str | int = len(spans)
        if keyed:
            key, at = decode(text, at)
            at = _begin(text, _begin(text, at) + 1)  # past the colon
        _, end = decode(text, at)
        spans[key] = (at, end)
        at = _begin(text, end)
        if text[at] == ",":
            at = _begin(text, at + 1)
    return spans
