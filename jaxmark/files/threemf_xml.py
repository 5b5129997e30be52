"""Read the XML in a 3MF file: the places of the numbers of meshes in its bytes, and relations of its members."""

import re
from typing import NamedTuple
from xml.parsers import expat

import numpy as np
from jaxtyping import Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files.limits import RunningCount
from jaxmark.files.text import line_error

_ENCODINGS = ("utf-8", "utf8", "us-ascii", "ascii")
_COLUMNS = {"vertices": (b"x", b"y", b"z"), "triangles": (b"v1", b"v2", b"v3")}
_ROWS = {"vertices": "vertex", "triangles": "triangle"}
# The start tag of a list, or the beginning of something in which there are no tags.
_MARKUP = re.compile(rb"<(?:!--|!\[CDATA\[|\?|!|(?:[\w.-]+:)?(?:vertices|triangles)(?=[\s/>])[^<>]*>)")
_CLOSING = {b"<!--": b"-->", b"<![CDATA[": b"]]>", b"<?": b"?>"}
_TAG = re.compile(rb"<[^\s/>]+")
_ATTRIBUTE = re.compile(rb"""\s+([^\s=]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_WORD, _VALUE = (
    rb"%(quote)s[^%(quote)s<&\x00-\x20\x7f-\xff]*+%(quote)s",
    rb"%(quote)s[^%(quote)s<&\x00-\x1f\x7f-\xff]*+%(quote)s",
)
_FIRST_QUOTE = re.compile(rb"""\s*+<[^<>=]*+=(["'])""")
# Possessive, so that nothing is tried twice. Comments, both quotes in one list and the like are left to the parser.
_PLAIN = (
    rb"(?:\s*+<%(row)s\s++%(first)s=%(word)s\s++%(second)s=%(word)s\s++%(third)s=%(word)s"
    rb"(?:\s++(?!xmlns|(?:%(first)s|%(second)s|%(third)s)=)[A-Za-z_][\w.:-]*+=%(value)s)*+"
    rb"\s*+(?:/>|>\s*+</%(row)s>))*+\s*+"
)
_MAX_NAME = 200
_BLOCK = 2**20  # bytes that are parsed at once
_MAX_TOKEN = 2**22  # bytes of a tag or comment, all of which is in memory when it is handled


Triples = Int64[np.ndarray, "rows 3 2"]  # first byte and end of the three numbers in each element of a list
NO_TRIPLES: Triples = np.zeros((0, 3, 2), np.int64)


class RawMesh(NamedTuple):
    """A mesh whose numbers are not read yet."""

    name: str
    lists: dict[str, Triples]  # vertices and triangles, as far as they are there


class _Parser:
    """An XML parser of some data that knows its byte offsets, also if bytes are skipped, and namespaces.

    The parser of the library joins the whole address of a namespace to the name of each element and attribute in it,
    which takes hours for a long address. So namespaces are numbered here instead: 0 is none.
    """

    def __init__(self, data: bytes) -> None:
        self.data, self.skipped, self._fed = data, 0, 0
        self._spaces = {"": 0}  # numbers of namespaces, by address
        self._scopes: dict[str, list[int]] = {}  # by prefix, those that open elements gave it; the last one counts
        self._declared = list[list[str]]()  # the prefixes that each open element declares
        self.expat = expat.ParserCreate("utf-8")
        self.expat.StartDoctypeDeclHandler = self._doctype
        self.expat.XmlDeclHandler = self._declaration
        if b"\0" in data[:4] or data[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise _not_utf8("UTF-16")

    @property
    def at(self) -> int:
        """The byte offset of the element that is being handled."""
        return self.expat.CurrentByteIndex + self.skipped

    def feed(self, start: int, end: int, *, final: bool) -> None:
        """Parse some bytes."""
        try:
            for at in range(start, end, _BLOCK):
                stop = min(at + _BLOCK, end)
                self.expat.Parse(self.data[at:stop], False)
                self._fed += stop - at
                if self._fed - self.expat.CurrentByteIndex > _MAX_TOKEN:
                    raise self.error(self.at, f"a tag or comment has more than {_MAX_TOKEN} bytes; shorten it")
            if final:
                self.expat.Parse(b"", True)
        except expat.ExpatError as error:
            at = max(0, self.expat.ErrorByteIndex + self.skipped)
            raise self.error(at, f"the XML is broken ({expat.ErrorString(error.code)})") from None

    def enter(self, name: str, attributes: dict[str, str]) -> tuple[int, str]:
        """Return the namespace of an element that begins, and its local name."""
        prefixes = [one for one in attributes if one == "xmlns" or one.startswith("xmlns:")]
        for one in prefixes:
            number = self._spaces.setdefault(attributes[one], len(self._spaces))
            self._scopes.setdefault(one[len("xmlns:") :], []).append(number)
        self._declared.append(prefixes)
        prefix, _, local = name.rpartition(":")
        scope = self._scopes.get(prefix)
        if prefix and not scope:
            raise self.error(self.at, f"the namespace {prefix[:40]!a} is not declared")
        return scope[-1] if scope else 0, local

    def leave(self) -> None:
        """End an element, and forget the namespaces that it declared."""
        for one in self._declared.pop():
            self._scopes[one[len("xmlns:") :]].pop()

    def error(self, at: int, what: str) -> JaxmarkError:
        """Make the exception for an error at a byte offset."""
        return line_error(self.data, at, what)

    def _doctype(self, *_: object) -> None:
        raise JaxmarkError("The XML has a document type, which may define entities without end; remove it.")

    def _declaration(self, version: str, encoding: str | None, standalone: int) -> None:
        if encoding is not None and encoding.lower() not in _ENCODINGS:
            raise _not_utf8(encoding)


def _not_utf8(encoding: str) -> JaxmarkError:
    return JaxmarkError(f"The XML is encoded in {encoding!a}; only UTF-8 is supported, so save it as that.")


def read_relationships(data: bytes, elements: RunningCount) -> list[tuple[str, str]]:
    """Read the type and the target of each relationship that a `.rels` member states, and count its elements."""
    found: list[tuple[str, str]] = []

    def start(name: str, attributes: dict[str, str]) -> None:
        elements.add()
        if name.rpartition(":")[2] == "Relationship":
            found.append((attributes.get("Type", ""), attributes.get("Target", "")))

    parser = _Parser(data)
    parser.expat.StartElementHandler = start
    parser.feed(0, len(data), final=True)
    return found


class Model(_Parser):
    """The meshes of objects in a model; refused if an element lacks one of its three numbers.

    Lists of vertices and triangles that are written as nearly all programs do are not shown to the parser: a regular
    expression checks that there is nothing else in them, which is many times faster. Other elements, comments, sections
    of text (CDATA), processing instructions and meshes are counted.
    """

    def __init__(self, data: bytes, elements: RunningCount, meshes: RunningCount) -> None:
        super().__init__(data)
        self._count_element, self._count_mesh = elements.add, meshes.add
        self.meshes: list[RawMesh] = []
        self._buffer = np.frombuffer(data, np.uint8)
        self._space: int | None = None  # the namespace of the root
        self._path: list[str] = []  # local names of the open elements, empty where they are of another namespace
        self._name = ""  # of the object that was opened last
        self._list: str | None = None  # which list is open
        self._list_at = -1  # the offset of its start tag, while nothing was seen in it
        self._rows: list[int] = []  # offsets of its elements
        self._prefix: bytes | None = None  # of the first list, to read others like it
        self.expat.StartElementHandler = self._start
        self.expat.EndElementHandler = self._end
        at = fed = 0
        while (found := _MARKUP.search(data, at)) is not None and found[0] != b"<!":  # a document type is refused
            at = found.end()
            if found[0] in _CLOSING:  # is not parsed up to a list in it: the parser would begin again at each of them
                self._count_element()
                at = data.find(_CLOSING[found[0]], at)
                if at < 0:
                    break
                continue
            self.feed(fed, at, final=False)
            # No list of a mesh was opened if this element is somewhere else.
            if self._list is not None and self._list_at == found.start():
                end = self._read_plain(self._list, at)
                self.skipped += end - at
                at = end
            fed = at
        self.feed(fed, len(data), final=True)

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._count_element()
        space, local = self.enter(name, attributes)
        if self._space is None:
            self._space = space
        self._path.append(local if space == self._space else "")
        self._list_at = -1
        if self._list is not None:
            if self._path[-2:] == [self._list, _ROWS[self._list]]:
                self._rows.append(self.at)
        elif self._path[-1] == "object":
            words = " ".join(attributes.get("name", "")[:_MAX_NAME].split())
            self._name = words or f"object {' '.join(attributes.get('id', '?')[:_MAX_NAME].split())}"
        elif self._path[-2:] == ["object", "mesh"]:
            self._count_mesh()
            self.meshes.append(RawMesh(self._name, {}))
        elif self._path[-1] in _ROWS and self._path[-3:-1] == ["object", "mesh"]:
            self._list = self._path[-1]
            self._list_at = self.at
            self._rows = []
            if self._list in self.meshes[-1].lists:
                raise self.error(self._list_at, f"a mesh has its {self._list} twice")

    def _end(self, name: str) -> None:
        self.leave()
        closed = self._path.pop()
        self._list_at = -1
        if self._list is not None and closed == self._list and self._path[-1:] == ["mesh"]:
            self.meshes[-1].lists.setdefault(self._list, self._read_rows(self._list))
            self._list = None

    def _read_plain(self, kind: str, start: int) -> int:
        """Read a list that begins at an offset, if it is written plainly; returns where parsing goes on."""
        opened = _TAG.match(self.data, self._list_at)
        assert opened is not None, "the parser found a tag here"
        prefix = opened[0][1 : -len(kind)]
        if self._prefix not in (None, prefix):  # an expression for each prefix would take long
            return start
        self._prefix = prefix
        columns = dict(zip((b"first", b"second", b"third"), _COLUMNS[kind], strict=True))
        row = re.escape(prefix + _ROWS[kind].encode())
        first = _FIRST_QUOTE.match(self.data, start)
        quote = b'"' if first is None else first[1]
        word, value = (form % {b"quote": quote} for form in (_WORD, _VALUE))
        plain = re.compile(_PLAIN % {b"row": row, b"word": word, b"value": value, **columns})
        matched = plain.match(self.data, start)
        if matched is None or not self.data.startswith(b"</" + opened[0][1:], matched.end()):
            return start
        quotes = start + np.flatnonzero(self._buffer[start : matched.end()] == ord(quote))
        opening, closing = quotes[::2], quotes[1::2]
        spans = NO_TRIPLES
        for column, name in enumerate(_COLUMNS[kind]):
            mine = np.ones(len(opening), bool)
            for back, char in enumerate(reversed(name + b"="), 1):
                mine &= self._buffer[opening - back] == char
            # No other attribute ends so, except behind a colon or in a longer word.
            mine &= self._buffer[opening - len(name) - 2] <= ord(" ")
            if column == 0:
                spans = np.empty((int(mine.sum()), 3, 2), np.int64)
            spans[:, column, 0], spans[:, column, 1] = opening[mine] + 1, closing[mine]
        self.meshes[-1].lists[kind] = spans
        return matched.end()

    def _read_rows(self, kind: str) -> Triples:
        """Read a list element by element."""
        spans = np.zeros((len(self._rows), 3, 2), np.int64)
        for row, at in enumerate(self._rows):
            tag = _TAG.match(self.data, at)
            attributes = {}
            while tag is not None:
                tag = _ATTRIBUTE.match(self.data, tag.end())
                if tag is not None:
                    attributes[tag[1]] = tag.span(2 if tag[3] is None else 3)
            for column, name in enumerate(_COLUMNS[kind]):
                if name not in attributes:
                    raise self.error(at, f"a {_ROWS[kind]} has no {name.decode()}")
                start, end = attributes[name]
                value = self.data[start:end]
                if len(value.split()) > 1:
                    shown = value[:40].decode("ascii", "backslashreplace")
                    raise self.error(start, f"{shown!r} is not a number")
                spans[row, column] = end - len(value.lstrip()), start + len(value.rstrip())
        return spans
