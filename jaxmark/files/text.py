"""Read numbers of text files exactly, by their byte spans, and write them in the file's own style."""

import re
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple, SupportsInt

import numpy as np
from jaxtyping import Bool, Int64, Shaped

from jaxmark.errors import JaxmarkError
from jaxmark.files.binary import INTEGER_ADVICE
from jaxmark.files.source import Changes, Edits, Indices, Rows, SomeRows, changed

# The bytes that bytes.split() takes for white space.
_SPACE = np.zeros(256, dtype=bool)
_SPACE[list(b" \t\n\r\v\f")] = True
_NAMES = {int: "whole number", float: "number"}
_BLOCK = 2**18  # numbers that are converted at once


def unix(data: bytes) -> bytes:
    """Convert the line ends of classic Mac files to line feeds, so that byte offsets stay."""
    return data if b"\n" in data else data.replace(b"\r", b"\n")


def blank(pattern: bytes, work: bytes) -> bytes:
    """Overwrite all matches of a pattern with as many spaces, so that byte offsets stay."""
    return re.sub(pattern, lambda match: b" " * len(match[0]), work)


def without_comments(work: bytes) -> bytes:
    """Overwrite everything from `#` to the end of the line with spaces."""
    return blank(rb"#[^\n\r]*", work) if b"#" in work else work


class Lines(NamedTuple):
    """Lines of a text that have any tokens."""

    first: Indices  # the first token of each
    sizes: Indices  # the number of its tokens


class Text:
    """A text file as tokens between white space.

    Attributes:
        starts, ends: the byte span of each token.
    """

    def __init__(self, data: bytes, work: bytes) -> None:
        """Tokenise a copy of the file's bytes, of the same length, in which spaces stand for ignored text."""
        self._lines = unix(data)
        self.buffer = np.frombuffer(work + b"\n", np.uint8)
        space = _SPACE[self.buffer]
        edges = np.flatnonzero(np.diff(space, prepend=True))
        self.starts: Indices = edges[0::2]
        self.ends: Indices = edges[1::2]

    def __len__(self) -> int:
        return len(self.starts)

    def lines(self) -> Lines:
        """Find the lines that have any tokens."""
        line = np.searchsorted(np.flatnonzero(self.buffer == ord("\n")), self.starts)
        first = np.flatnonzero(np.diff(line, prepend=-1))
        return Lines(first, np.diff(first, append=len(self)))

    def spells(self, tokens: Indices, word: bytes, *, any_case: bool = False) -> Bool[np.ndarray, " tokens"]:
        """Return the mask of the tokens that are a word, which is in lower case if case does not matter."""
        match = self.ends[tokens] - self.starts[tokens] == len(word)
        for index, char in enumerate(word):
            # Offsets are clamped, as a last token that is shorter than the word would be read past the buffer's end.
            found = self.buffer[np.minimum(self.starts[tokens] + index, len(self.buffer) - 1)]
            match &= (found | 0x20 if any_case else found) == char
        return match

    def token(self, index: int) -> bytes:
        """Return the bytes of one token."""
        return self.buffer[self.starts[index] : self.ends[index]].tobytes()

    def error(self, start: SupportsInt, what: str) -> JaxmarkError:
        """Make the exception for an error at a byte offset, whose line it names."""
        return line_error(self._lines, int(start), what)

    def refuse(self, wrong: Bool[np.ndarray, " spans"], starts: Indices, what: str | Callable[[int], str]) -> None:
        """Refuse the first of some spans that is wrong; the message, which may depend on its number, names the line."""
        if wrong.any():
            bad = int(np.argmax(wrong))
            raise self.error(starts[bad], what if isinstance(what, str) else what(bad))

    def triples(self, lines: Lines, skip: int, what: str) -> "TextNumbers":
        """Read the three numbers of each line that follow `skip` tokens; a line of fewer is refused by `what`."""
        self.refuse(lines.sizes < skip + 3, self.starts[lines.first], what)
        return TextNumbers(self, lines.first[:, None] + np.arange(skip, skip + 3))

    def seek(self, char: str, starts: Indices, ends: Indices) -> Indices:
        """Find a character's first occurrence, in either case, in each span; the span's end if it has none."""
        low, high = (int(starts.min()), int(ends.max())) if len(starts) else (0, 0)  # a file may have many such parts
        part = self.buffer[low:high]
        hits = low + np.flatnonzero((part == ord(char.lower())) | (part == ord(char.upper())))
        found = np.append(hits, len(self.buffer))[np.searchsorted(hits, starts)]
        return np.minimum(found, ends)

    def ints(self, starts: Indices, ends: Indices) -> Int64[np.ndarray, " spans"]:
        """Read the whole numbers in ascending byte spans; see `read`."""
        return self._converted(int, starts, ends)

    def read(self, tokens: Int64[np.ndarray, "..."], kind: type) -> Shaped[np.ndarray, "..."]:
        """Read tokens, in any order, as numbers: `float`, exactly, or `int`, of up to 18 digits."""
        return self.read_spans(self.starts[tokens.ravel()], self.ends[tokens.ravel()], kind).reshape(tokens.shape)

    def read_spans(self, starts: Indices, ends: Indices, kind: type) -> Shaped[np.ndarray, " spans"]:
        """Read byte spans, in any order, as numbers; see `read`."""
        if (starts[:-1] <= starts[1:]).all():
            return self._converted(kind, starts, ends)
        order = np.argsort(starts, kind="stable")
        values = np.empty(len(starts), kind)
        values[order] = self._converted(kind, starts[order], ends[order])
        return values

    def _converted(self, kind: type, starts: Indices, ends: Indices) -> Shaped[np.ndarray, " spans"]:
        """Convert the bytes of each span by `kind`; the spans ascend."""
        if kind is int:
            too_long = "a whole number of more than 18 digits cannot be an index or a count"
            self.refuse(ends - starts > 18, starts, too_long)
        self.refuse(starts >= ends, starts, f"a {_NAMES[kind]} is missing")
        values = np.empty(len(starts), np.dtype(kind))
        for at in range(0, len(starts), _BLOCK):
            block = slice(at, at + _BLOCK)
            values[block] = self._converted_block(kind, starts[block], ends[block])
        return values

    def _converted_block(self, kind: type, starts: Indices, ends: Indices) -> list:
        """Convert some spans; Python's numbers take ten times the memory of the file, so there are not all of them."""
        low, high = int(starts[0]), int(ends[-1]) + 1
        # With +1 where a span begins and -1 behind the byte that follows it, the running sum marks the bytes to keep.
        steps = np.zeros(high - low + 1, np.int8)
        steps[starts - low] += 1
        steps[ends - low + 1] -= 1
        kept = self.buffer[low:high][np.cumsum(steps[:-1], dtype=np.int8).view(bool)]
        kept[np.cumsum(ends - starts + 1) - 1] = ord(" ")
        numerals = kept.tobytes().split()
        try:
            if (kept == ord("_")).any():  # Python groups digits by underscores, no file format does
                raise ValueError
            return list(map(kind, numerals))
        except ValueError:
            bad = next(k for k, numeral in enumerate(numerals) if b"_" in numeral or not is_numeral(kind, numeral))
            shown = numerals[bad][:40].decode("ascii", "backslashreplace")
            raise self.error(starts[bad], f"'{shown}' is not a {_NAMES[kind]}") from None


