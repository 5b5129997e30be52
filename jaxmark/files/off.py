"""Parse the Object File Format (OFF), text only."""

import re

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files.source import Source, Transported, fan, ranges
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
    text = Text(data, work[: header.start(1)] + b" " * len(keyword) + work[header.end(1) :])
    first, count = text.lines()
    if len(first) == 0 or count[0] < 2:
        raise text.error(header.end(1), "the numbers of vertices and faces are missing")
    points, polygons = text.read(np.arange(2), int).tolist()
    if min(points, polygons) < 0 or points + polygons > len(first) - 1:
        raise text.error(
            text.starts[0],
            f"{points} vertices and {polygons} faces are announced, each on a line of its own, but"
            f" {len(first) - 1} lines follow",
        )
    of_vertices, of_faces = slice(1, 1 + points), slice(1 + points, 1 + points + polygons)
    vertices, lines = first[of_vertices], first[of_faces]
    needed = 6 if header[2] else 3
    text.refuse(count[of_vertices] < needed, text.starts[vertices], f"a vertex of {keyword} needs {needed} numbers")
    coordinates = TextNumbers(text, vertices[:, None] + np.arange(3))

    sizes = text.read(lines, int)
    text.refuse(sizes < 3, text.starts[lines], "a face needs at least three corners")
    text.refuse(sizes >= count[of_faces], text.starts[lines], "the face has fewer indices than it announces")
    corners = ranges(lines + 1, sizes)
    index = text.read(corners, int)
    text.refuse(
        (index < 0) | (index >= points),
        text.starts[corners],
        lambda bad: f"the face refers to vertex {index[bad]}, but there are {points}, numbered from 0",
    )
    faces = index[fan(sizes)]
    normals = [Transported(TextNumbers(text, vertices[:, None] + np.arange(3, 6)), faces)] if header[2] else []
    return Source(data, coordinates, faces, normals)
