"""Parse points as text, one to a line: XYZ, and whatever has three or more columns of numbers."""

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files.source import Source
from jaxmark.files.text import Text, TextNumbers, blank, unix, without_comments


def parse(data: bytes) -> Source:
    """Read the first three numbers of each line, between spaces, commas or semicolons; other columns are left alone.

    A first line that holds only the number of points, one of names of columns after it, and what stands after `#` or
    `//` are passed over.

    Raises:
        JaxmarkError: if a line has fewer than three numbers; the message names the line.
    """
    work = blank(rb"[,;]", blank(rb"//[^\n\r]*", without_comments(unix(data))))
    text = Text(data, work)
    first, count = text.lines()
    if len(first) and count[0] == 1:
        first, count = first[1:], count[1:]
    if len(first) and not _begins_with_number(text.token(int(first[0]))):
        first, count = first[1:], count[1:]
    if not len(first):
        raise JaxmarkError("The file has no points: it needs a line with three numbers for each.")
    short = np.flatnonzero(count < 3)
    if len(short):
        raise text.error(text.starts[first[short[0]]], "a point needs three numbers")
    return Source(data, TextNumbers(text, first[:, None] + np.arange(3)), np.zeros((0, 3), np.int64))


def _begins_with_number(token: bytes) -> bool:
    try:
        float(token)
    except ValueError:
        return False
    return True
