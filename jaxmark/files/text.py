"""Read numbers of text files exactly, by their byte spans, and write them in the file's own style."""

import re
from functools import cached_property
from typing import NamedTuple, SupportsInt

import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files.source import Edits, Overlay, changed

# The bytes that bytes.split() takes for white space.
_SPACE = np.zeros(256, dtype=bool)
_SPACE[list(b" \t\n\r\v\f")] = True


def unix(data: bytes) -> bytes:
    """Convert the line ends of classic Mac files to line feeds, so that byte offsets stay."""
    return data if b"\n" in data else data.replace(b"\r", b"\n")


def blank(pattern: bytes, work: bytes) -> bytes:
    """Overwrite all matches of a pattern with as many spaces, so that byte offsets stay."""
    return re.sub(pattern, lambda match: b" " * len(match[0]), work)


def without_comments(work: bytes) -> bytes:
    """Overwrite everything from `#` to the end of the line with spaces."""
    return blank(rb"#[^\n\r]*", work) if b"#" in work else work


class Text:
    """A text file as tokens between white space.

    Attributes:
        starts, ends: the byte span of each token, ascending.
    """

    def __init__(self, data: bytes, work: bytes) -> None:
        """Tokenise.

        Args:
            data: the file's bytes.
            work: a copy of the same length, in which spaces stand for what is not to be read.
        """
        self._lines = unix(data)
        self.buffer = np.frombuffer(work + b"\n", np.uint8)
        space = _SPACE[self.buffer]
        edges = np.flatnonzero(space[1:] != space[:-1]) + 1
        if not space[0]:
            edges = np.concatenate([[0], edges])
        self.starts: Int64[np.ndarray, " tokens"] = edges[0::2]
        self.ends: Int64[np.ndarray, " tokens"] = edges[1::2]

    def __len__(self) -> int:
        return len(self.starts)

    def lines(self) -> tuple[Int64[np.ndarray, " lines"], Int64[np.ndarray, " lines"]]:
        """The first token and the number of tokens of every line that has any."""
        line = np.searchsorted(np.flatnonzero(self.buffer == ord("\n")), self.starts)
        first = np.flatnonzero(np.diff(line, prepend=-1))
        return first, np.diff(first, append=len(self))

    def token(self, index: int) -> bytes:
        """The bytes of one token."""
        return self.buffer[self.starts[index] : self.ends[index]].tobytes()

    def error(self, start: SupportsInt, what: str) -> JaxmarkError:
        """The exception for an error at a byte offset, whose line it names."""
        line = self._lines.count(b"\n", 0, int(start)) + 1
        return JaxmarkError(f"line {line}: {what}.")

    def seek(
        self, char: str, starts: Int64[np.ndarray, " spans"], ends: Int64[np.ndarray, " spans"]
    ) -> Int64[np.ndarray, " spans"]:
        """The offset of a character's first occurrence, in either case, in each span; the span's end if it has none."""
        low, high = (int(starts.min()), int(ends.max())) if len(starts) else (0, 0)  # a file may have many such parts
        part = self.buffer[low:high]
        hits = low + np.flatnonzero((part == ord(char.lower())) | (part == ord(char.upper())))
        found = np.append(hits, len(self.buffer))[np.searchsorted(hits, starts)]
        return np.minimum(found, ends)

    def _converted(self, kind: type, starts: Int64[np.ndarray, " spans"], ends: Int64[np.ndarray, " spans"]) -> list:
        """Convert the bytes of each span by `kind`; the spans ascend."""
        name = "whole number" if kind is int else "number"
        if len(starts) == 0:
            return []
        if (starts >= ends).any():
            raise self.error(starts[np.argmax(starts >= ends)], f"a {name} is missing")
        low, high = int(starts[0]), int(ends[-1]) + 1
        # With +1 where a span begins and -1 behind the byte that follows it, the running sum marks the bytes to keep.
        steps = np.zeros(high - low + 1, np.int8)
        steps[starts - low] += 1
        steps[ends - low + 1] -= 1
        kept = self.buffer[low:high][np.cumsum(steps[:-1], dtype=np.int8).view(bool)]
        kept[np.cumsum(ends - starts + 1) - 1] = ord(" ")
        numerals = kept.tobytes().split()
        try:
            if (kept == ord("_")).any():
                raise ValueError
            return list(map(kind, numerals))
        except ValueError:
            bad = next(index for index, numeral in enumerate(numerals) if not _is_numeral(kind, numeral))
            shown = numerals[bad][:40].decode("ascii", "backslashreplace")
            raise self.error(starts[bad], f"'{shown}' is not a {name}") from None

    def floats(
        self, starts: Int64[np.ndarray, " spans"], ends: Int64[np.ndarray, " spans"]
    ) -> Float64[np.ndarray, " spans"]:
        """The numbers in ascending spans, as Python's `float` reads them.

        Raises:
            JaxmarkError: if a span holds no number; the message names the line.
        """
        return np.array(self._converted(float, starts, ends), dtype=np.float64)

    def ints(
        self, starts: Int64[np.ndarray, " spans"], ends: Int64[np.ndarray, " spans"]
    ) -> Int64[np.ndarray, " spans"]:
        """The whole numbers in ascending spans.

        Raises:
            JaxmarkError: if a span holds no whole number, or one of more than 18 digits; the message names the line.
        """
        long = np.flatnonzero(ends - starts > 18)
        if len(long):
            raise self.error(starts[long[0]], "a whole number of more than 18 digits cannot be an index or a count")
        return np.array(self._converted(int, starts, ends), dtype=np.int64)