class Spans(Text):
    """A text file in which tokens are at known places, with anything between them."""

    def __init__(self, data: bytes, starts: Indices, ends: Indices) -> None:
        """Take byte spans, in any order."""
        self._lines = unix(data)
        self.buffer = np.frombuffer(data + b"\n", np.uint8)
        self.starts, self.ends = starts, ends


class Style(NamedTuple):
    """The style in which a file writes its numbers."""

    exponent: Bool[np.ndarray, " numbers"]  # whether the old token has an exponent
    capital: Bool[np.ndarray, " numbers"]  # whether that exponent is written with a capital E
    decimals: int  # number of decimals of tokens without exponent
    mantissa: int  # number of decimals of tokens with exponent


class TextNumbers:
    """Triples of numbers in a text file; see `Numbers`."""

    values: Rows

    def __init__(self, text: Text, tokens: Int64[np.ndarray, "rows 3"], *, whole: bool = False) -> None:
        """Read tokens of a text, in any order; if the file declares `whole` numbers, no others may be written."""
        self._text, self._whole = text, whole
        self._starts, self._ends = text.starts[tokens.ravel()], text.ends[tokens.ravel()]
        self.values = text.read_spans(self._starts, self._ends, float).reshape(-1, 3)

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

    def edits(self, values: Rows) -> Changes:
        """Return the edits of the tokens whose number changes by enough to be written differently."""
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

    def rounded(self, values: Rows, rows: Indices) -> SomeRows:
        """Return the numbers of some rows as they are read back once they are written, up to the last bit."""
        style, result = self._style, self.values[rows]
        moved = changed(result, values[rows])
        new, exponent = values[rows][moved], style.exponent.reshape(-1, 3)[rows][moved]
        with np.errstate(divide="ignore"):
            digits = np.where(exponent, style.mantissa - np.floor(np.log10(np.abs(new))), style.decimals)
        unit = 10.0 ** -np.clip(digits, -300, 300)
        # Larger numbers have no more digits than are written.
        result[moved] = np.where(np.abs(new) < 2.0**53 * unit, np.rint(new / unit) * unit, new)
        return result

    def spacing(self, values: Rows, rows: Indices) -> float:
        """Return the largest step of the last digit of numbers that change, or that of double precision if larger."""
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
            return INTEGER_ADVICE
        if step < np.spacing(np.abs(self.values).max()):
            return "even double precision is too coarse there, so centre the mesh on the origin"
        decimals = max(0, int(np.ceil(-np.log10(max(step, 1e-300)))))
        return f"write its coordinates with at least {decimals} decimals"


def _written(form: bytes, values: np.ndarray) -> list[bytes]:
    """Format each value; one call for all of them is several times faster than one call each."""
    return (form * len(values) % tuple(values.tolist())).split()


def is_numeral(kind: type, token: bytes) -> bool:
    """Whether Python reads a token as a number of this kind."""
    try:
        kind(token)
    except ValueError:
        return False
    return True


def line_error(data: bytes, start: int, what: str) -> JaxmarkError:
    """Make the exception for an error at a byte offset, whose line it names."""
    line = data.count(b"\n", 0, start) + 1
    return JaxmarkError(f"line {line}: {what}.")
