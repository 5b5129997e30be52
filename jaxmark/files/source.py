"""Parsed mesh files, which can be written with other positions and normals, while all other bytes stay."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import cross_product
from jaxmark.geometry.pose import Points
from jaxmark.geometry.skinning import Skinning

_ANTIPARALLEL = 1e-6  # largest 1 + cos of a rotation's angle at which the minimal rotation is ill-defined

Rows = Float64[np.ndarray, "rows 3"]
SomeRows = Float64[np.ndarray, "some 3"]  # as many as are asked for
Faces = Int64[np.ndarray, "faces 3"]
Indices = Int64[np.ndarray, " _"]  # or byte offsets
Texture = Float64[np.ndarray, "faces 3 2"] | None


class Edits(NamedTuple):
    """Byte spans of a file to be replaced by other bytes; the spans do not overlap."""

    starts: Indices
    ends: Indices
    tokens: list[bytes]  # the new bytes of each span, of any length


class Overlay(NamedTuple):
    """Numbers of a fixed size to be written at byte offsets, all at once, which is fast for a million of them."""

    starts: Indices
    bytes: UInt8[np.ndarray, "numbers size"]  # the new bytes of each number


Changes = list[Edits | Overlay]


@runtime_checkable
class Numbers(Protocol):
    """Triples of numbers in a file: its positions or normals.

    Edits and rounding raise a `JaxmarkError` if a new value is beyond the range of the file's numbers.
    """

    values: Rows

    def edits(self, values: Rows) -> Changes:
        """Return the edits that write new values; numbers that did not change are not touched."""
        ...

    def rounded(self, values: Rows, rows: Indices) -> SomeRows:
        """Return some rows of the new values as they are read back once they are written."""
        ...

    def spacing(self, values: Rows, rows: Indices) -> float:
        """Return the largest step between neighbouring numbers that can be written at the new values of some rows."""
        ...

    def advice(self, step: float) -> str:
        """Advise, as half a sentence, what would make the spacing as small as `step`."""
        ...


class JoinedNumbers:
    """Triples of numbers that follow each other in several parts; see `Numbers`."""

    def __init__(self, parts: Sequence[Numbers]) -> None:
        self._parts, self._ends = parts, np.cumsum([len(part.values) for part in parts])
        self.values = np.concatenate([part.values for part in parts])

    def edits(self, values: Rows) -> Changes:
        """Return the edits of all parts."""
        pieces = zip(self._parts, np.split(values, self._ends[:-1]), strict=True)
        return [edit for part, piece in pieces for edit in part.edits(piece)]

    def rounded(self, values: Rows, rows: Indices) -> SomeRows:
        """Round each part on its own."""
        result = np.empty((len(rows), 3))
        for part, piece, mine, own in self._pieces(values, rows):
            result[mine] = part.rounded(piece, own)
        return result

    def spacing(self, values: Rows, rows: Indices) -> float:
        """Return the largest spacing of the parts that the rows are in."""
        return max(part.spacing(piece, own) for part, piece, _, own in self._pieces(values, rows))

    def _pieces(
        self, values: Rows, rows: Indices
    ) -> Iterator[tuple[Numbers, Rows, Bool[np.ndarray, " some"], Indices]]:
        """Yield each part that some rows are in: it, its values, the mask of its rows, and these in its own count."""
        pieces, starts = np.split(values, self._ends[:-1]), [0, *self._ends]
        place = np.searchsorted(self._ends, rows, side="right")
        for k in np.unique(place):
            yield self._parts[k], pieces[k], place == k, rows[place == k] - starts[k]

    def advice(self, step: float) -> str:
        """Advise what the first part advises."""
        return self._parts[0].advice(step)


@dataclass
class Transported:
    """Normals that turn with the faces that use them.

    The mean normal of these faces, weighted by area, turns from its old to its new direction by a minimal rotation; the
    file's normal turns by the same one. So smoothing groups, flat normals and any weighting stay as they were, and
    nothing turns where nothing moved.

    Attributes:
        numbers: the normals in the file.
        corners: the index of the normal that each corner of each face uses; -1 for none.
    """

    numbers: Numbers
    corners: Faces

    def _mean(self, points: Points, faces: Faces) -> Rows:
        """Average the normals of the faces that use each normal by area, each face counted once."""
        vectors = _area_vectors(points, faces)
        first, second, third = self.corners.T
        once = np.stack([first >= 0, (second >= 0) & (second != first), (third >= 0) & (third != first)], axis=1)
        once[:, 2] &= third != second
        entries, rows = self.corners[once], np.nonzero(once)[0]
        count = len(self.numbers.values)
        with np.errstate(all="ignore"):
            sums = [np.bincount(entries, vectors[rows, axis], count).astype(float) for axis in range(3)]
        return _unit(np.stack(sums, axis=1))

    def moved(self, old: Points, new: Points, faces: Faces) -> Rows:
        """Turn the normals; a normal that no face uses, or only faces without area, stays."""
        normals = self.numbers.values
        if not len(faces):
            return normals
        before, after = self._mean(old, faces), self._mean(new, faces)
        with np.errstate(all="ignore"):
            cosine = np.einsum("ij,ij->i", before, after)
            turns = (before != after).any(axis=1) & (1 + cosine > _ANTIPARALLEL) & np.isfinite(normals).all(axis=1)
        a, b, n = before[turns], after[turns], normals[turns]
        axis = np.cross(a, b)  # the axis of the rotation, times the sine of its angle
        along = np.einsum("ij,ij->i", axis, n) / (1 + cosine[turns])
        result = normals.copy()
        result[turns] = n * cosine[turns, None] + np.cross(axis, n) + axis * along[:, None]
        return result


@dataclass
class PerFace:
    """One normal for each face, as in STL files."""

    numbers: Numbers

    def moved(self, old: Points, new: Points, faces: Faces) -> Rows:
        """Compute the unit normals of the faces that moved; a zero normal stays, and that of a face without area."""
        normals = self.numbers.values
        computed = _unit(_area_vectors(new, faces))
        turns = (old != new).any(axis=1)[faces].any(axis=1) & normals.any(axis=1) & np.isfinite(computed).all(axis=1)
        return np.where(turns[:, None], computed, normals)


class Part(NamedTuple):
    """One mesh of a file that may hold several."""

    name: str  # unique in the file
    places: Indices  # its points, as rows of the file's positions
    faces: Faces  # indices into `places`


class Patched(NamedTuple):
    """A file with other positions."""

    file: bytes
    beside: Mapping[str, bytes] = {}  # other files that belong to it, by path relative to its folder
    notes: tuple[str, ...] = ()  # what could not stay as it was
    companions: tuple[str, ...] = ()  # paths of files that it refers to and that did not change


def read_nothing() -> None:
    """Return None, as the file has nothing of the kind."""


@dataclass
class Source:
    """One parsed file.

    Attributes:
        data: the file's bytes.
        coordinates: the positions in the file.
        faces: zero-based indices into the positions; polygons are split into triangles.
        normals: the normals that follow the positions.
        texture: reads the texture coordinates of each face's corners, NaN where there are none; None without any.
        skin: reads which joints move each point; None without any.
        parts: the meshes in the file that can be marked; empty if there is just one in it.
        skipped: the other meshes by name, and the reasons why they cannot be marked.
        fixed: a sentence why the file cannot be written with other positions; empty if it can.
    """

    data: bytes
    coordinates: Numbers
    faces: Faces
    normals: Sequence[Transported | PerFace] = ()
    texture: Callable[[], Texture] = read_nothing
    skin: Callable[[], Skinning | None] = read_nothing
    parts: Sequence[Part] = ()
    skipped: Mapping[str, str] = field(default_factory=dict)
    fixed: str = ""

    @property
    def positions(self) -> Points:
        """The positions in file order."""
        return self.coordinates.values

    def spliced(self, positions: Points) -> bytes:
        """Write these positions, and the normals that follow them, into the data."""
        edits = self.coordinates.edits(positions)
        for normals in self.normals:
            edits += normals.numbers.edits(normals.moved(self.positions, positions, self.faces))
        return splice(self.data, edits)

    def patch(self, positions: Points, name: str) -> Patched:
        """Write these positions into the file; all bytes but those of coordinates and normals stay.

        Files beside it are named after `name`, the name of the file without its suffix.
        """
        return Patched(self.spliced(positions))


@contextmanager
def concerning(where: object) -> Iterator[None]:
    """Name the file or the part of it that a refusal in the block concerns."""
    try:
        yield
    except JaxmarkError as error:
        raise JaxmarkError(f"{where}: {error}") from error


def unusable(skipped: Mapping[str, str], count: int) -> str:
    """Return the sentence that none of several meshes can be marked, with the first reasons."""
    reasons = "; ".join(f"{name!r}: {reason}" for name, reason in list(skipped.items())[:3])
    return f"None of its {count} meshes can be marked: {reasons}{'; …' if len(skipped) > 3 else ''}."


def linked(one: Indices, other: Indices, count: int) -> Indices:
    """Return the number of the connected component of each node of a graph of `count` nodes."""
    graph = sparse.coo_array((np.ones(len(one), np.int8), (one, other)), (count, count))
    return csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def unique_names(names: Iterable[str]) -> list[str]:
    """Append numbers to repeated names, so that no two are the same."""
    names = list(names)
    given, count = set(names), dict[str, int]()
    unique: list[str] = []
    for name in names:
        count[name] = count.get(name, 0) + 1
        while count[name] > 1 and f"{name} #{count[name]}" in given:
            count[name] += 1
        unique.append(name if count[name] == 1 else f"{name} #{count[name]}")
    return unique


def changed(old: Rows, new: Rows) -> Bool[np.ndarray, "rows 3"]:
    """Return the mask of the numbers to be written; a NaN normal is kept, though it does not equal itself."""
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
            edits += zip(change.starts.tolist(), change.ends.tolist(), change.tokens, strict=True)
    data, at = out.tobytes(), 0
    pieces: list[bytes] = []
    for start, end, token in sorted(edits):
        pieces += (data[at:start], token)
        at = end
    return b"".join([*pieces, data[at:]])


def ranges(starts: Indices, sizes: Indices) -> Int64[np.ndarray, " total"]:
    """Concatenate the ranges `[start, start + size)`."""
    return np.repeat(starts - (np.cumsum(sizes) - sizes), sizes) + np.arange(sizes.sum())


def fan(sizes: Indices) -> Faces:
    """Split polygons of at least three corners into triangles (v0, v1, v2), (v0, v2, v3) and so on.

    Corners are numbered through all polygons.
    """
    first = np.cumsum(sizes) - sizes
    second = ranges(first + 1, sizes - 2)
    return np.stack([np.repeat(first, sizes - 2), second, second + 1], axis=1)


def _area_vectors(points: Points, faces: Faces) -> Float64[np.ndarray, "faces 3"]:
    """Compute normals of faces, as long as twice the face's area."""
    with np.errstate(all="ignore"):  # huge coordinates give infinities, which callers exclude
        first = points[faces[:, 0]]
        return cross_product(points[faces[:, 1]] - first, points[faces[:, 2]] - first)


def _unit(vectors: Rows) -> Rows:
    """Normalise vectors to length 1; zero becomes NaN."""
    with np.errstate(all="ignore"):
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
