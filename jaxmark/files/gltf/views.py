"""Replace the bytes of buffer views, while all other views keep theirs."""

from collections.abc import Iterator, Sequence
from typing import Any

# The extensions that compress a buffer view as a whole.
_COMPRESSED = ("EXT_meshopt_compression", "KHR_meshopt_compression")


def compression(view: dict[str, Any]) -> dict[str, Any] | None:
    """Return the extension that says where a buffer view lies compressed; None if it is not compressed."""
    extensions = view.get("extensions")
    if not isinstance(extensions, dict):
        return None
    found = next((extensions[name] for name in _COMPRESSED if name in extensions), None)
    return found if found is None or isinstance(found, dict) else {}


def is_alone(document: dict[str, Any], mine: dict[str, Any]) -> bool:
    """Whether no other place in the buffers overlaps this one, which is a view or the extension of a view."""
    begin = mine.get("byteOffset", 0)
    return not any(
        other is not mine
        and other["buffer"] == mine["buffer"]
        and other.get("byteOffset", 0) < begin + mine["byteLength"]
        and begin < other.get("byteOffset", 0) + other["byteLength"]
        for other in _stored(document["bufferViews"])
    )


def replace(
    document: dict[str, Any], contents: list[bytes | None], mine: dict[str, Any], data: bytes, *, alone: bool
) -> int:
    """Write data instead of the bytes at a place in a buffer, or behind the buffer if it is not alone there.

    Returns the offset of the data, a multiple of four. The places of later views are updated, `mine` is not.
    """
    buffer = mine["buffer"]
    content = contents[buffer] or b""
    begin, length = (mine.get("byteOffset", 0), mine["byteLength"]) if alone else (len(content), 0)
    added = bytes(-begin % 4) + data
    added += bytes((length - len(added)) % 4 if begin + length < len(content) else 0)  # later views stay aligned
    contents[buffer] = content[:begin] + added + content[begin + length :]
    for other in _stored(document["bufferViews"]):
        if other["buffer"] == buffer and other.get("byteOffset", 0) >= begin + length and length:
            other["byteOffset"] += len(added) - length
    return begin + -begin % 4


def _stored(views: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield every place in a buffer: each view, and the source of each view that is compressed as a whole."""
    for view in views:
        extensions = view.get("extensions")
        places = [view, *(extensions.values() if isinstance(extensions, dict) else ())]
        yield from (one for one in places if isinstance(one, dict) and _is_place(one))


def _is_place(one: dict[str, Any]) -> bool:
    stated = (one.get("buffer"), one.get("byteOffset", 0), one.get("byteLength"))
    return all(isinstance(number, int) for number in stated)
