"""The record of a mark, which its owner needs to read the mark again, and which binds the claim to key and original.

It holds neither the key nor the message, but commitments to both, and an imprint of the original by which a copy of it
that was saved again will do (`jaxmark.geometry.imprint`). A code by a subkey covers all of it, so that nobody else can
edit it. Its owner can make any record. Only a date before the suspect existed rules that out: that of `Record.digest`.
"""

import base64
import hashlib
import hmac
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import read_file
from jaxmark.geometry.imprint import Imprint
from jaxmark.watermark.coding.keys import KEY_BYTES, SCHEME_VERSION, VERSIONS, Choices, Key, canonical_json, commitment

_MAX_FILE_BYTES = 2**30  # of a record of some hundred million points, or as many digests
_FORMAT = "jaxmark-record"
_READERS = {
    "message": "detect",
    "presence": "detect",
    "fingerprint": "identify",
}  # the function that reads each content
RECORD_SUFFIX = ".jaxmark.json"  # is appended to the name of the marked file

Content = Literal["message", "presence", "fingerprint"]

# The fields in files of version 1, and those that version 2 added.
_FIRST_FIELDS = {
    "scheme": str,
    "bits": int,
    "beta": float,
    "original": str,
    "key": str,
    "parameters": dict,
    "content": str,
    "version": int,
}
_LATER_FIELDS = {"told": str, "imprint": dict, "code": str}


