"""The record of a mark, which its owner needs to read the mark again, and which binds a claim to key and original.

A record contains neither the key nor the message, but commitments to both. It also contains an imprint of the
original, so that a copy of the original that was saved again can be used (`jaxmark.geometry.imprint`). An
authentication code with a subkey covers all fields, so that only the key holder can edit the record. The key holder can
make any record at any time. Only a commitment to the record's digest that was timestamped before the suspect existed
excludes this.
"""

import base64
import hashlib
import hmac
import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import read_file
from jaxmark.geometry.imprint import Imprint
from jaxmark.watermark.coding.keys import KEY_BYTES, SCHEME_VERSION, Choices, Key, canonical_json, commitment
from jaxmark.watermark.evidence import ledger
from jaxmark.watermark.evidence.ledger import Charge

_MAX_FILE_BYTES = 2**30  # a record of some hundred million points, or as many digests
_FORMAT = "jaxmark-record"
_SCENE_FORMAT, _SCENE_VERSION = "jaxmark-scene", 2
_OPEN_SCENE_VERSION = 1  # which has no code
_COMMITMENT = "jaxmark-deposit"  # the format of a commitment's file, which keeps its first name

# TimeStampReq of RFC 3161, in DER: version 1, a SHA-256 imprint of 32 bytes, and the request for the authority's
# certificate.
_REQUEST_HEAD = bytes.fromhex("30390201013031300d060960864801650304020105000420")
_REQUEST_TAIL = bytes.fromhex("0101ff")
_READERS = {
    "message": "detect",
    "presence": "detect",
    "fingerprint": "identify",
}  # the function that reads each kind of content
RECORD_SUFFIX = ".jaxmark.json"  # appended to the name of the marked file

Content = Literal["message", "presence", "fingerprint"]

_FIELDS = {  # the fields of a file, in which "told" is the commitment to the message
    "scheme": str,
    "bits": int,
    "beta": float,
    "original": str,
    "key": str,
    "parameters": dict,
    "content": str,
    "version": int,
    "told": str,
    "imprint": dict,
    "code": str,
}


