"""The record of a mark: what its owner needs to read it again, and what binds the claim to key and original.

It holds neither key nor message, and hashes of both key and original: whoever publishes it has committed to them.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from jaxmark.errors import JaxmarkError
from jaxmark.keys import SCHEME_VERSION

_FORMAT = "jaxmark-record"
RECORD_SUFFIX = ".jaxmark.json"  # behind the name of the marked file


@dataclass(frozen=True)
class Record:
    """A mark's record; JSON in a file."""

    scheme: str
    bits: int  # payload, without the tag
    beta: float  # strength, relative to the bounding-box diagonal: the common factor of the carrier's displacement
    original: str  # hash of the original's canonical geometry, hexadecimal
    key: str  # commitment to the key, hexadecimal
    parameters: Mapping[str, Any] = field(default_factory=dict)  # of the scheme
    version: int = SCHEME_VERSION

    def to_json(self) -> str:
        """The record as JSON text."""
        return json.dumps({"format": _FORMAT, **asdict(self)}, indent=2) + "\n"

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Record":
        """Read a record file.

        Raises:
            JaxmarkError: if it cannot be read, is no record, or was written for a version this one does not know.
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
            "version": int,
        }
        if data.keys() != types.keys() or any(type(data[name]) is not kind for name, kind in types.items()):
            raise JaxmarkError(f"The record {path} is damaged: its fields are not those of a record.")
        return cls(**data)
