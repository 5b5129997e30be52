"""Checked access to a glTF document: its lists, and the places of the elements of accessors."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files.binary import gather
from jaxmark.files.gltf.container import Container, Read
from jaxmark.files.source import Indices

FLOAT = np.dtype("<f4")
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_COMPRESSED = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_MAX_COUNT = 2**31
_MAX_READS = 16  # elements that are read for each byte of a file, on average; accessors may share bytes


class Elements(NamedTuple):
    """The places of the elements of an accessor."""

    starts: Indices  # byte offset of each in `Container.data`
    dtype: np.dtype  # of their components
    width: int  # number of components
    unit: float  # the number that a component of 1 stands for: less than 1 if integers are normalised

    @property
    def size(self) -> int:
        """Number of bytes of an element."""
        return self.dtype.itemsize * self.width

    @property
    def span(self) -> slice:
        """The bytes of `Container.data` from the first element to the last one."""
        return slice(int(self.starts[0]), int(self.starts[-1]) + self.size)

    @property
    def offsets(self) -> Int64[np.ndarray, "count width"]:
        """Byte offset of each component in `Container.data`."""
        return self.starts[:, None] + self.dtype.itemsize * np.arange(self.width)


class Document(Container):
    """A glTF document, every access to which is checked.

    Attributes:
        located: the elements of accessors that were read or decoded, by index.
        decoded: the indices of those that were compressed.
    """

    def __init__(self, file: bytes, read: Read) -> None:
        super().__init__(file, read)
        self.located: dict[int, Elements] = {}
        self.decoded: set[int] = set()
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._reads = 0

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
            return self.located[index]
        where = f"accessors[{index}]"
        dtype, width, unit, count = self.form(index)
        size = dtype.itemsize * width
        self._reads += count
        if self._reads > _MAX_READS * len(self.data) + 2**20:
            raise JaxmarkError(f"{where} and others read the same bytes too often; save the file with other software.")
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
        """Locate a buffer view: where it begins in `Container.data`, and its length."""
        where = f"bufferViews[{number}]"
        view = self.item("bufferViews", number)
        extensions = view.get("extensions")
        for name in _COMPRESSED:
            if isinstance(extensions, dict) and name in extensions:
                raise JaxmarkError(f"{where} is compressed with {name}, which is not supported; save it without.")
        index = whole(view, "buffer", where)
        if index >= len(self.buffers):
            raise JaxmarkError(f"buffers[{index}] is referred to, but there are {len(self.buffers)}.")
        buffer = self.buffers[index]
        if isinstance(buffer, str):
            raise JaxmarkError(f"{buffer}.")
        offset, length = whole(view, "byteOffset", where, 0), whole(view, "byteLength", where)
        if offset + length > len(buffer.place):
            raise JaxmarkError(f"{where} does not lie inside its buffer, so that the accessors in it do not either.")
        return buffer.place.start + offset, length

    def numbers(self, index: int) -> Float64[np.ndarray, "count width"]:
        """Read the numbers of an accessor."""
        rows = self.elements(index)
        return gather(self.data, rows.offsets, rows.dtype).astype(np.float64) * rows.unit


def uses(mesh: dict[str, Any]) -> Iterator[tuple[str, int]]:
    """Yield the accessors that a mesh uses, each after its role, such as POSITION; malformed entries are left out."""
    primitives = mesh.get("primitives")
    for primitive in primitives if isinstance(primitives, list) else []:
        if isinstance(primitive, dict):
            attributes, targets = primitive.get("attributes"), primitive.get("targets")
            found: list[tuple[str, Any]] = [("indices", primitive.get("indices"))]
            found += attributes.items() if isinstance(attributes, dict) else ()
            for target in targets if isinstance(targets, list) else []:
                found += [("target", index) for index in target.values()] if isinstance(target, dict) else []
            yield from (use for use in found if isinstance(use[1], int))


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
