"""Change values in JSON text, and leave all other characters as they are."""

import json
import re
from typing import Any

_SPACE = re.compile(r"[ \t\n\r]*")
_decode = json.JSONDecoder().raw_decode


def rewrite(text: str, new: Any) -> str:
    """Write a document over the text of another one, in which only what differs is written anew.

    Args:
        text: valid JSON, perhaps with white space around it.
        new: the document that it shall say.
    """
    at = _skip(text, 0)
    pieces: list[str] = [text[:at]]
    old, end = _decode(text, at)
    _write(text, at, end, old, new, pieces)
    pieces.append(text[end:])
    return "".join(pieces)


def _write(text: str, at: int, end: int, old: Any, new: Any, pieces: list[str]) -> None:
    """Append the text of a value that stands in [at, end) and shall become another one."""
    if _same(old, new):
        pieces.append(text[at:end])
        return
    alike = type(old) is type(new) and len(old) == len(new) if isinstance(old, dict | list) else False
    if alike and (isinstance(old, list) or old.keys() == new.keys()):
        for key, begin, stop in _members(text, at):
            pieces.append(text[at:begin])
            _write(text, begin, stop, old[key], new[key], pieces)
            at = stop
        pieces.append(text[at:end])
        return
    if isinstance(old, list) and isinstance(new, list) and len(new) > len(old) > 0:  # some were appended
        last = at
        for key, begin, stop in _members(text, at):
            pieces.append(text[last:begin])
            _write(text, begin, stop, old[key], new[key], pieces)
            last = stop
        pieces += ("," + _dump(item) for item in new[len(old) :])
        pieces.append(text[last:end])
        return
    pieces.append(_dump(new))


def _same(old: Any, new: Any) -> bool:
    """Whether two values are the same in JSON, where true is no number."""
    return old is new or (type(old) is type(new) and old == new)


def _dump(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


def _skip(text: str, at: int) -> int:
    """The index of the next character that is not white space."""
    match = _SPACE.match(text, at)
    return at if match is None else match.end()


def _members(text: str, at: int) -> list[tuple[Any, int, int]]:
    """The keys or numbers of the values of the object or list that begins at `at`, and their spans.

    The last of equal keys counts, as it does for who reads the document.
    """
    keyed = text[at] == "{"
    found: dict[Any, tuple[int, int]] = {}
    at = _skip(text, at + 1)
    while text[at] not in "}]":
        key: Any = len(found)
        if keyed:
            key, at = _decode(text, at)
            at = _skip(text, _skip(text, at) + 1)  # past the colon
        _, end = _decode(text, at)
        found.pop(key, None)
        found[key] = (at, end)
        at = _skip(text, end)
        if text[at] == ",":
            at = _skip(text, at + 1)
    return [(key, *span) for key, span in found.items()]
