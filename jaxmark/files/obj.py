"""Parse Wavefront OBJ."""

import re
from codecs import BOM_UTF8
from collections.abc import Sequence

import numpy as np
from jaxtyping import Int64
from scipy import sparse
from scipy.sparse import csgraph

from jaxmark.errors import JaxmarkError
from jaxmark.files.normals import Transported
from jaxmark.files.source import Part, Source, Texture, fan, ranges, unique_names
from jaxmark.files.text import Text, TextNumbers, unix, without_comments

_MAX_NAME = 200  # bytes of an object's name


def parse(data: bytes) -> Source:
    """Read the `v`, `vn` and `f` lines of all groups; everything else is left alone.

    Raises:
        JaxmarkError: if a line cannot be read, or a face has fewer than three corners or refers to a vertex that does
            not exist; the message names the line.
    """
    work = without_comments(unix(data))
    if work.startswith(BOM_UTF8):  # some programs begin text files so
        work = b" " * len(BOM_UTF8) + work[len(BOM_UTF8) :]
    if b"\\" in work:  # a backslash at the end of a line continues it
        work = re.sub(rb"\\\r?\n", lambda match: b" " * len(match[0]), work)
    text = Text(data, work)
    first, count = text.lines()
    vertices = first[_keyword(text, first, b"v")]
    normals = first[_keyword(text, first, b"vn")]
    is_face = _keyword(text, first, b"f")
    lines, sizes = first[is_face], count[is_face] - 1
    if (sizes < 3).any():
        bad = int(np.argmax(sizes < 3))
        raise text.error(text.starts[lines[bad]], f"a face needs at least three corners, this one has {sizes[bad]}")

    coordinates = _triples(text, vertices, first, count, "vertex")
    corners = ranges(lines + 1, sizes)
    starts, ends = text.starts[corners], text.ends[corners]
    slash = text.seek("/", starts, ends)
    index = _absolute(text.ints(starts, slash), np.repeat(np.searchsorted(vertices, lines), sizes))
    outside = np.flatnonzero((index < 0) | (index >= len(vertices)))
    if len(outside):
        token = text.token(int(corners[outside[0]]))[:40].decode("ascii", "backslashreplace")
        raise text.error(
            starts[outside[0]],
            f"the face corner '{token}' refers to a vertex that is not there; the file has {len(vertices)} vertices,"
            " numbered from 1",
        )
    triangles = fan(sizes)
    source = Source(data, coordinates, index[triangles])
    objects = first[_keyword(text, first, b"o")]
    if len(objects) > 1:
        owner = np.repeat(np.searchsorted(objects, lines), sizes - 2)  # 0 before the first object
        source.parts = _objects(text, source.faces, owner, objects, len(vertices))
    second = text.seek("/", np.minimum(slash + 1, ends), ends)
    source.texture = lambda: _texture(text, first, count, lines, sizes, slash + 1, second)
    if len(normals):
        numbers = _triples(text, normals, first, count, "normal")
        used = np.full(len(corners), -1)
        named = second + 1 < ends
        before = np.repeat(np.searchsorted(normals, lines), sizes)
        used[named] = _absolute(text.ints(second[named] + 1, ends[named]), before[named])
        used[(used < 0) | (used >= len(normals))] = -1  # a wrong index of a normal is no reason to refuse the file
        source.normals = Transported(numbers, used[triangles])
    return source


