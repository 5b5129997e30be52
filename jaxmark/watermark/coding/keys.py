"""Keys, and integer sequences that are derived from a key, a context and a label; computed on the host.

Every keyed choice is SHAKE-256(key ‖ context ‖ "jaxmark/2/label"). The choices of two meshes that are marked under one
key are therefore independent, and no choice reveals anything about another. The results are plain integer arrays, which
traced code receives as data, because JAX does not guarantee that its random streams stay the same.
"""

import hashlib
import json
import os
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int8, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import read_file
from jaxmark.files.typed import decode, normalise

SCHEME_VERSION = 2  # version of the keyed choices and of records
KEY_BYTES = 32
_MAX_FILE_BYTES = 4096  # largest size of a key file that is read; a key file has 65 bytes


class Key(bytes):
    """A secret key of 256 bits; its `repr` does not show the bytes."""

    def __new__(cls, secret: bytes) -> "Key":
        """Wrap exactly 32 bytes.

        Raises:
            JaxmarkError: if `secret` is not 32 bytes.
        """
        if not isinstance(secret, bytes) or len(secret) != KEY_BYTES:
            raise JaxmarkError(f"A key is {KEY_BYTES} bytes (jaxmark.new_key() makes one).")
        return super().__new__(cls, secret)

    def __repr__(self) -> str:
        return "<jaxmark key>"

    __str__ = __repr__


def new_key() -> Key:
    """Make a new key: 256 bits from the operating system's random generator."""
    return Key(secrets.token_bytes(KEY_BYTES))


def save_key(key: bytes, path: str | os.PathLike[str]) -> None:
    """Write a key as 64 hexadecimal digits to a new file that only its owner may read (mode 0600).

    Args:
        key: 32 bytes.
        path: the file.

    Raises:
        JaxmarkError: if the file exists (a key is never overwritten) or cannot be written, or the key is not 32 bytes.
    """
    secret = Key(key)
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise JaxmarkError(f"{path} exists; a key file is never overwritten. Choose another name.") from None
    except OSError as error:
        raise JaxmarkError(f"The key file {path} cannot be written: {error.strerror}.") from None
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(secret.hex() + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:  # an empty file would make the next attempt fail
        os.unlink(path)  # noqa: PTH108
        raise JaxmarkError(f"The key file {path} cannot be written: {error.strerror}.") from None


def load_key(path: str | os.PathLike[str]) -> Key:
    """Read a key file that `save_key` wrote.

    Raises:
        JaxmarkError: if the file cannot be read or does not contain 64 hexadecimal digits; the message hides them.
    """
    try:
        text = normalise(decode(read_file(path, _MAX_FILE_BYTES)))
    except OSError as error:
        raise JaxmarkError(f"The key file {path} cannot be read: {error.strerror}.") from None
    except JaxmarkError:
        text = ""
    try:
        return Key(bytes.fromhex(text))
    except ValueError:
        raise JaxmarkError(f"{path} is no key file: a key file contains {2 * KEY_BYTES} hexadecimal digits.") from None


@dataclass(frozen=True)
class Choices:
    """All keyed choices of one mark, derived from its key and from everything that reading the mark uses; see `bind`.

    A change of the key or of any of these inputs gives other choices, which are independent of the first ones.
    """

    key: Key
    context: bytes  # hash of everything that the choices are bound to

    def derive(self, label: str, size: int, data: bytes = b"") -> bytes:
        """Derive bytes: SHAKE-256(key ‖ context ‖ "jaxmark/2/label"), with ‖ 0 ‖ data appended if given.

        Args:
            label: the purpose of the bytes.
            size: number of bytes.
            data: further input that the bytes depend on.
        """
        message = self.key + self.context + f"jaxmark/{SCHEME_VERSION}/{label}".encode()
        return hashlib.shake_256(message + b"\0" + data if data else message).digest(size)

    def signs(self, label: str, count: int) -> Int8[np.ndarray, " count"]:
        """Derive `count` independent signs, -1 or +1; see `derive`."""
        stream = np.frombuffer(self.derive(label, -(-count // 8)), np.uint8)
        return 1 - 2 * np.unpackbits(stream)[:count].astype(np.int8)

    def permutation(self, label: str, count: int) -> Int64[np.ndarray, " count"]:
        """Derive a permutation of 0 … count - 1: the order of `count` 64-bit words; see `derive`."""
        words = np.frombuffer(self.derive(label, 8 * count), "<u8")
        order = np.argsort(words)  # three times as fast as a stable sort, which only equal words need
        ranked = words[order]
        if (ranked[1:] == ranked[:-1]).any():
            order = np.argsort(words, kind="stable")
        return order.astype(np.int64)


def bind(key: bytes, geometry: bytes, fixed: Mapping[str, Any]) -> Choices:
    """Bind the keyed choices of a mark to its original and to everything else that reading the mark uses.

    Args:
        key: 32 bytes.
        geometry: hash of the original's geometry.
        fixed: everything else that reading uses, such as scheme and payload size, as JSON values.

    Raises:
        JaxmarkError: if a value cannot be written as JSON, or the key is not 32 bytes.
    """
    state = hashlib.sha256(f"jaxmark/{SCHEME_VERSION}/context".encode())
    state.update(geometry)
    state.update(canonical_json(fixed))
    return Choices(Key(key), state.digest())


def canonical_json(value: Mapping[str, Any]) -> bytes:
    """Write a value as canonical JSON, the input of hashes: keys in order, no spaces, shortest numbers.

    Raises:
        JaxmarkError: if a value cannot be written as JSON.
    """
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        raise JaxmarkError(
            f"The parameters that a mark is bound to must be finite numbers, strings or lists of them: {error}."
        ) from None


def commitment(key: bytes) -> str:
    """Compute the hash that commits to a key without revealing it, in hexadecimal."""
    return hashlib.shake_256(Key(key) + b"jaxmark/1/commitment").hexdigest(32)
