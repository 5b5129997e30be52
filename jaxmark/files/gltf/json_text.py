"""Change values in JSON text, and leave all other characters as they are."""

import json
import re
from typing import Any

_SPACE = re.compile(r"[ \t\n\r]*")
_decode = json.JSONDecoder().raw_decode


def rewrite(text: str, new: Any) -> str:
    """Write a document over the JSON text of another one, in which only the values that differ change."""
    at = _skip(text, 0)
    old, end = _decode(text, at)
    pieces: list[str] = [text[:at]]
    _write(text, at, end, old, new, pieces)
    return "".join([*pieces, text[end:]])


def _write(text: str, at: int, end: int, old: Any, new: Any, pieces: list[str]) -> None:
    """Append the text of a value that stands in [at, end) and shall become another one."""
    if _same(old, new):
        pieces.append(text[at:end])
        return
    longer = isinstance(old, list) and isinstance(new, list) and len(new) >= len(old) > 0
    if longer or (isinstance(old, dict) and isinstance(new, dict) and old.keys() == new.keys()):
        for key, begin, stop in _members(text, at):
            pieces.append(text[at:begin])
            _write(text, begin, stop, old[key], new[key], pieces)
            at = stop
        pieces += ("," + _dump(item) for item in new[len(old) :]) if longer else ()
        pieces.append(text[at:end])
        return
    pieces.append(_dump(new))


def _same(old: Any, new: Any) -> bool:
    """Whether two values are the same in JSON, where true is no number."""
    return old is new or (type(old) is type(new) and old == new)


def _dump(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))


def _skip(text: str, at: int) -> int:
    """Return the index of the next character that is not white space."""
    match = _SPACE.match(text, at)
    return at if match is None else match.end()


def _members(text: str, at: int) -> list[tuple[Any, int, int]]:
    """Return the keys or numbers of the values of the object or list that begins at `at`, and their spans.

    The last of equal keys counts, as it does for readers of the document.
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
