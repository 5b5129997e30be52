"""Parsed mesh files, which can be written again with other positions and otherwise the same bytes."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from jaxmark.geometry.skinning import Skinning


class Edits(NamedTuple):
    """Byte spans of a file to be replaced by other bytes; the spans do not overlap."""

    starts: Int64[np.ndarray, " edits"]
    ends: Int64[np.ndarray, " edits"]
    tokens: list[bytes]  # the new bytes of each span, of any length


class Overlay(NamedTuple):
    """Numbers of a fixed size to be written at byte offsets, all at once, which is fast for a million of them."""

    starts: Int64[np.ndarray, " numbers"]
    bytes: UInt8[np.ndarray, "numbers size"]  # the new bytes of each number


@runtime_checkable
class Numbers(Protocol):
    """Triples of numbers in a file: its positions or normals."""

    values: Float64[np.ndarray, "rows 3"]

    def edits(self, values: Float64[np.ndarray, "rows 3"]) -> list[Edits | Overlay]:
        """The edits that write new values; numbers that did not change are not touched."""
        ...

    def spacing(self, values: Float64[np.ndarray, "rows 3"], rows: Int64[np.ndarray, " some"]) -> float:
        """The largest step between neighbouring numbers that can be written at the new values of some rows."""
        ...

    def advice(self, step: float) -> str:
        """Advise, as half a sentence, what would make the spacing as small as `step`."""
        ...


@runtime_checkable
class Normals(Protocol):
    """Normals of a file, which follow its positions."""

    numbers: Numbers  # the normals in the file

    def moved(
        self,
        old: Float64[np.ndarray, "points 3"],
        new: Float64[np.ndarray, "points 3"],
        faces: Int64[np.ndarray, "faces 3"],
    ) -> Float64[np.ndarray, "rows 3"]:
        """The normals after the points moved from `old` to `new`."""
        ...


Texture = Float64[np.ndarray, "faces 3 2"] | None


def no_texture() -> Texture:
    """The texture coordinates of a file that has none."""
    return None


def no_skin() -> Skinning | None:
    """The skin of a file that has none."""
    return None


class Part(NamedTuple):
    """One mesh of a file that may hold several."""

    name: str  # unique in the file
    places: Int64[np.ndarray, " points"]  # its points, as rows of the file's positions
    faces: Int64[np.ndarray, "faces 3"]  # indices into `places`


class Patched(NamedTuple):
    """A file with other positions."""

    file: bytes
    beside: Mapping[str, bytes] = {}  # other files that belong to it, by path relative to its folder
    remarks: tuple[str, ...] = ()  # what could not stay as it was
    companions: tuple[str, ...] = ()  # paths of files that it refers to and that did not change


@dataclass
class Source:
    """One parsed file.

    Attributes:
        data: the file's bytes.
        coordinates: the positions in the file.
        faces: `[F, 3]` zero-based indices into the positions; polygons are split into triangles.
        normals: the normals that follow the positions, if the file has any.
        texture: reads the texture coordinates of each face's corners, NaN where there are none; None without any.
        skin: reads which joints move each point; None without any.
        parts: the meshes in the file that can be marked; empty if there is just one in it.
        left: the others by name, and why they cannot.
    """

    data: bytes
    coordinates: Numbers
    faces: Int64[np.ndarray, "faces 3"]
    normals: Normals | None = None
    texture: Callable[[], Texture] = no_texture
    skin: Callable[[], Skinning | None] = no_skin
    parts: Sequence[Part] = ()
    left: Mapping[str, str] = field(default_factory=dict)

    @property
    def positions(self) -> Float64[np.ndarray, "points 3"]:
        """The positions in file order."""
        return self.coordinates.values

    def edits(self, positions: Float64[np.ndarray, "points 3"]) -> list[Edits | Overlay]:
        """All edits that write these positions and the normals that follow them."""
        edits = self.coordinates.edits(positions)
        if self.normals is not None:
            moved = self.normals.moved(self.positions, positions, self.faces)
            edits += self.normals.numbers.edits(moved)
        return edits

    def patch(self, positions: Float64[np.ndarray, "points 3"], name: str) -> Patched:
        """The file with these positions; whatever is no coordinate or normal stays byte for byte.

        Args:
            positions: the new ones.
            name: name of the file that is written, without its suffix; files beside it are named after it.

        Raises:
            JaxmarkError: if a position does not fit the file's number type.
        """
        return Patched(splice(self.data, self.edits(positions)))


def unique_names(names: Iterable[str]) -> list[str]:
    """Names of which no two are the same."""
    count: dict[str, int] = {}
    unique: list[str] = []
    for name in names:
        count[name] = count.get(name, 0) + 1
        unique.append(name if count[name] == 1 else f"{name} #{count[name]}")
    return unique


def changed(old: Float64[np.ndarray, "rows 3"], new: Float64[np.ndarray, "rows 3"]) -> Bool[np.ndarray, "rows 3"]:
    """Mask of the numbers to be written anew; a NaN normal is kept, though it does not equal itself."""
    return (old != new) & np.isfinite(new)


def splice(data: bytes, changes: Iterable[Edits | Overlay]) -> bytes:
    """Apply changes, which may come in any order, and keep all other bytes."""
    out = np.frombuffer(data, np.uint8).copy()
    edits = []
    for change in changes:
        if isinstance(change, Overlay):
            for byte in range(change.bytes.shape[1]):
                out[change.starts + byte] = change.bytes[:, byte]
        else:
            edits.append(change)
    data = out.tobytes()
    pieces: list[bytes] = []
    at = 0
    for start, end, token in sorted(
        edit for group in edits for edit in zip(group.starts.tolist(), group.ends.tolist(), group.tokens, strict=True)
    ):
        pieces += (data[at:start], token)
        at = end
    pieces.append(data[at:])
    return b"".join(pieces)


def ranges(starts: Int64[np.ndarray, " rows"], sizes: Int64[np.ndarray, " rows"]) -> Int64[np.ndarray, " total"]:
    """Concatenate the ranges `[start, start + size)`."""
    before = np.cumsum(sizes) - sizes
    return np.repeat(starts - before, sizes) + np.arange(sizes.sum())


def fan(sizes: Int64[np.ndarray, " polygons"]) -> Int64[np.ndarray, "faces 3"]:
    """Split polygons into triangles (v0, v1, v2), (v0, v2, v3) and so on.

    Args:
        sizes: the number of corners of each polygon, at least 3; corners are numbered through all polygons.

    Returns:
        The three corner numbers of each triangle.
    """
    first = np.repeat(np.cumsum(sizes) - sizes, sizes - 2)
    second = ranges(np.cumsum(sizes) - sizes + 1, sizes - 2)
    return np.stack([first, second, second + 1], axis=1)
