"""Parse PLY: text, binary little endian and binary big endian; `export` writes new files, `source` patched ones."""

import re
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits, splats
from jaxmark.files.binary import BinaryNumbers, gather
from jaxmark.files.limits import RunningCount
from jaxmark.files.source import Faces, Indices, Source, Transported, fan, ranges
from jaxmark.files.text import Text, TextNumbers, unix

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_SURFACES = ("face", "tristrips")  # the elements that hold triangles
_INDICES = ("vertex_indices", "vertex_index")  # names of the list of a face's corners
_NONE = np.zeros(0, np.int64)


@dataclass
class _Property:
    """A property of an element, and the places of its items in the body."""

    type: np.dtype  # the type of the scalar, or of the list's items
    length: np.dtype | None  # the type of a list's length; None for a scalar
    starts: Indices = field(default_factory=_NONE.copy)  # place of each row's first item, in the body's units
    sizes: Indices = field(default_factory=_NONE.copy)  # number of each row's items


@dataclass
class _Element:
    name: str
    rows: int
    properties: dict[str, _Property] = field(default_factory=dict)


class _Tokens(Text):
    """A text body, whose units are tokens, numbered from 0 to `end`."""

    def __init__(self, data: bytes, start: int) -> None:
        super().__init__(data, b" " * start + unix(data)[start:])
        self.end = len(self)

    def width(self, dtype: np.dtype) -> int:
        return 1

    def integers(self, at: Indices, dtype: np.dtype) -> Indices:
        return self.read(at, int)

    def integer(self, at: int, dtype: np.dtype) -> int:
        token = self.token(at)
        return int(token) if token.isdigit() and len(token) < 18 else int(self.read(np.array(at), int))

    def numbers(self, at: Int64[np.ndarray, "rows 3"], types: list[np.dtype]) -> TextNumbers:
        return TextNumbers(self, at, whole=any(dtype.kind != "f" for dtype in types))


