"""Parse PLY: text, binary little endian and binary big endian."""

import re
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files.binary import BinaryNumbers, gather
from jaxmark.files.normals import Transported
from jaxmark.files.source import Source, fan, ranges
from jaxmark.files.text import Text, TextNumbers, unix

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    type: np.dtype  # the type of the scalar, or of the list's items
    length: np.dtype | None  # the type of a list's length; None for a scalar


@dataclass
class _Element:
    name: str
    rows: int
    properties: dict[str, _Property] = field(default_factory=dict)


class _Column(NamedTuple):
    """The places of a property's items in the body."""

    starts: Int64[np.ndarray, " rows"]  # place of each row's first item, in the body's units
    sizes: Int64[np.ndarray, " rows"]  # number of each row's items


class _Tokens:
    """A text body, whose units are tokens, numbered from 0 to `end`."""

    def __init__(self, data: bytes, start: int) -> None:
        self._text = Text(data, b" " * start + unix(data)[start:])
        self.end = len(self._text)

    def width(self, dtype: np.dtype) -> int:
        return 1

    def integers(self, at: Int64[np.ndarray, " items"], dtype: np.dtype) -> Int64[np.ndarray, " items"]:
        return self._text.ints(self._text.starts[at], self._text.ends[at])

    def integer(self, at: int, dtype: np.dtype) -> int:
        token = self._text.token(at)
        return int(token) if token.isdigit() and len(token) < 18 else int(self.integers(np.array([at]), dtype)[0])

    def triples(self, at: Int64[np.ndarray, "rows 3"], types: tuple[np.dtype, ...]) -> TextNumbers:
        return TextNumbers(self._text, at, whole=any(dtype.kind != "f" for dtype in types))


class _Bytes:
    """A binary body with the same methods, whose units are the bytes of the file."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self.end = len(data)

    def width(self, dtype: np.dtype) -> int:
        return dtype.itemsize

    def integers(self, at: Int64[np.ndarray, " items"], dtype: np.dtype) -> Int64[np.ndarray, " items"]:
        return gather(self._data, at, dtype).astype(np.int64)

    def integer(self, at: int, dtype: np.dtype) -> int:
        order = "big" if dtype.str[0] == ">" else "little"
        return int.from_bytes(self._data[at : at + dtype.itemsize], order, signed=dtype.kind == "i")

    def triples(self, at: Int64[np.ndarray, "rows 3"], types: tuple[np.dtype, ...]) -> BinaryNumbers:
        return BinaryNumbers(self._data, at, types)


_Body = _Tokens | _Bytes


def parse(data: bytes) -> Source:
    """Read the positions, the faces and, if they are floats, the normals `nx ny nz`, in any order of the elements.

    Triangle strips are faces as well, and follow those of the element face.

    Raises:
        JaxmarkError: if the header or the body cannot be read, or the file ends too early.
    """
    order, elements, start = _header(data)
    names = [element.name for element in elements]
    for name in ("vertex", *_SURFACES):
        if names.count(name) > 1:
            raise JaxmarkError(f"The header declares the element {name} more than once.")
    body: _Body = _Tokens(data, start) if order == "=" else _Bytes(data)
    at = 0 if order == "=" else start
    columns: dict[str, dict[str, _Column]] = {}
    for element in elements:
        columns[element.name], at = _locate(body, element, at)

    declared = {element.name: element.properties for element in elements}
    coordinates = _triples(body, declared, columns, ("x", "y", "z"))
    if coordinates is None:
        raise JaxmarkError("The header declares no element vertex with the numbers x, y and z.")
    faces = np.concatenate([_surface(body, declared, columns, element) for element in _SURFACES])
    normals = _triples(body, declared, columns, ("nx", "ny", "nz"))
    if normals is None or any(declared["vertex"][axis].type.kind != "f" for axis in ("nx", "ny", "nz")):
        return Source(data, coordinates, faces)
    outside = (faces < 0) | (faces >= len(coordinates.values))  # `make_mesh` refuses these with a better message
    return Source(data, coordinates, faces, Transported(normals, np.where(outside, -1, faces)))


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    """The byte order, the elements, and the offset of the body."""
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


def _locate(body: _Body, element: _Element, at: int) -> tuple[dict[str, _Column], int]:
    """Locate every property of an element, and the place where the next element begins."""
    properties = element.properties
    empty = np.zeros(0, np.int64)
    if element.rows == 0 or not properties:
        return {name: _Column(empty, empty) for name in properties}, at
    # Nearly always, all rows have lists of the same lengths as the first one.
    offsets, sizes, counts = [], [], []
    end = at
    for name, kind in properties.items():
        size = 1
        if kind.length is not None:
            size = _size(body, element, name, 0, end)
            counts.append((end - at, kind.length, size))
            end += body.width(kind.length)
        offsets.append(end - at)
        sizes.append(size)
        end += size * body.width(kind.type)
    width = end - at
    if at + element.rows * width <= body.end:
        rows = at + width * np.arange(element.rows)
        if _all_alike(body, rows, counts):
            columns = [
                _Column(rows + offset, np.full(len(rows), size)) for offset, size in zip(offsets, sizes, strict=True)
            ]
            return dict(zip(properties, columns, strict=True)), at + element.rows * width
    elif not counts:
        raise _ended(element, max(0, body.end - at) // width)
    return _locate_one_by_one(body, element, at)


def _all_alike(body: _Body, rows: Int64[np.ndarray, " rows"], counts: list[tuple[int, np.dtype, int]]) -> bool:
    """Whether the lists of all rows are as long as the first row's, at these offsets."""
    try:
        return all(bool((body.integers(rows + offset, kind) == size).all()) for offset, kind, size in counts)
    except JaxmarkError:  # something other than an integer stands there
        return False


