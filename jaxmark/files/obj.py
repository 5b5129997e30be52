"""Parse Wavefront OBJ."""

import re
from codecs import BOM_UTF8
from collections.abc import Sequence

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits
from jaxmark.files.source import Faces, Indices, Part, Source, Texture, Transported, fan, linked, ranges, unique_names
from jaxmark.files.text import Lines, Text, unix, without_comments

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
    lines = text.lines()

    def beginning(word: bytes) -> Lines:
        return Lines(*(column[text.spells(lines.first, word)] for column in lines))

    vertices, normals, polygons, objects = (beginning(word) for word in (b"v", b"vn", b"f", b"o"))
    sizes = polygons.sizes - 1
    few = "a face needs at least three corners, this one has {}"
    text.refuse(sizes < 3, text.starts[polygons.first], lambda bad: few.format(sizes[bad]))
    coordinates = text.triples(vertices, 1, "a vertex needs three numbers")
    corners, triangles = ranges(polygons.first + 1, sizes), fan(sizes)
    starts, ends = text.starts[corners], text.ends[corners]
    slash = text.seek("/", starts, ends)
    second = text.seek("/", np.minimum(slash + 1, ends), ends)

    def referred(to: Lines, starts: Indices, ends: Indices, named: Indices | slice) -> Indices:
        """Find the lines that corners name at byte spans, counted from 0; -1 if there is no such line."""
        index = text.ints(starts[named], ends[named])  # from 1 or, if negative, back from the face
        before = np.repeat(np.searchsorted(to.first, polygons.first), sizes)[named]
        found = np.full(len(starts), -1)
        found[named] = np.where(index < 0, index + before, index - 1)
        return np.where((found < 0) | (found >= len(to.first)), -1, found)

    def absent(corner: int) -> str:
        token = text.token(int(corners[corner]))[:40].decode("ascii", "backslashreplace")
        return (
            f"the face corner '{token}' refers to a vertex that is not there; the file has {len(vertices.first)}"
            " vertices, numbered from 1"
        )

    def texture() -> Texture:
        pairs = beginning(b"vt")
        if not len(pairs.first) or (pairs.sizes < 3).any():
            return None
        try:
            values = text.read(pairs.first[:, None] + np.arange(1, 3), float)
            used = referred(pairs, slash + 1, second, np.flatnonzero(slash + 1 < second))
        except JaxmarkError:  # a wrong texture is no reason to refuse the file
            return None
        return np.where(used[:, None] >= 0, values[used], np.nan)[triangles]

    index = referred(vertices, starts, slash, slice(None))
    text.refuse(index < 0, starts, absent)
    source = Source(data, coordinates, index[triangles], texture=texture)
    limits.MESHES.check(len(objects.first), len(data))
    if len(objects.first) > 1:
        owner = np.repeat(np.searchsorted(objects.first, polygons.first), sizes - 2)  # 0 before the first object
        source.parts = _objects(text, source.faces, owner, objects.first, len(vertices.first))
    if len(normals.first):
        numbers = text.triples(normals, 1, "a normal needs three numbers")
        # A wrong index of a normal is no reason to refuse the file.
        used = referred(normals, second + 1, ends, np.flatnonzero(second + 1 < ends))
        source.normals = [Transported(numbers, used[triangles])]
    return source


def _objects(text: Text, faces: Faces, owner: Indices, objects: Indices, size: int) -> Sequence[Part]:
    """Find the objects of a file, those together that share vertices; none if that leaves fewer than two.

    `owner` is the number of the object that each face is in, from 1, and `size` the number of vertices.
    """
    count = len(objects) + 1
    group = linked(np.repeat(owner, 3), count + faces.ravel(), count + size)[owner]
    _, inverse, sizes = np.unique(group, return_inverse=True, return_counts=True)
    if len(sizes) < 2:
        return ()
    members = np.split(np.argsort(inverse, kind="stable"), np.cumsum(sizes)[:-1])
    names = unique_names(_name(text, objects, int(owner[rows[0]])) for rows in members)
    parts = []
    for name, rows in zip(names, members, strict=True):
        places, local = np.unique(faces[rows], return_inverse=True)
        parts.append(Part(name, places, local.reshape(-1, 3)))
    return sorted(parts, key=lambda part: int(part.places[0]))


def _name(text: Text, objects: Indices, number: int) -> str:
    """Return the name of an object, which follows on its line."""
    if number == 0:
        return "object 0"
    begin = int(text.ends[objects[number - 1]])
    line = text.buffer[begin : begin + _MAX_NAME].tobytes().splitlines()
    return (line[0].strip().decode("utf-8", "replace") if line else "") or f"object {number}"
