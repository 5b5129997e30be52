"""Keys, and the integer sequences that derive from a key and a label; on the host, and the same in all versions.

Every keyed choice is SHAKE-256(key ‖ geometry hash ‖ "jaxmark/1/label"): two meshes marked under one key share nothing,
and no choice tells anything about another. The results are plain integer arrays, which traced code gets as data,
because JAX does not promise that its random streams stay the same from version to version.
"""

import hashlib
import os
import secrets
from pathlib import Path

import numpy as np
from jaxtyping import Int8, Int64

from jaxmark.errors import JaxmarkError

SCHEME_VERSION = 1  # version of the keyed choices
KEY_BYTES = 32


class Key(bytes):
    """A secret key of 256 bits, which is not shown when printed."""

    def __new__(cls, secret: bytes) -> "Key":
        """Wrap exactly 32 bytes.

        Raises:
            JaxmarkError: if there are not 32 bytes.
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
    with os.fdopen(descriptor, "w") as file:
        file.write(secret.hex() + "\n")


def load_key(path: str | os.PathLike[str]) -> Key:
    """Read a key file that `save_key` wrote.

    Raises:
        JaxmarkError: if the file cannot be read or does not hold 64 hexadecimal digits (the error does not show them).
    """
    try:
        text = Path(path).read_text(encoding="ascii")
    except OSError as error:
        raise JaxmarkError(f"The key file {path} cannot be read: {error.strerror}.") from None
    except UnicodeDecodeError:
        text = ""
    try:
        return Key(bytes.fromhex(text.strip()))
    except ValueError:
        raise JaxmarkError(f"{path} is no key file: it should hold {2 * KEY_BYTES} hexadecimal digits.") from None


def derive(key: bytes, geometry: bytes, label: str, size: int, data: bytes = b"") -> bytes:
    """Derive bytes from a key: SHAKE-256(key ‖ geometry hash ‖ "jaxmark/1/label"), with ‖ 0 ‖ data appended if given.

    Args:
        key: 32 bytes.
        geometry: `geometry_hash` of the original.
        label: the purpose of the bytes.
        size: number of bytes.
        data: what else the bytes depend on.
    """
    message = Key(key) + geometry + f"jaxmark/{SCHEME_VERSION}/{label}".encode()
    return hashlib.shake_256(message + b"\0" + data if data else message).digest(size)


def commitment(key: bytes) -> str:
    """Compute a hash that commits to a key without revealing it, hexadecimal."""
    return derive(key, b"", "commitment", 32).hex()


def signs(key: bytes, geometry: bytes, label: str, count: int) -> Int8[np.ndarray, " count"]:
    """Derive `count` independent signs, -1 or +1; see `derive`."""
    stream = np.frombuffer(derive(key, geometry, label, -(-count // 8)), np.uint8)
    return 1 - 2 * np.unpackbits(stream)[:count].astype(np.int8)


def permutation(key: bytes, geometry: bytes, label: str, count: int) -> Int64[np.ndarray, " count"]:
    """Derive a permutation of 0 … count - 1: the order of `count` 64-bit words; see `derive`."""
    words = np.frombuffer(derive(key, geometry, label, 8 * count), "<u8")
    return np.argsort(words, kind="stable").astype(np.int64)