_MAX_BITS = 2**23  # the largest payload, and the largest number of slots of a fingerprint
_HASH = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True)
class Record:
    """The record of a mark; a file stores it as JSON.

    Every field has a range, which is checked whoever made the record.

    Raises:
        JaxmarkError: if a field is out of its range.
    """

    scheme: str  # name of the scheme
    bits: int  # size of the payload in bits, without the tag; number of slots for a fingerprint
    beta: float  # strength: the factor on the carrier's displacement, relative to the diagonal; reading does not use it
    original: str  # hash of the original's canonical geometry, hexadecimal
    key: str  # commitment to the key, hexadecimal
    parameters: Mapping[str, Any] = field(default_factory=dict)  # fields of the scheme
    content: Content = "message"  # the kind of content that the mark carries
    version: int = SCHEME_VERSION  # version of the keyed choices and of the record
    message_commitment: str = ""  # commitment to message or recipient, see `commit`; empty for presence
    imprint: Mapping[str, Any] = field(default_factory=dict)  # of the original, with encrypted tags; empty if blind
    code: str = ""  # authentication code with the key over all other fields, hexadecimal

    def __post_init__(self) -> None:
        """Check the ranges of all fields."""
        hashes = {name: getattr(self, name) for name in ("original", "key", "message_commitment", "code")}
        is_in_range = {
            **{name: _HASH.fullmatch(value) or (not value and name != "key") for name, value in hashes.items()},
            "bits": 0 <= self.bits <= _MAX_BITS
            and (self.bits > 0) == (self.content != "presence")
            and (self.bits % 8 == 0 or self.content == "fingerprint"),
            "beta": math.isfinite(self.beta) and self.beta >= 0,
        }
        if wrong := [name for name, is_right in is_in_range.items() if not is_right]:
            raise JaxmarkError(f"A record is damaged or forged: {', '.join(wrong)} out of range. Use an unedited copy.")

    @property
    def meshes(self) -> Mapping[str, "Record"]:
        """The record by the name of its mesh, as in `SceneRecord`; the mesh has no name."""
        return {"": self}

    def caveats(self, key: bytes) -> tuple[str, ...]:
        """Return why readings are no proof: nothing, because the record of one mesh always has a code.

        Raises:
            JaxmarkError: if the code does not match, for this key.
        """
        if self.key == commitment(key):
            self._check_code(key)
        return ()

    def to_json(self) -> str:
        """Return the record as JSON text."""
        return json.dumps({"format": _FORMAT, **self._stored()}, indent=2) + "\n"

    def digest(self) -> str:
        """Compute SHA-256 of the record, hexadecimal; publish or timestamp this digest instead of the record.

        The key is not needed for it.
        """
        return hashlib.sha256(b"jaxmark/record" + canonical_json(self._stored())).hexdigest()

    def sealed(self, key: bytes) -> "Record":
        """Return the record with the authentication code of its owner."""
        return replace(self, code=self._code(key))

    def check(self, content: Content, key: bytes) -> None:
        """Check that the record is for this content and key, and that it was not edited without the key.

        Args:
            content: the kind of content to read.
            key: 32 bytes.

        Raises:
            JaxmarkError: if a check fails.
        """
        if self.content != content:
            raise JaxmarkError(f"The record is of a {self.content}; {_READERS[self.content]} reads it.")
        if self.key != commitment(key):
            raise JaxmarkError("The key is not the one that the record commits to.")
        self._check_code(key)

    def payload(self, key: bytes, bits: int | None = None) -> int:
        """Check the record of a message or a presence mark, and return its payload size.

        Args:
            key: 32 bytes.
            bits: the expected payload size; None if any.

        Raises:
            JaxmarkError: see `check`; also if the record has another payload size.
        """
        self.check("message" if self.bits else "presence", key)
        if bits not in (None, self.bits):
            raise JaxmarkError(f"The record is of {_payload(self.bits)}, not of {_payload(bits)}.")
        return self.bits

    def commits_to(self, content: bytes, choices: Choices) -> bool:
        """Whether the record commits to this message or recipient."""
        return hmac.compare_digest(self.message_commitment, commit(content, choices))

    def check_claim(self, message: bytes, choices: Choices) -> None:
        """Check that the record does not commit to another message than the claimed one.

        Raises:
            JaxmarkError: if it commits to another message.
        """
        if is_recorded(self, message, choices) is False:
            raise JaxmarkError("The record commits to another message than the claimed one. Claim that one, or none.")

    def open_imprint(self, key: bytes) -> Imprint:
        """Decrypt the imprint of the original.

        Raises:
            JaxmarkError: if the record has no complete imprint.
        """
        try:
            tags = np.frombuffer(base64.b64decode(self.imprint["tags"], validate=True), "<u4")
            imprint = Imprint(
                bytes.fromhex(self.original),
                float(self.imprint["grid"]),
                np.array(self.imprint["centre"], np.float64).reshape(3),
                np.array(self.imprint["covariance"], np.float64).reshape(3, 3),
                tags ^ _stream(key, self.original, len(tags)),
                bytes.fromhex(self.imprint["order"]),
            )
            numbers = [imprint.grid, *imprint.centre, *imprint.covariance.flat]
            # Products of numbers in this range are finite.
            is_in_range = (np.abs(numbers) < 1e100).all() and imprint.grid > 1e-100 and len(tags) > 0
            if not is_in_range or not _HASH.fullmatch(self.imprint["order"]):
                raise ValueError("out of range")
            return imprint
        except (KeyError, ValueError, TypeError, OverflowError):
            raise JaxmarkError(
                "The record is damaged: its imprint of the original is incomplete or out of range."
            ) from None

    def _stored(self) -> dict[str, Any]:
        """Return the fields by their names in a file."""
        fields = asdict(self)
        told = fields.pop("message_commitment")
        return {**fields, "told": told}

    def _check_code(self, key: bytes) -> None:
        if not hmac.compare_digest(self.code, self._code(key)):
            raise JaxmarkError("The record was edited: its code does not match its fields. Use an unedited copy.")

    def _code(self, key: bytes) -> str:
        fields = canonical_json({name: value for name, value in self._stored().items() if name != "code"})
        return Choices(Key(key), b"").derive("record", KEY_BYTES, fields).hex()

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Record":
        """Read a record file.

        Raises:
            JaxmarkError: if the file cannot be read, is no record, or has a version that this jaxmark does not know.
        """
        return cls.of(read_json(path), path)

    @classmethod
    def of(cls, data: Any, where: str | os.PathLike[str]) -> "Record":
        """Make a record from the JSON of a file.

        Raises:
            JaxmarkError: see `load`.
        """
        if not isinstance(data, dict) or data.get("format") != _FORMAT:
            raise JaxmarkError(f"{where} is not a record of jaxmark.")
        data = {name: value for name, value in data.items() if name != "format"}
        if data.get("version") != SCHEME_VERSION:
            raise JaxmarkError(
                f"The record {where} is of version {data.get('version')!r}; this jaxmark reads version"
                f" {SCHEME_VERSION}."
            )
        if data.keys() != _FIELDS.keys() or any(type(data[name]) is not kind for name, kind in _FIELDS.items()):
            raise JaxmarkError(f"The record {where} is damaged: its fields are not those of a record.")
        if data["content"] not in _READERS:
            raise JaxmarkError(f"The record {where} has a content that this jaxmark does not know.")
        try:
            record = cls(message_commitment=data.pop("told"), **data)
            record.digest()
        except JaxmarkError as error:
            raise JaxmarkError(f"{where}: {error}") from None
        except RecursionError:
            raise JaxmarkError(f"The record {where} is damaged: its fields are nested too deeply.") from None
        return record