class Spans(Text):
    """A text file in which tokens are at known places, with anything between them."""

    def __init__(self, data: bytes, starts: Int64[np.ndarray, " tokens"], ends: Int64[np.ndarray, " tokens"]) -> None:
        """Take byte spans that ascend as the tokens."""
        self._lines = unix(data)
        self.buffer = np.frombuffer(data + b"\n", np.uint8)
        self.starts = starts
        self.ends = ends


class Style(NamedTuple):
    """The style in which a file writes its numbers."""

    exponent: Bool[np.ndarray, " numbers"]  # whether the old token has an exponent
    capital: Bool[np.ndarray, " numbers"]  # whether that exponent is written with a capital E
    decimals: int  # number of decimals of tokens without exponent
    mantissa: int  # number of decimals of tokens with exponent


class TextNumbers:
    """Triples of numbers in a text file; see `Numbers`."""

    values: Float64[np.ndarray, "rows 3"]

    def __init__(self, text: Text, tokens: Int64[np.ndarray, "rows 3"], *, whole: bool = False) -> None:
        """Read tokens as numbers.

        Args:
            text: the file.
            tokens: indices of the tokens, in any order.
            whole: whether the file declares the numbers to be integers, so that nothing else may be written.

        Raises:
            JaxmarkError: if a token is not a number; the message names the line.
        """
        self._text = text
        self._whole = whole
        flat = tokens.reshape(-1)
        self._starts = text.starts[flat]
        self._ends = text.ends[flat]
        order = np.argsort(flat, kind="stable")
        values = np.empty(len(flat))
        values[order] = text.floats(self._starts[order], self._ends[order])
        self.values = values.reshape(-1, 3)

    @cached_property
    def _style(self) -> Style:
        mark = self._text.seek("e", self._starts, self._ends)
        point = self._text.seek(".", self._starts, mark)
        exponent = mark < self._ends
        capital = self._text.buffer[mark] == ord("E")
        after = np.maximum(mark - point - 1, 0)
        if self._whole:
            return Style(np.zeros_like(exponent), capital, 0, 0)
        size = np.abs(np.nan_to_num(self.values.reshape(-1), posinf=0.0, neginf=0.0))
        if exponent.any() and not size[~exponent].any():
            exponent = np.ones_like(exponent)  # zeros without exponent tell nothing of the digits meant
        fixed = np.flatnonzero(~exponent)
        decimals = int(after[fixed].max(initial=0))
        mantissa = int(after[exponent].max(initial=0))
        if len(fixed) and exponent.any() and size[fixed].max() > 0:
            # Programs that write both forms (%g) strip trailing zeros: tokens without exponent tell the digits meant.
            numbers = fixed[size[fixed] > 0]
            mantissa = max(mantissa, int((np.floor(np.log10(size[numbers])) + after[numbers]).max()))
        largest = int(np.floor(np.log10(size.max()))) + 1 if size.max(initial=0) > 0 else 0
        return Style(exponent, capital, max(0, min(decimals, 17 - largest)), min(mantissa, 16))

    def edits(self, values: Float64[np.ndarray, "rows 3"]) -> list[Edits | Overlay]:
        """The edits of the tokens whose number changes by enough to be written differently."""
        style = self._style
        moved = np.flatnonzero(changed(self.values, values))
        new = values.reshape(-1)[moved]
        exponent = style.exponent[moved]
        tokens = np.empty(len(moved), dtype=object)
        tokens[~exponent] = _written(b"%%.%df " % style.decimals, new[~exponent])
        tokens[exponent] = _written(b"%%.%de " % style.mantissa, new[exponent])
        for index in np.flatnonzero(exponent & style.capital[moved]):
            tokens[index] = tokens[index].upper()
        read = np.array(list(map(float, tokens)), dtype=np.float64)
        for index in np.flatnonzero((read == 0) & np.signbit(read)):
            tokens[index] = tokens[index].lstrip(b"-")
        differs = read != self.values.reshape(-1)[moved]
        return [Edits(self._starts[moved[differs]], self._ends[moved[differs]], tokens[differs].tolist())]

    def spacing(self, values: Float64[np.ndarray, "rows 3"], rows: Int64[np.ndarray, " some"]) -> float:
        """The largest step of the last digit of numbers that change, or of double precision if that is larger."""
        style = self._style
        moved = changed(self.values[rows], values[rows]).reshape(-1)
        exponent = style.exponent.reshape(-1, 3)[rows].reshape(-1)
        size = np.abs(values[rows].reshape(-1))
        steps = [float(np.spacing(size.max(initial=0.0)))]
        if (moved & ~exponent).any():
            steps.append(10.0**-style.decimals)
        largest = size[moved & exponent].max(initial=0.0)
        if largest > 0:
            steps.append(float(10.0 ** (np.floor(np.log10(largest)) - style.mantissa)))
        return max(steps)

    def advice(self, step: float) -> str:
        """Advise how many decimals are enough."""
        if self._whole:
            return "declare its coordinates as float or double instead of integers"
        if step < np.spacing(np.abs(self.values).max()):
            return "even double precision is too coarse there, so centre the mesh on the origin"
        decimals = max(0, int(np.ceil(-np.log10(max(step, 1e-300)))))
        return f"write its coordinates with at least {decimals} decimals"


def _written(form: bytes, values: Float64[np.ndarray, " numbers"]) -> list[bytes]:
    """Format each value; one call for all of them is several times faster than one call each."""
    return (form * len(values) % tuple(values.tolist())).split()


def _is_numeral(kind: type, token: bytes) -> bool:
    try:
        kind(token)
    except ValueError:
        return False
    return b"_" not in token  # Python groups digits by underscores, no file format does
