"""Checked access to a glTF document: its lists, and where the elements of accessors stand."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files.binary import gather
from jaxmark.files.gltf.container import Container

FLOAT = np.dtype("<f4")
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_COMPRESSED = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_MAX_COUNT = 2**31
_MAX_READS = 16  # elements that are read for each byte of a file, on average; accessors may share bytes


class Elements(NamedTuple):
    """Where the elements of an accessor stand."""

    starts: Int64[np.ndarray, " count"]  # byte offset of each in `Container.data`
    dtype: np.dtype  # of their components
    width: int  # number of components
    unit: float  # what a component of 1 stands for: less than 1 if integers are normalised

    @property
    def size(self) -> int:
        """Number of bytes of an element."""
        return self.dtype.itemsize * self.width


class Document:
    """The lists of a glTF document; every access is checked."""

    def __init__(self, container: Container) -> None:
        self.container = container
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._reads = 0

    def items(self, kind: str) -> list[dict[str, Any]]:
        """A list of objects at the top of the document, empty if absent."""
        if kind not in self._lists:
            self._lists[kind] = objects(self.container.document, kind, "the document")
        return self._lists[kind]

    def item(self, kind: str, index: int) -> dict[str, Any]:
        """One object of a list at the top of the document."""
        items = self.items(kind)
        if index >= len(items):
            raise JaxmarkError(f"{kind}[{index}] is referred to, but there are {len(items)}.")
        return items[index]

    def form(self, index: int) -> tuple[np.dtype, int, float, int]:
        """The component type of an accessor, its width, what a component of 1 stands for, and its count."""
        where = f"accessors[{index}]"
        accessor = self.item("accessors", index)
        component, width = accessor.get("componentType"), accessor.get("type")
        if component not in list(COMPONENTS) or width not in list(WIDTHS):
            raise JaxmarkError(f"{where} is of an unknown type.")
        dtype = np.dtype(COMPONENTS[int(component)])
        whole_unit = 1 / float(np.iinfo(dtype).max) if dtype.kind != "f" and accessor.get("normalized") is True else 1.0
        count = whole(accessor, "count", where)
        if not 0 < count < _MAX_COUNT:
            raise JaxmarkError(f"{where} has {count} elements.")
        return dtype, WIDTHS[str(width)], whole_unit, count

    def elements(self, index: int) -> Elements:
        """Where the elements of an accessor stand, which must lie inside its buffer."""
        where = f"accessors[{index}]"
        dtype, width, unit, count = self.form(index)
        self._reads += count
        if self._reads > _MAX_READS * len(self.container.data) + 2**20:
            raise JaxmarkError(f"{where} and others read the same bytes too often; save the file with other software.")
        accessor = self.item("accessors", index)
        if "sparse" in accessor:
            raise JaxmarkError(f"{where} is sparse, which is not supported.")
        number = whole(accessor, "bufferView", where)
        begin, length = self.view(number)
        stride = whole(self.item("bufferViews", number), "byteStride", f"bufferViews[{number}]", dtype.itemsize * width)
        first = whole(accessor, "byteOffset", where, 0)
        last = first + (count - 1) * stride + dtype.itemsize * width
        if stride < dtype.itemsize * width or last > length:
            raise JaxmarkError(f"{where} does not lie inside its buffer view and its buffer.")
        return Elements(begin + first + stride * np.arange(count), dtype, width, unit)

    def view(self, number: int) -> tuple[int, int]:
        """Where a buffer view begins in `Container.data`, and its length."""
        where = f"bufferViews[{number}]"
        view = self.item("bufferViews", number)
        extensions = view.get("extensions")
        for name in _COMPRESSED:
            if isinstance(extensions, dict) and name in extensions:
                raise JaxmarkError(f"{where} is compressed with {name}, which is not supported; save it without.")
        index = whole(view, "buffer", where)
        if index >= len(self.container.buffers):
            raise JaxmarkError(f"buffers[{index}] is referred to, but there are {len(self.container.buffers)}.")
        buffer = self.container.buffers[index]
        if isinstance(buffer, str):
            raise JaxmarkError(f"{buffer}.")
        offset, length = whole(view, "byteOffset", where, 0), whole(view, "byteLength", where)
        if offset + length > len(buffer.place):
            raise JaxmarkError(f"{where} does not lie inside its buffer, so that the accessors in it do not either.")
        return buffer.place.start + offset, length

    def numbers(self, index: int) -> Float64[np.ndarray, "count width"]:
        """The numbers of an accessor."""
        starts, dtype, width, unit = self.elements(index)
        offsets = starts[:, None] + dtype.itemsize * np.arange(width)
        return gather(self.container.data, offsets, dtype).astype(np.float64) * unit


def objects(parent: dict[str, Any], key: str, where: str) -> list[dict[str, Any]]:
    """A list of objects in an object, empty if absent."""
    items = parent.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise JaxmarkError(f"{key} of {where} is not a list of objects.")
    return items


def whole(parent: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
    """An index or a length in an object."""
    value = parent.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**53:
        raise JaxmarkError(f"{key} of {where} is {ascii(value)[:40]}, not an index or a length.")
    return value


def attribute(primitive: dict[str, Any], name: str) -> int | None:
    """The accessor of an attribute of a primitive; None if it has none."""
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict):
        raise JaxmarkError("A primitive has no attributes.")
    return whole(attributes, name, "attributes") if name in attributes else None