@dataclass(frozen=True)
class SceneRecord:
    """The records of a file's meshes, by name.

    Each of them can also be used to read its mesh alone, if it was fixed before the suspect existed which mesh that is.
    Otherwise the choice must be charged: give `detect_scene` this record and the mesh by `names`.
    """

    meshes: Mapping[str, Record]
    code: str = ""  # the owner's authentication code of the names and their records; empty if there is none

    def __post_init__(self) -> None:
        """Check that the meshes agree in everything that is stated of the whole."""
        if not self.meshes:
            raise JaxmarkError("A record of a scene needs the record of at least one mesh.")
        for kind in ("scheme", "bits", "content", "key"):
            if len({getattr(record, kind) for record in self.meshes.values()}) > 1:
                raise JaxmarkError(f"The records of the meshes of a scene differ in {kind}; use an unedited copy.")
        if len({not record.message_commitment for record in self.meshes.values()}) > 1:
            raise JaxmarkError(
                "Some of the meshes of a scene have a record that commits to a message, and some have not; use an"
                " unedited copy."
            )

    @property
    def scheme(self) -> str:
        """Name of the scheme, which all meshes have."""
        return self._any.scheme

    @property
    def bits(self) -> int:
        """Size of the payload in bits, which all meshes have."""
        return self._any.bits

    @property
    def message_commitment(self) -> str:
        """The commitments of all records, concatenated; empty if none commits to a message."""
        return "".join(record.message_commitment for record in self.meshes.values())

    @property
    def _any(self) -> Record:
        return next(iter(self.meshes.values()))

    def to_json(self) -> str:
        """Return the records as JSON text."""
        meshes = {name: json.loads(record.to_json()) for name, record in self.meshes.items()}
        version = {"version": _SCENE_VERSION, "code": self.code} if self.code else {"version": _OPEN_SCENE_VERSION}
        return json.dumps({"format": _SCENE_FORMAT, **version, "meshes": meshes}, indent=2) + "\n"

    def digest(self) -> str:
        """Compute SHA-256 over all records, hexadecimal; the key is not needed for it."""
        return hashlib.sha256(b"jaxmark/scene" + self._digests()).hexdigest()

    def sealed(self, key: bytes) -> "SceneRecord":
        """Return the records with the authentication code of their owner."""
        return replace(self, code=self._code(key))

    def caveats(self, key: bytes) -> tuple[str, ...]:
        """Return why readings are no proof: without a code, meshes may have been left out of the record.

        Meshes that are chosen after the suspect exists can be those that happen to agree with it.

        Raises:
            JaxmarkError: if the code does not match, for this key.
        """
        if not self.code:
            return ("the record of the scene has no code, so that meshes may have been left out of it",)
        # With another key, each record says so.
        if self._any.key == commitment(key) and not hmac.compare_digest(self.code, self._code(key)):
            raise JaxmarkError("The record of the scene was edited: its code does not match its meshes.")
        return ()

    def _digests(self) -> bytes:
        return canonical_json({name: record.digest() for name, record in self.meshes.items()})

    def _code(self, key: bytes) -> str:
        return Choices(Key(key), b"").derive("scene", KEY_BYTES, self._digests()).hex()


