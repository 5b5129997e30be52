"""A parsed mesh file that can be written again with other positions and otherwise the same bytes."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8


class Edits(NamedTuple):
    """Byte spans of a file and what to put there; the spans do not overlap."""

    starts: Int64[np.ndarray, " edits"]
    ends: Int64[np.ndarray, " edits"]
    tokens: list[bytes]


class Overlay(NamedTuple):
    """Numbers of a fixed size and the byte offsets where they go; a million are written in no time."""

    starts: Int64[np.ndarray, " numbers"]
    bytes: UInt8[np.ndarray, "numbers size"]


@runtime_checkable
class Numbers(Protocol):
    """Triples of numbers (positions or normals) that stand somewhere in a file."""

    values: Float64[np.ndarray, "rows 3"]

    def edits(self, values: Float64[np.ndarray, "rows 3"]) -> list[Edits | Overlay]:
        """The edits that turn the old values into the new; numbers that did not change are not touched."""
        ...

    def spacing(self, values: Float64[np.ndarray, "rows 3"]) -> float:
        """The largest step between neighbouring numbers that can be written at the new values."""
        ...

    def advice(self, step: float) -> str:
        """What would make the spacing as small as `step`, as half a sentence."""
        ...


@runtime_checkable
class Normals(Protocol):
    """Normals that stand in a file and follow its positions."""

    numbers: Numbers

    def moved(
        self,
        old: Float64[np.ndarray, "points 3"],
        new: Float64[np.ndarray, "points 3"],
        faces: Int64[np.ndarray, "faces 3"],
    ) -> Float64[np.ndarray, "rows 3"]:
        """The normals after the points moved from `old` to `new`."""
        ...


@dataclass
class Source:
    """One parsed file.

    Attributes:
        data: the file's bytes.
        coordinates: where the positions stand.
        faces: `[F, 3]` zero-based indices into the positions; polygons are fanned.
        normals: the normals to be recomputed, if the file has any.
    """

    data: bytes
    coordinates: Numbers
    faces: Int64[np.ndarray, "faces 3"]
    normals: Normals | None = None

    @property
    def positions(self) -> Float64[np.ndarray, "points 3"]:
        """The positions in file order."""
        return self.coordinates.values

    def edits(self, positions: Float64[np.ndarray, "points 3"]) -> list[Edits | Overlay]:
        """All edits that move the points to `positions`."""
        edits = self.coordinates.edits(positions)
        if self.normals is not None:
            moved = self.normals.moved(self.positions, positions, self.faces)
            edits += self.normals.numbers.edits(moved)
        return edits

    def patch(self, positions: Float64[np.ndarray, "points 3"]) -> bytes:
        """The file with these positions: whatever is no coordinate or normal stays byte for byte.

        Raises:
            JaxmarkError: if a position does not fit the file's number type.
        """
        return splice(self.data, self.edits(positions))


def changed(old: Float64[np.ndarray, "rows 3"], new: Float64[np.ndarray, "rows 3"]) -> Bool[np.ndarray, "rows 3"]:
    """Which numbers are to be written anew; a NaN normal is kept, though it does not equal itself."""
    return (old != new) & np.isfinite(new)


def splice(data: bytes, changes: Iterable[Edits | Overlay]) -> bytes:
    """Put in the changes, which may come in any order, and keep all other bytes."""
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
    """The ranges `[start, start + size)` one after the other."""
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