class _Bytes:
    """A binary body with the same methods, whose units are the bytes of the file."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.end = len(data)

    def width(self, dtype: np.dtype) -> int:
        return dtype.itemsize

    def integers(self, at: Indices, dtype: np.dtype) -> Indices:
        return gather(self._data, at, dtype).astype(np.int64)

    def integer(self, at: int, dtype: np.dtype) -> int:
        order = "big" if dtype.str[0] == ">" else "little"
        return int.from_bytes(self._data[at : at + dtype.itemsize], order, signed=dtype.kind == "i")

    def numbers(self, at: Int64[np.ndarray, "rows 3"], types: list[np.dtype]) -> BinaryNumbers:
        return BinaryNumbers(self._data, at, types)


_Body = _Tokens | _Bytes


def parse(data: bytes) -> Source:
    """Read positions, faces and normals, in any order of the elements.

    Normals are `nx ny nz` of vertices and of faces, if they are floats. Triangle strips are faces as well, and follow
    those of the element face.

    Raises:
        JaxmarkError: if the header or the body cannot be read, or the file ends too early.
    """
    order, elements, start = _header(data)
    names = [element.name for element in elements]
    for name in ("vertex", *_SURFACES):
        if names.count(name) > 1:
            raise JaxmarkError(f"The header declares the element {name} more than once.")
    body: _Body = _Tokens(data, start) if order == "=" else _Bytes(data)
    at, one_by_one = 0 if order == "=" else start, RunningCount(limits.ROWS, len(data))
    for element in elements:
        at = _locate(body, element, at, one_by_one)

    declared = {element.name: element for element in elements}
    vertex = declared.get("vertex", _Element("vertex", 0)).properties
    coordinates = _triples(body, vertex, ("x", "y", "z"))
    if coordinates is None and "packed_position" in vertex:
        return _packed_splat(data, body, vertex["packed_position"], declared.get("chunk", _Element("chunk", 0)))
    if coordinates is None:
        raise JaxmarkError("The header declares no element vertex with the numbers x, y and z.")
    faces = np.concatenate([_surface(body, declared.get(name, _Element(name, 0))) for name in _SURFACES])
    polygons, normals = declared.get("face", _Element("face", 0)).properties, list[Transported]()
    if (numbers := _normals(body, vertex)) is not None:
        outside = (faces < 0) | (faces >= len(coordinates.values))  # `make_mesh` refuses these with a better message
        normals.append(Transported(numbers, np.where(outside, -1, faces)))
    if (numbers := _normals(body, polygons)) is not None:
        sizes = next((polygons[name].sizes for name in _INDICES if name in polygons), _NONE)
        polygon = np.full(len(faces), -1)  # of each triangle; strips have none
        polygon[: (sizes - 2).sum()] = np.repeat(np.arange(len(sizes)), sizes - 2)
        normals.append(Transported(numbers, np.stack([polygon] * 3, axis=1)))
    return Source(data, coordinates, faces, normals)


def _packed_splat(data: bytes, body: _Body, packed: _Property, chunk: _Element) -> Source:
    """Read a compressed splat, in which every position is a number of 32 bits, and every chunk has a box."""
    low, high = (_triples(body, chunk.properties, (f"{end}_x", f"{end}_y", f"{end}_z")) for end in ("min", "max"))
    if low is None or high is None or packed.length is not None or packed.type.itemsize != 4:
        raise JaxmarkError("The file is a compressed splat without the boxes of its chunks; save it as plain PLY.")
    return splats.cloud(data, splats.unpack(body.integers(packed.starts, packed.type), low.values, high.values))


def _normals(body: _Body, properties: dict[str, _Property]) -> TextNumbers | BinaryNumbers | None:
    """Read the normals of vertices or faces; None if there are none, or they are not floats."""
    names = ("nx", "ny", "nz")
    floats = all(name in properties and properties[name].type.kind == "f" for name in names)
    return _triples(body, properties, names) if floats else None


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """Read the byte order, the elements, and the offset of the body."""
    begin = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if begin is None:
        raise JaxmarkError("line 1: a PLY file begins with a line that says ply.")
    end = re.compile(rb"(?<=[\r\n])end_header[ \t]*\r??" + begin[1]).search(data)
    if end is None:
        raise JaxmarkError(f"byte {len(data)}: the file ends inside the header, before end_header.")
    order = None
    elements: list[_Element] = []
    for number, line in enumerate(data[begin.end() : end.start()].decode("latin-1").split(begin[1].decode()), 2):
        try:
            match line.split():
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", name, *_]:
                    order = _ORDERS[name]
                case ["element", name, rows]:
                    elements.append(_Element(name, int(rows)))
                    if not 0 <= int(rows) < 2**62:
                        raise ValueError
                case ["property", "list", count, type_, name] if name not in elements[-1].properties:
                    elements[-1].properties[name] = _Property(_type(type_, order), _type(count, order))
                    if _type(count, order).kind == "f":
                        raise ValueError
                case ["property", type_, name] if name not in elements[-1].properties:
                    elements[-1].properties[name] = _Property(_type(type_, order), None)
                case _:
                    raise ValueError
        except (KeyError, IndexError, ValueError):
            raise JaxmarkError(f"line {number}: {line[:60]!a} does not belong in a PLY header here.") from None
    if order is None:
        raise JaxmarkError("The header declares no format.")
    return order, elements, end.end()


def _type(name: str, order: str | None) -> np.dtype:
    if order is None:  # the line with the format must come first
        raise ValueError
    return np.dtype(order + _TYPES[name])


def _locate(body: _Body, element: _Element, at: int, one_by_one: RunningCount) -> int:
    """Locate every property of an element; returns the place where the next element begins."""
    properties = element.properties.values()
    if element.rows == 0 or not properties:
        return at
    # Nearly always, all rows have lists of the same lengths as the first one.
    starts, sizes, end = _row(body, element, 0, at)
    lists = [
        (start - body.width(kind.length), kind.length, size)
        for kind, start, size in zip(properties, starts, sizes, strict=True)
        if kind.length is not None
    ]
    width = end - at
    if at + element.rows * width <= body.end:
        rows = width * np.arange(element.rows)
        if _all_alike(body, rows, lists):
            for kind, start, size in zip(properties, starts, sizes, strict=True):
                kind.starts, kind.sizes = rows + start, np.full(len(rows), size)
            return at + element.rows * width
    elif not lists:
        raise _ended(element, max(0, body.end - at) // width)
    one_by_one.add(element.rows)
    table = []
    for row in range(element.rows):
        *places, at = _row(body, element, row, at)
        if at > body.end:
            raise _ended(element, row)
        table.append(places)
    for kind, (starts, sizes) in zip(properties, np.array(table, np.int64).transpose(2, 1, 0), strict=True):
        kind.starts, kind.sizes = starts, sizes
    return at


def _row(body: _Body, element: _Element, number: int, at: int) -> tuple[list[int], list[int], int]:
    """Locate the properties of one row: where their items start, how many there are, and where the row ends."""
    starts, sizes = [], []
    for name, kind in element.properties.items():
        size = 1
        if kind.length is not None:
            if at + body.width(kind.length) > body.end:
                raise _ended(element, number)
            size = body.integer(at, kind.length)
            if size < 0:
                where = f"Row {number} (zero-based) of the element {element.name}"
                raise JaxmarkError(f"{where}: the list {name} has length {size}.")
            at += body.width(kind.length)
        starts.append(at)
        sizes.append(size)
        at += size * body.width(kind.type)
    return starts, sizes, at


def _all_alike(body: _Body, rows: Indices, lists: list[tuple[int, np.dtype, int]]) -> bool:
    """Whether the lists of all rows are as long as the first row's, at these offsets."""
    try:
        return all(bool((body.integers(rows + offset, kind) == size).all()) for offset, kind, size in lists)
    except JaxmarkError:  # something other than an integer stands there
        return False