def check_record(record: Record | None) -> None:
    """Refuse anything but the record of one mesh, or None.

    Raises:
        JaxmarkError: if it is something else, such as a path.
    """
    if not isinstance(record, Record | None):
        raise JaxmarkError(f"The record of a mesh is needed, got {type(record).__name__}; Record.load reads one.")


def check_scheme(record: Record | SceneRecord | None, named: str | None) -> None:
    """Check that a scheme that was named, if any, is that of the record.

    Raises:
        JaxmarkError: if it is another one.
    """
    if record is not None and named not in (None, record.scheme):
        raise JaxmarkError(
            f"The scheme {named!r} contradicts the record, whose scheme is {record.scheme!r}; leave it out."
        )


def load_record(path: str | os.PathLike[str]) -> Record | SceneRecord:
    """Read a record file of one mesh or of several.

    Raises:
        JaxmarkError: see `Record.load`.
    """
    data = read_json(path)
    if not isinstance(data, dict) or data.get("format") != _SCENE_FORMAT:
        return Record.load(path)
    meshes, code, version = data.get("meshes"), data.get("code", ""), data.get("version")
    if type(version) is not int or version not in (_OPEN_SCENE_VERSION, _SCENE_VERSION):
        raise JaxmarkError(f"The record {path} is of version {version!r}; this jaxmark reads {_SCENE_VERSION}.")
    if data.keys() != {"format", "version", "meshes"} | ({"code"} if version == _SCENE_VERSION else set()):
        raise JaxmarkError(f"The record {path} is damaged: its fields are not those of a record.")
    if not isinstance(meshes, dict) or not meshes:
        raise JaxmarkError(f"The record {path} is damaged: it has no meshes.")
    if not (isinstance(code, str) and code.isascii()):
        raise JaxmarkError(f"The record {path} is damaged: its code is none.")
    records = {name: Record.of(item, f"{path}, mesh {name!r},") for name, item in meshes.items()}
    try:
        return SceneRecord(records, code)
    except JaxmarkError as error:
        raise JaxmarkError(f"{path}: {error}") from None


def _payload(bits: int | None) -> str:
    return f"a payload of {bits!r} bits" if bits else "a presence mark"