def _objects(
    text: Text,
    faces: Int64[np.ndarray, "faces 3"],
    owner: Int64[np.ndarray, " faces"],
    objects: Int64[np.ndarray, " objects"],
    size: int,
) -> Sequence[Part]:
    """The objects of a file, those together that share vertices; none if that leaves fewer than two.

    Args:
        text: the file.
        faces: all faces.
        owner: number of the object that each face is in, from 1; 0 before the first object.
        objects: the first token of the lines that name objects.
        size: number of vertices.
    """
    count = len(objects) + 1
    links = np.repeat(owner, 3), count + faces.ravel()
    graph = sparse.coo_array((np.ones(faces.size, np.int8), links), (count + size, count + size))
    group = csgraph.connected_components(graph, directed=False)[1][owner]
    groups, inverse = np.unique(group, return_inverse=True)
    if len(groups) < 2:
        return ()
    order = np.argsort(inverse, kind="stable")
    ends = np.cumsum(np.bincount(inverse))
    starts = ends - np.bincount(inverse)
    names = unique_names(_name(text, objects, int(owner[order[start]])) for start in starts)
    parts = []
    for name, start, end in zip(names, starts, ends, strict=True):
        places, local = np.unique(faces[order[start:end]], return_inverse=True)
        parts.append(Part(name, places, local.reshape(-1, 3)))
    return sorted(parts, key=lambda part: int(part.places[0]))


def _name(text: Text, objects: Int64[np.ndarray, " objects"], number: int) -> str:
    """The name of an object: what follows on its line."""
    if number == 0:
        return "object 0"
    begin = int(text.ends[objects[number - 1]])
    line = text.buffer[begin : begin + _MAX_NAME].tobytes().splitlines()
    return (line[0].strip().decode("utf-8", "replace") if line else "") or f"object {number}"


def _texture(
    text: Text,
    first: Int64[np.ndarray, " lines"],
    count: Int64[np.ndarray, " lines"],
    lines: Int64[np.ndarray, " polygons"],
    sizes: Int64[np.ndarray, " polygons"],
    begins: Int64[np.ndarray, " corners"],
    ends: Int64[np.ndarray, " corners"],
) -> Texture:
    """Texture coordinates of the triangles' corners, which lie between these places as indices of `vt` lines."""
    rows = first[_keyword(text, first, b"vt")]
    if not len(rows) or (count[np.searchsorted(first, rows)] < 3).any():
        return None
    tokens = (rows[:, None] + np.arange(1, 3)).ravel()
    try:
        values = text.floats(text.starts[tokens], text.ends[tokens]).reshape(-1, 2)
        named, used = begins < ends, np.full(len(begins), -1)
        before = np.repeat(np.searchsorted(rows, lines), sizes)
        used[named] = _absolute(text.ints(begins[named], ends[named]), before[named])
    except JaxmarkError:  # a wrong texture is no reason to refuse the file
        return None
    known = (used >= 0) & (used < len(rows))
    return np.where(known[:, None], values[used.clip(0, len(rows) - 1)], np.nan)[fan(sizes)]


def _keyword(text: Text, first: Int64[np.ndarray, " lines"], word: bytes) -> np.ndarray:
    """Mask of the lines that begin with a word."""
    match = text.ends[first] - text.starts[first] == len(word)
    for index, char in enumerate(word):
        # Offsets are clamped, as a last token that is shorter than the word would be read past the buffer's end.
        match &= text.buffer[np.minimum(text.starts[first] + index, len(text.buffer) - 1)] == char
    return match


def _triples(
    text: Text,
    lines: Int64[np.ndarray, " rows"],
    first: Int64[np.ndarray, " lines"],
    count: Int64[np.ndarray, " lines"],
    name: str,
) -> TextNumbers:
    """Read the three numbers after the keyword of each line."""
    short = np.flatnonzero(count[np.searchsorted(first, lines)] < 4)
    if len(short):
        raise text.error(text.starts[lines[short[0]]], f"a {name} needs three numbers")
    return TextNumbers(text, lines[:, None] + np.arange(1, 4))


def _absolute(
    index: Int64[np.ndarray, " corners"], before: Int64[np.ndarray, " corners"]
) -> Int64[np.ndarray, " corners"]:
    """Convert indices, counted from 1 or, if negative, back from their line, to zero-based; negative if outside."""
    return np.where(index < 0, index + before, index - 1)