def _ended(element: _Element, row: int) -> JaxmarkError:
    return JaxmarkError(
        f"The file ends in row {row} (zero-based) of the element {element.name}, which has {element.rows} rows."
    )


def _triples(
    body: _Body, properties: dict[str, _Property], names: tuple[str, str, str]
) -> TextNumbers | BinaryNumbers | None:
    """Read three scalar properties of an element; None if they are not declared."""
    kinds = [properties[name] for name in names if name in properties and properties[name].length is None]
    if len(kinds) < 3:
        return None
    return body.numbers(np.stack([kind.starts for kind in kinds], axis=1), [kind.type for kind in kinds])


def _surface(body: _Body, element: _Element) -> Faces:
    """Read the triangles of the element face or tristrips; none if it has no properties."""
    name = next((name for name in _INDICES if name in element.properties), None)
    if name is None:
        if element.properties:
            raise JaxmarkError(f"The element {element.name} has no list vertex_indices or vertex_index.")
        return np.zeros((0, 3), np.int64)
    kind = element.properties[name]
    if kind.length is None or kind.type.kind == "f":
        raise JaxmarkError(f"The indices of the element {element.name} must be a list of integers.")
    short = np.flatnonzero(kind.sizes < 3)
    if element.name == "face" and len(short):
        row = f"Row {short[0]} (zero-based) of the element face"
        raise JaxmarkError(f"{row} has {kind.sizes[short[0]]} corners; it needs at least three.")
    item = ranges(np.zeros_like(kind.sizes), kind.sizes)
    index = body.integers(np.repeat(kind.starts, kind.sizes) + item * body.width(kind.type), kind.type)
    return index[fan(kind.sizes)] if element.name == "face" else _strips(index, kind.sizes)


def _strips(items: Indices, sizes: Indices) -> Faces:
    """Read triangle strips: every three indices in a row are a triangle, every other one turned round; -1 ends a strip.

    Triangles that have a corner twice only lead a strip from one place to another, and are no faces.
    """
    index = np.insert(items, np.cumsum(sizes), -1)  # a row ends a strip as well
    place = np.arange(len(index))
    since = place - np.maximum.accumulate(np.where(index == -1, place + 1, 0))  # the place in the strip
    first, second, third = index[:-2], index[1:-1], index[2:]
    odd = since[:-2] % 2 == 1
    faces = np.stack([np.where(odd, second, first), np.where(odd, first, second), third], axis=1)
    real = (faces != -1).all(axis=1) & (first != second) & (second != third) & (third != first)
    return faces[real]