def looks_like_record(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a record, possibly a damaged one, or one of another version.

    Raises:
        JaxmarkError: see `read_json`.
    """
    data = read_json(path)
    return isinstance(data, dict) and data.get("format") in (_FORMAT, _SCENE_FORMAT)


def read_json(path: str | os.PathLike[str]) -> Any:
    """Read the JSON of a record file; None if it contains no JSON.

    Raises:
        JaxmarkError: if it is no path, the file cannot be read, or a name in it has two values.
    """
    if not isinstance(path, str | os.PathLike):
        raise JaxmarkError(f"A path is needed, got {type(path).__name__}.")
    try:
        return json.loads(read_file(path, _MAX_FILE_BYTES), object_pairs_hook=partial(_unique, path))
    except OSError as error:
        raise JaxmarkError(f"The record {path} cannot be read: {error.strerror}.") from None
    except JaxmarkError:
        raise
    except (ValueError, RecursionError):
        return None


def _unique(path: str | os.PathLike[str], pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a JSON object's mapping; a name with two values would be read differently by other programs."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise JaxmarkError(
            f"The record {path} is damaged or forged: a name in it has two values. Use an unedited copy."
        )
    return found


def is_recorded(record: Record | None, content: bytes, choices: Choices) -> bool | None:
    """Whether a record commits to this message or recipient; None without a record, or if it has no commitment."""
    return record.commits_to(content, choices) if record is not None and record.message_commitment else None


def commit(content: bytes, choices: Choices) -> str:
    """Commit to a message or a recipient without revealing it, hexadecimal.

    The commitment is SHA-256 of a salt of 32 bytes, which is derived from the key, and of the content. Anyone who is
    given both can verify it. Without the salt, guesses cannot be tested.
    """
    return hashlib.sha256(b"jaxmark/2/told" + choices.derive("told/salt", KEY_BYTES) + content).hexdigest()


def seal_imprint(imprint: Imprint, key: bytes) -> dict[str, Any]:
    """Convert an imprint to the form of a record, with its tags encrypted: they would reveal points of the original."""
    tags = imprint.tags ^ _stream(key, imprint.hash.hex(), len(imprint.tags))
    return {
        "grid": imprint.grid,
        "centre": imprint.centre.tolist(),
        "covariance": imprint.covariance.tolist(),
        "order": imprint.order.hex(),
        "tags": base64.b64encode(tags.astype("<u4").tobytes()).decode(),
    }


def _stream(key: bytes, original: str, count: int) -> np.ndarray:
    """Derive the key stream that encrypts an original's tags; it is never used for anything else."""
    return np.frombuffer(Choices(Key(key), bytes.fromhex(original)).derive("imprint", 4 * count), "<u4")


@dataclass(frozen=True)
class TimestampedCommitment:
    """A commitment to a set of records by their digests, to be timestamped as one; make one with `make_commitment`.

    A record can be made at any time, also after the suspect. A record whose digest was published, or signed by a
    timestamping authority, before the suspect existed cannot have been made for it. The root reveals nothing about the
    content of the records. It commits to their number K, and a claim by one of them is charged for K records.
    """

    digests: tuple[str, ...]  # `Record.digest` of each, hexadecimal, in ascending order

    @property
    def root(self) -> str:
        """The hash to publish: SHA-256 over the number of records and their Merkle tree (RFC 6962, 2.1)."""
        level = [hashlib.sha256(b"\0" + bytes.fromhex(digest)).digest() for digest in self.digests]
        while len(level) > 1:
            pairs = [level[place : place + 2] for place in range(0, len(level), 2)]
            level = [hashlib.sha256(b"\1" + b"".join(pair)).digest() if len(pair) == 2 else pair[0] for pair in pairs]
        return hashlib.sha256(f"jaxmark/deposit/{len(self.digests)}/".encode() + level[0]).hexdigest()

    def charges(self, record: Record | SceneRecord, *, claimed: bool) -> tuple[Charge, ...]:
        """Return the charges for a claim by one of these records, if the commitment is older than the suspect.

        Args:
            record: the record that the suspect was read with.
            claimed: whether the message was claimed instead of decoded. All messages are then charged, if the record
                commits to none.

        Raises:
            JaxmarkError: if the commitment does not contain the record.
        """
        if record.digest() not in self.digests:
            raise JaxmarkError(
                f"The record (digest {record.digest()}) is not in the commitment, which does not prove its age."
            )
        free = record.bits if claimed and not record.message_commitment else 0
        return (ledger.COMMITMENT.charge("each", len(self.digests), bits=free),)

    def timestamp_request(self) -> bytes:
        """Make a request to a timestamping authority for the root (RFC 3161), which `curl` or `openssl ts` can send."""
        return _REQUEST_HEAD + bytes.fromhex(self.root) + _REQUEST_TAIL

    def to_json(self) -> str:
        """Return the commitment as JSON text, including its root for readers."""
        return json.dumps({"format": _COMMITMENT, "root": self.root, "digests": list(self.digests)}, indent=2) + "\n"

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "TimestampedCommitment":
        """Read a file that `to_json` wrote.

        Raises:
            JaxmarkError: if the file cannot be read, is no commitment, or its root does not match its digests.
        """
        try:
            data = json.loads(read_file(path, _MAX_FILE_BYTES))
            loaded = make_commitment(data["digests"])
            if data["format"] == _COMMITMENT and data["root"] == loaded.root:
                return loaded
        except OSError as error:
            raise JaxmarkError(f"The commitment {path} cannot be read: {error.strerror}.") from None
        except (ValueError, TypeError, KeyError, RecursionError):
            pass
        raise JaxmarkError(
            f"{path} is not a commitment of jaxmark, or was edited: its root does not match its digests."
        )


def make_commitment(digests: Iterable[str]) -> TimestampedCommitment:
    """Commit to records by their digests; a digest that is given twice counts once.

    Raises:
        JaxmarkError: if no digest is given, or one is not 64 hexadecimal digits.
    """
    distinct = tuple(sorted(set(digests)))
    if not distinct or not all(map(_HASH.fullmatch, distinct)):
        raise JaxmarkError("A commitment needs at least one record digest, each of 64 hexadecimal digits.")
    return TimestampedCommitment(distinct)