@dataclass(frozen=True)
class Record:
    """The record of a mark; a file stores it as JSON."""

    scheme: str  # name of the scheme
    bits: int  # size of the payload in bits, without the tag; of a fingerprint, its number of slots
    beta: float  # strength: the factor on the carrier's displacement, relative to the diagonal; reading does not use it
    original: str  # hash of the original's canonical geometry, hexadecimal
    key: str  # commitment to the key, hexadecimal
    parameters: Mapping[str, Any] = field(default_factory=dict)  # fields of the scheme
    content: Content = "message"  # what the mark carries
    version: int = SCHEME_VERSION  # version of the keyed choices and of the record
    told: str = ""  # commitment to the message or the recipient, see `commit`, hexadecimal; version 1 has none
    imprint: Mapping[str, Any] = field(default_factory=dict)  # of the original, its tags sealed; version 1 has none
    code: str = ""  # authentication code by the key, over all other fields, hexadecimal; version 1 has none

    def to_json(self) -> str:
        """The record as JSON text."""
        return json.dumps({"format": _FORMAT, **self._fields()}, indent=2) + "\n"

    def digest(self) -> str:
        """SHA-256 of the record, hexadecimal, which anybody can compute: publish or date this, not the record."""
        return hashlib.sha256(b"jaxmark/record" + canonical_json(self._fields())).hexdigest()

    def sealed(self, key: bytes) -> "Record":
        """The record with the authentication code of its owner."""
        return replace(self, code=self._code(key))

    def check(self, content: Content, key: bytes) -> None:
        """Check that the record is for this content and key, and that nobody without the key has edited it.

        Args:
            content: what is to be read.
            key: 32 bytes.

        Raises:
            JaxmarkError: if it is not.
        """
        if self.content != content:
            raise JaxmarkError(f"The record is of a {self.content}; {_READERS[self.content]} reads it.")
        if self.key != commitment(key):
            raise JaxmarkError("The key is not the one that the record commits to.")
        if self.version > 1 and not hmac.compare_digest(self.code, self._code(key)):
            raise JaxmarkError("The record was edited: its code is not that of its fields. Use an unedited copy.")

    def commits_to(self, told: bytes, choices: Choices) -> bool:
        """Whether the record commits to this message or recipient."""
        return hmac.compare_digest(self.told, commit(told, choices))

    def open_imprint(self, key: bytes) -> Imprint:
        """The imprint of the original.

        Raises:
            JaxmarkError: if the record has none that is whole.
        """
        try:
            tags = np.frombuffer(base64.b64decode(self.imprint["tags"], validate=True), "<u4")
            return Imprint(
                bytes.fromhex(self.original),
                float(self.imprint["grid"]),
                np.array(self.imprint["centre"], np.float64).reshape(3),
                np.array(self.imprint["covariance"], np.float64).reshape(3, 3),
                tags ^ _stream(key, self.original, len(tags)),
                bytes.fromhex(self.imprint["order"]),
            )
        except (KeyError, ValueError, TypeError):
            raise JaxmarkError("The record is damaged: its imprint of the original is not whole.") from None

    def _fields(self) -> dict[str, Any]:
        """The fields that a file of this version has."""
        names = _FIRST_FIELDS if self.version == 1 else _FIRST_FIELDS | _LATER_FIELDS
        return {name: value for name, value in asdict(self).items() if name in names}

    def _code(self, key: bytes) -> str:
        fields = canonical_json({name: value for name, value in self._fields().items() if name != "code"})
        return Choices(Key(key), b"", 2).derive("record", KEY_BYTES, fields).hex()

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Record":
        """Read a record file.

        Raises:
            JaxmarkError: if the file cannot be read, is no record, or has a version that this jaxmark does not know.
        """
        return cls.of(read_json(path), path)

    @classmethod
    def of(cls, data: Any, where: str | os.PathLike[str]) -> "Record":
        """Make a record of a file's JSON.

        Raises:
            JaxmarkError: see `load`.
        """
        if not isinstance(data, dict) or data.get("format") != _FORMAT:
            raise JaxmarkError(f"{where} is not a record of jaxmark.")
        data = {name: value for name, value in data.items() if name != "format"}
        if data.get("version") not in VERSIONS:
            raise JaxmarkError(
                f"The record {where} is of version {data.get('version')}; this jaxmark reads versions"
                f" {' and '.join(map(str, sorted(VERSIONS)))}."
            )
        types = _FIRST_FIELDS if data["version"] == 1 else _FIRST_FIELDS | _LATER_FIELDS
        if data.keys() != types.keys() or any(type(data[name]) is not kind for name, kind in types.items()):
            raise JaxmarkError(f"The record {where} is damaged: its fields are not those of a record.")
        if data["content"] not in _READERS:
            raise JaxmarkError(f"The record {where} is of a {data['content']}, which this jaxmark does not know.")
        return cls(**data)


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read the JSON of a record file; None if it holds none.

    Raises:
        JaxmarkError: if the file cannot be read.
    """
    try:
        return json.loads(read_file(path, _MAX_FILE_BYTES))
    except OSError as error:
        raise JaxmarkError(f"The record {path} cannot be read: {error.strerror}.") from None
    except (ValueError, RecursionError):
        return None


def commit(told: bytes, choices: Choices) -> str:
    """Commit to a message or a recipient, hexadecimal, without revealing it.

    It is SHA-256 of a salt of 32 bytes, which derives from the key, and of what is committed to: whoever is shown both
    can check it, and without the salt no guess can be tried.
    """
    return hashlib.sha256(b"jaxmark/2/told" + choices.derive("told/salt", KEY_BYTES) + told).hexdigest()


def seal_imprint(imprint: Imprint, key: bytes) -> dict[str, Any]:
    """An imprint as a record stores it: its tags are encrypted, as who has them could tell an original's points."""
    tags = imprint.tags ^ _stream(key, imprint.hash.hex(), len(imprint.tags))
    return {
        "grid": imprint.grid,
        "centre": imprint.centre.tolist(),
        "covariance": imprint.covariance.tolist(),
        "order": imprint.order.hex(),
        "tags": base64.b64encode(tags.astype("<u4").tobytes()).decode(),
    }


def _stream(key: bytes, original: str, count: int) -> np.ndarray:
    """The key stream for an original's tags, which is never used for anything else."""
    return np.frombuffer(Choices(Key(key), bytes.fromhex(original), 2).derive("imprint", 4 * count), "<u4")