def _locate_one_by_one(body: _Body, element: _Element, at: int) -> tuple[dict[str, _Column], int]:
    """Locate the properties of an element row by row, where rows differ."""
    starts: dict[str, list[int]] = {name: [] for name in element.properties}
    sizes: dict[str, list[int]] = {name: [] for name in element.properties}
    for row in range(element.rows):
        for name, kind in element.properties.items():
            size = 1
            if kind.length is not None:
                size = _size(body, element, name, row, at)
                at += body.width(kind.length)
            starts[name].append(at)
            sizes[name].append(size)
            at += size * body.width(kind.type)
        if at > body.end:
            raise _ended(element, row)
    return {
        name: _Column(np.array(starts[name], np.int64), np.array(sizes[name], np.int64)) for name in element.properties
    }, at


def _size(body: _Body, element: _Element, name: str, row: int, at: int) -> int:
    """Read the length of a list."""
    count = element.properties[name].length
    if count is None or at + body.width(count) > body.end:
        raise _ended(element, row)
    size = body.integer(at, count)
    if size < 0:
        raise JaxmarkError(f"Row {row} (zero-based) of the element {element.name}: the list {name} has length {size}.")
    return size


def _ended(element: _Element, row: int) -> JaxmarkError:
    return JaxmarkError(
        f"The file ends in row {row} (zero-based) of the element {element.name}, which has {element.rows} rows."
    )


def _triples(
    body: _Body,
    declared: dict[str, dict[str, _Property]],
    columns: dict[str, dict[str, _Column]],
    names: tuple[str, str, str],
) -> TextNumbers | BinaryNumbers | None:
    """Read three scalar properties of the vertices; None if they are not declared."""
    kinds = [declared.get("vertex", {}).get(name) for name in names]
    types = tuple(kind.type for kind in kinds if kind is not None and kind.length is None)
    if len(types) < 3:
        return None
    return body.triples(np.stack([columns["vertex"][name].starts for name in names], axis=1), types)


def _surface(
    body: _Body, declared: dict[str, dict[str, _Property]], columns: dict[str, dict[str, _Column]], element: str
) -> Int64[np.ndarray, "faces 3"]:
    """The triangles of the element face or tristrips; none if it is not declared, or has no properties."""
    properties = declared.get(element, {})
    name = next((name for name in ("vertex_indices", "vertex_index") if name in properties), None)
    if name is None:
        if properties:
            raise JaxmarkError(f"The element {element} has no list vertex_indices or vertex_index.")
        return np.zeros((0, 3), np.int64)
    kind, column = properties[name], columns[element][name]
    if kind.length is None or kind.type.kind == "f":
        raise JaxmarkError(f"The indices of the element {element} must be a list of integers.")
    return _SURFACES[element](body, kind, column)


def _items(body: _Body, kind: _Property, column: _Column) -> Int64[np.ndarray, " items"]:
    """Read all lists of a property, one after the other."""
    item = ranges(np.zeros_like(column.sizes), column.sizes)
    return body.integers(np.repeat(column.starts, column.sizes) + item * body.width(kind.type), kind.type)


def _faces(body: _Body, kind: _Property, column: _Column) -> Int64[np.ndarray, "faces 3"]:
    """Read the faces of a list of indices, split into triangles."""
    short = np.flatnonzero(column.sizes < 3)
    if len(short):
        raise JaxmarkError(
            f"Row {short[0]} (zero-based) of the element face has {column.sizes[short[0]]} corners; it needs at least"
            " three."
        )
    return _items(body, kind, column)[fan(column.sizes)]


def _strips(body: _Body, kind: _Property, column: _Column) -> Int64[np.ndarray, "faces 3"]:
    """Read triangle strips: every three indices in a row are a triangle, every other one turned round; -1 ends a strip.

    Triangles that have a corner twice only lead a strip from one place to another, and are no faces.
    """
    index = np.insert(_items(body, kind, column), np.cumsum(column.sizes), -1)  # a row ends a strip as well
    place = np.arange(len(index))
    since = place - np.maximum.accumulate(np.where(index == -1, place + 1, 0))  # the place in the strip
    first, second, third = index[:-2], index[1:-1], index[2:]
    odd = since[:-2] % 2 == 1
    faces = np.stack([np.where(odd, second, first), np.where(odd, first, second), third], axis=1)
    real = (faces != -1).all(axis=1) & (first != second) & (second != third) & (third != first)
    return faces[real]


_SURFACES = {"face": _faces, "tristrips": _strips}  # the elements that hold triangles, and what reads them
