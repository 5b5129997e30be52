"""Text that people type, paste or export: decoded from UTF-8, and equal wherever it looks the same."""

import re
import tomllib
import unicodedata
from collections.abc import Collection, Iterable, Mapping
from typing import Any, TypeVar

from jaxmark.errors import JaxmarkError

Item = TypeVar("Item")

# The characters that Unicode calls default ignorable, which no program shows, without the two joiners.
_INVISIBLE = re.compile(
    "[\u00ad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f\u200b\u200e\u200f\u202a-\u202e\u2060-\u206f\u3164"
    "\ufe00-\ufe0f\ufeff\uffa0\ufff0-\ufff8\U0001bca0-\U0001bca3\U0001d173-\U0001d17a\U000e0000-\U000e0fff]"
)
_SPACE = re.compile("[\u00a0\u1680\u2000-\u200a\u202f\u205f\u3000]")  # Unicode's spaces, which look like one
# Joiners change the letters beside them in Persian, Indic scripts and emoji, but not in Latin script or at an end.
_USELESS_JOINER = re.compile("(?<![\u0300-\U0010ffff])[\u200c\u200d]+|[\u200c\u200d]+(?![\u0300-\U0010ffff])")


def decode(data: bytes) -> str:
    """Decode UTF-8 with or without a byte-order mark.

    Raises:
        JaxmarkError: half a sentence, if the bytes are not UTF-8.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise JaxmarkError(f"it is not text in UTF-8 (byte {error.start}); save it as UTF-8") from None


def parse_toml(data: bytes) -> dict[str, Any]:
    """Parse a TOML file.

    Raises:
        JaxmarkError: half a sentence, if it is none, or is nested too deeply, or has a number of thousands of digits.
    """
    try:
        return tomllib.loads(decode(data))
    except RecursionError:
        raise JaxmarkError("it is nested too deeply") from None
    except ValueError as error:
        raise JaxmarkError(str(error).rstrip(".")) from None


def normalise(text: str) -> str:
    """Compose accents (Unicode's form NFC), take all spaces for one kind, and remove what is invisible or at the ends.

    Raises:
        JaxmarkError: if it is no text, or has half of a surrogate pair, as from bytes that are not UTF-8.
    """
    if not isinstance(text, str):
        raise JaxmarkError(f"A name is text, got {text!r}.")
    if any("\ud800" <= character <= "\udfff" for character in text):
        raise JaxmarkError(f"{text!a} is not text in UTF-8; type it again.")
    return _normalised(text)


def normalise_names(names: Iterable[str]) -> list[str]:
    """Normalise names, and drop repeated ones.

    Raises:
        JaxmarkError: if different names become the same, or they are one text or no list; see also `normalise`.
    """
    if isinstance(names, str):
        raise JaxmarkError(f"Names are a list, not one text: give [{names!a}].")
    if not isinstance(names, Iterable):
        raise JaxmarkError(f"Names are a list, got {names!r}.")
    normalised: dict[str, str] = {}
    for name in names:
        first = normalised.setdefault(normalise(name), name)
        if first != name:
            raise JaxmarkError(
                f"The names {first!a} and {name!a} differ only in what cannot be seen; remove or rename one of them."
            )
    return list(normalised)


def find_name(name: str, names: Collection[str]) -> str | None:
    """Find a name, or the only one that looks the same; None if there is none.

    Raises:
        JaxmarkError: if several others look the same.
    """
    if name in names:
        return name
    sought = _normalised(name)
    alike = [other for other in names if _normalised(other) == sought]
    if len(alike) > 1:
        raise JaxmarkError(f"{name!a} could be any of {', '.join(map(ascii, alike))}, which look the same.")
    return alike[0] if alike else None


def rename_like(items: Mapping[str, Item], names: Collection[str]) -> dict[str, Item]:
    """Give items the names that look the same as theirs, unless another item has that name.

    Raises:
        JaxmarkError: see `find_name`.
    """
    renamed: dict[str, Item] = {}
    for name, item in items.items():
        known = find_name(name, names)
        renamed[name if known is None or known in items or known in renamed else known] = item
    return renamed


def _normalised(text: str) -> str:
    if text.isascii():
        return text.strip()
    plain = _SPACE.sub(" ", _USELESS_JOINER.sub("", _INVISIBLE.sub("", text)))
    return unicodedata.normalize("NFC", plain).strip()
