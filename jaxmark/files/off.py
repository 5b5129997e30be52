"""Parse the Object File Format (OFF), text only."""

import re

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files.normals import Transported
from jaxmark.files.source import Source, fan, ranges
from jaxmark.files.text import Text, TextNumbers, unix, without_comments

_HEADER = re.compile(rb"\s*((?:ST)?C?(N?)(4?n?)OFF)(?:(?=\d)|\s+|$)(BINARY)?")


def parse(data: bytes) -> Source:
    """Read OFF, COFF, NOFF, STOFF and their combinations: one vertex or face to a line.

    Raises:
        JaxmarkError: if a line cannot be read or is missing (the message names the line), the file is binary, or its
            vertices do not have three coordinates.
    """
    work = without_comments(unix(data))
    header = _HEADER.match(work)
    if header is None:
        raise JaxmarkError("line 1: an OFF file begins with OFF, or COFF, NOFF, STOFF or a combination.")
    keyword = header[1].decode()
    if header[4]:
        raise JaxmarkError(f"line 1: binary OFF ({keyword} BINARY) is not supported; save it as text.")
    if header[3]:
        raise JaxmarkError(f"line 1: {keyword} is not supported, because its vertices do not have three coordinates.")
    work = work[: header.start(1)] + b" " * len(keyword) + work[header.end(1) :]

    text = Text(data, work)
    first, count = text.lines()
    if len(first) == 0 or count[0] < 2:
        raise text.error(header.end(1), "the numbers of vertices and faces are missing")
    points, polygons = text.ints(text.starts[:2], text.ends[:2]).tolist()
    if min(points, polygons) < 0 or points + polygons > len(first) - 1:
        raise text.error(
            text.starts[0],
            f"{points} vertices and {polygons} faces are announced, each on a line of its own, but"
            f" {len(first) - 1} lines follow",
        )
    vertices = first[1 : 1 + points]
    needed = 6 if header[2] else 3
    short = np.flatnonzero(count[1 : 1 + points] < needed)
    if len(short):
        raise text.error(text.starts[vertices[short[0]]], f"a vertex of {keyword} needs {needed} numbers")
    coordinates = TextNumbers(text, vertices[:, None] + np.arange(3))

    lines = first[1 + points : 1 + points + polygons]
    sizes = text.ints(text.starts[lines], text.ends[lines])
    for wrong, what in (
        (sizes < 3, "a face needs at least three corners"),
        (sizes >= count[1 + points : 1 + points + polygons], "the face has fewer indices than it announces"),
    ):
        if wrong.any():
            raise text.error(text.starts[lines[np.argmax(wrong)]], what)
    corners = ranges(lines + 1, sizes)
    index = text.ints(text.starts[corners], text.ends[corners])
    outside = np.flatnonzero((index < 0) | (index >= points))
    if len(outside):
        raise text.error(
            text.starts[corners[outside[0]]],
            f"the face refers to vertex {index[outside[0]]}, but there are {points}, numbered from 0",
        )
    faces = index[fan(sizes)]
    normals = Transported(TextNumbers(text, vertices[:, None] + np.arange(3, 6)), faces) if header[2] else None
    return Source(data, coordinates, faces, normals)
