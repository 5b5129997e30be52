"""The record of a mark, which its owner needs to read the mark again, and which binds the claim to key and original.

It holds neither the key nor the message, but hashes of key and original: whoever publishes it has committed to both.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from jaxmark.errors import JaxmarkError
from jaxmark.watermark.coding.keys import SCHEME_VERSION, commitment

_FORMAT = "jaxmark-record"
_READERS = {"message": "detect", "fingerprint": "identify"}  # the function that reads each content
RECORD_SUFFIX = ".jaxmark.json"  # is appended to the name of the marked file


@dataclass(frozen=True)
class Record:
    """The record of a mark; a file stores it as JSON."""

    scheme: str  # name of the scheme
    bits: int  # size of the payload in bits, without the tag; of a fingerprint, its number of slots
    beta: float  # strength: the factor on the carrier's displacement, relative to the bounding-box diagonal
    original: str  # hash of the original's canonical geometry, hexadecimal
    key: str  # commitment to the key, hexadecimal
    parameters: Mapping[str, Any] = field(default_factory=dict)  # fields of the scheme
    content: Literal["message", "fingerprint"] = "message"  # what the mark carries
    version: int = SCHEME_VERSION  # version of the keyed choices and of the record

    def to_json(self) -> str:
        """The record as JSON text."""
        return json.dumps({"format": _FORMAT, **asdict(self)}, indent=2) + "\n"

    def check(self, content: Literal["message", "fingerprint"], geometry: bytes, key: bytes) -> None:
        """Check that the record is for this content, original and key.

        Args:
            content: what is to be read.
            geometry: `geometry_hash` of the original.
            key: 32 bytes.

        Raises:
            JaxmarkError: if the record is for other content, another original or another key.
        """
        if self.content != content:
            raise JaxmarkError(f"The record is of a {self.content}; {_READERS[self.content]} reads it.")
        if self.original != geometry.hex():
            raise JaxmarkError("The original is not the mesh that the record was made for (its geometry differs).")
        if self.key != commitment(key):
            raise JaxmarkError("The key is not the one that the record commits to.")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Record":
        """Read a record file.

        Raises:
            JaxmarkError: if the file cannot be read, is no record, or has a version that this jaxmark does not know.
        """
        try:
            data = json.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise JaxmarkError(f"The record {path} cannot be read: {error.strerror}.") from None
        except ValueError:
            data = None
        if not isinstance(data, dict) or data.pop("format", None) != _FORMAT:
            raise JaxmarkError(f"{path} is not a record of jaxmark.")
        if data.get("version") != SCHEME_VERSION:
            raise JaxmarkError(
                f"The record {path} is of version {data.get('version')}; this jaxmark reads version {SCHEME_VERSION}."
            )
        types = {
            "scheme": str,
            "bits": int,
            "beta": float,
            "original": str,
            "key": str,
            "parameters": dict,
            "content": str,
            "version": int,
        }
        if data.keys() != types.keys() or any(type(data[name]) is not kind for name, kind in types.items()):
            raise JaxmarkError(f"The record {path} is damaged: its fields are not those of a record.")
        if data["content"] not in _READERS:
            raise JaxmarkError(f"The record {path} is of a {data['content']}, which this jaxmark does not know.")
        return cls(**data)
