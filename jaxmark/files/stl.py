"""Parse STL, binary and text: a triangle soup in which every facet has three vertices of its own."""

import re
import struct

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files.binary import BinaryNumbers
from jaxmark.files.source import Indices, PerFace, Source, ranges
from jaxmark.files.text import Text, TextNumbers, blank, unix

_FLOAT = (np.dtype("<f4"),) * 3
_VERTEX = (b"vertex", None, None, None)
_FACET = (b"facet", b"normal", None, None, None, b"outer", b"loop", *_VERTEX * 3, b"endloop", b"endfacet")

_STATEMENTS = {b"facet": 5, b"outer": 2, b"vertex": 4, b"endloop": 1, b"endfacet": 1}  # number of each one's tokens


def parse(data: bytes) -> Source:
    """Read a binary STL, which is recognised by its size, or else a text one, whose extra words are ignored.

    Raises:
        JaxmarkError: if the size fits no binary file and the text cannot be read; the message names the line.
    """
    # Binary files may begin with "solid", too; a text with just the size of a binary file is too unlikely to matter.
    facets = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else 0
    if len(data) == 84 + 50 * facets and len(data) >= 84:
        return _binary(data, facets)
    if re.match(rb"\s*solid\b", data, re.IGNORECASE):
        return _text(data)
    if len(data) < 84:
        raise JaxmarkError(f"byte {len(data)}: the file ends inside the header of a binary STL, which has 84 bytes.")
    raise JaxmarkError(
        f"byte 80: a binary STL with {facets} facets has {84 + 50 * facets} bytes, but the file has {len(data)}."
    )


def _binary(data: bytes, facets: int) -> Source:
    start = 84 + 50 * np.arange(facets)[:, None]
    vertices = (start + np.arange(12, 48, 4)).reshape(-1, 3)
    normals = PerFace(BinaryNumbers(data, start + np.arange(0, 12, 4), _FLOAT))
    return Source(data, BinaryNumbers(data, vertices, _FLOAT), np.arange(3 * facets).reshape(-1, 3), [normals])


def _fault(text: Text, tokens: Indices) -> JaxmarkError | None:
    """Find the first token that is not as in a list of facets; None if there is none."""
    facets, left = divmod(len(tokens), len(_FACET))
    rows = tokens[: len(tokens) - left].reshape(facets, len(_FACET))
    try:
        for column, word in enumerate(_FACET):
            if word is not None:
                expected = f"'{word.decode()}' is expected in facet {{}} (zero-based)"
                wrong = ~text.spells(rows[:, column], word, any_case=True)
                text.refuse(wrong, text.starts[rows[:, column]], expected.format)
    except JaxmarkError as error:
        return error
    return text.error(text.starts[-1], f"the file ends inside facet {facets} (zero-based)") if left else None


def _statements(text: Text) -> Indices:
    """Find the tokens of statements such as `vertex 0 0 1`, without the words between them, which slicers ignore."""
    every, sizes = np.arange(len(text)), np.zeros(len(text), np.int64)
    for word, size in _STATEMENTS.items():
        sizes[text.spells(every, word, any_case=True)] = size
    starts = np.flatnonzero(sizes)
    tokens = ranges(starts, sizes[starts])
    return tokens[tokens < len(text)]


def _text(data: bytes) -> Source:
    # Names of solids may hold any words, so the lines that begin and end a solid are not read at all.
    text = Text(data, blank(rb"(?i)(?<!\S)(?:end)?solid(?!\S)[^\n\r]*", unix(data)))
    tokens = np.arange(len(text))
    if _fault(text, tokens) is not None:
        stated = _statements(text)
        if (np.diff(stated) > 0).all() and _fault(text, stated) is None:  # a number that is missing makes two overlap
            tokens = stated
    if (fault := _fault(text, tokens)) is not None:
        raise fault
    facets = len(tokens) // len(_FACET)
    tokens = tokens.reshape(facets, len(_FACET))
    vertices = tokens[:, [8, 9, 10, 12, 13, 14, 16, 17, 18]].reshape(-1, 3)
    normals = PerFace(TextNumbers(text, tokens[:, 2:5]))
    return Source(data, TextNumbers(text, vertices), np.arange(3 * facets).reshape(-1, 3), [normals])
