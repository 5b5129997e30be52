"""Deposits: what is dated so that a claim counts in full, without showing anything of what it commits to.

Whoever has a key can make any record after the fact. A record whose digest was public, or signed by a time-stamping
authority, before the suspect existed cannot have been made for it. One deposit may hold many records; it commits to
their number, and a claim by one of K pays for K.
"""

import hashlib
import json
import math
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import read_file

_MAX_FILE_BYTES = 2**30  # of a record of some hundred million points, or as many digests
_FORMAT = "jaxmark-deposit"

# TimeStampReq of RFC 3161, in DER: version 1, a SHA-256 imprint of 32 bytes, and the wish for the authority's
# certificate.
_REQUEST_HEAD = bytes.fromhex("30390201013031300d060960864801650304020105000420")
_REQUEST_TAIL = bytes.fromhex("0101ff")


@runtime_checkable
class Dated(Protocol):
    """A record, of one mesh or of several."""

    @property
    def bits(self) -> int:
        """Size of the payload in bits."""
        ...

    @property
    def told(self) -> str:
        """What it commits to; empty if to nothing."""
        ...

    def digest(self) -> str:
        """What is deposited of it."""
        ...


@dataclass(frozen=True)
class Deposit:
    """A set of records by their digests, to be dated as one."""

    digests: tuple[str, ...]  # `Record.digest` of each, hexadecimal, in ascending order

    @property
    def root(self) -> str:
        """What to publish: SHA-256 over the number of records and their Merkle tree (RFC 6962, 2.1), hexadecimal."""
        level = [hashlib.sha256(b"\0" + bytes.fromhex(digest)).digest() for digest in self.digests]
        while len(level) > 1:
            pairs = [level[place : place + 2] for place in range(0, len(level), 2)]
            level = [hashlib.sha256(b"\1" + b"".join(pair)).digest() if len(pair) == 2 else pair[0] for pair in pairs]
        return hashlib.sha256(f"jaxmark/deposit/{len(self.digests)}/".encode() + level[0]).hexdigest()

    def log10_p(self, log10_p: float, record: Dated, *, claimed: bool) -> float:
        """log10 of the bound for a claim by one of these records, if the deposit is older than the suspect.

        Args:
            log10_p: that of the detection, for this record alone.
            record: the record that was read with.
            claimed: whether the message was claimed, not read; a record of version 1 does not commit to one.

        Raises:
            JaxmarkError: if the record is not one of these.
        """
        if record.digest() not in self.digests:
            raise JaxmarkError(f"The record (digest {record.digest()}) is not in the deposit; it is not dated by it.")
        free = record.bits * math.log10(2) if claimed and not record.told else 0.0
        return min(0.0, log10_p + math.log10(len(self.digests)) + free)

    def timestamp_request(self) -> bytes:
        """A request to a time-stamping authority for the root (RFC 3161), as `curl` or `openssl ts` send it."""
        return _REQUEST_HEAD + bytes.fromhex(self.root) + _REQUEST_TAIL

    def to_json(self) -> str:
        """The deposit as JSON text, with its root for those who only look."""
        return json.dumps({"format": _FORMAT, "root": self.root, "digests": list(self.digests)}, indent=2) + "\n"

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Deposit":
        """Read a deposit file.

        Raises:
            JaxmarkError: if the file cannot be read, is no deposit, or its root is not that of its digests.
        """
        try:
            data = json.loads(read_file(path, _MAX_FILE_BYTES))
            found = make_deposit(data["digests"])
            if data["format"] == _FORMAT and data["root"] == found.root:
                return found
        except OSError as error:
            raise JaxmarkError(f"The deposit {path} cannot be read: {error.strerror}.") from None
        except (ValueError, TypeError, KeyError, RecursionError):
            pass
        raise JaxmarkError(f"{path} is not a deposit of jaxmark, or was edited: its root is not that of its digests.")


def make_deposit(digests: Iterable[str]) -> Deposit:
    """Make a deposit of records by their digests; one that is given twice counts once.

    Raises:
        JaxmarkError: if there is none, or one is not 64 hexadecimal digits.
    """
    distinct = tuple(sorted(set(digests)))
    if not distinct or not all(re.fullmatch("[0-9a-f]{64}", digest) for digest in distinct):
        raise JaxmarkError("A deposit is made of at least one record's digest, 64 hexadecimal digits each.")
    return Deposit(distinct)
