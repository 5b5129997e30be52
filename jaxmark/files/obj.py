"""Parse Wavefront OBJ."""

import re

import numpy as np
from jaxtyping import Int64

from jaxmark.files.normals import Transported
from jaxmark.files.source import Source, fan, ranges
from jaxmark.files.text import Text, TextNumbers, unix, without_comments


def parse(data: bytes) -> Source:
    """Read the `v`, `vn` and `f` lines of all groups; everything else is left alone.

    Raises:
        JaxmarkError: if a line cannot be read, or a face has fewer than three corners or refers to a vertex that does
            not exist; the message names the line.
    """
    work = without_comments(unix(data))
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
    if len(normals):
        numbers = _triples(text, normals, first, count, "normal")
        used = np.full(len(corners), -1)
        second = text.seek("/", np.minimum(slash + 1, ends), ends) + 1
        named = second < ends
        before = np.repeat(np.searchsorted(normals, lines), sizes)
        used[named] = _absolute(text.ints(second[named], ends[named]), before[named])
        used[(used < 0) | (used >= len(normals))] = -1  # a wrong index of a normal is no reason to refuse the file
        source.normals = Transported(numbers, used[triangles])
    return source


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
