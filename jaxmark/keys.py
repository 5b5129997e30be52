"""From a key to labelled integer sequences, on the host and for ever the same.

Every keyed choice is SHAKE-256(key ‖ geometry hash ‖ "jaxmark/1/label"): two meshes marked under one key share nothing,
and no choice tells anything about another. The results are plain integer arrays, passed to traced code as data: JAX
promises no random streams that stay the same from version to version.
"""

import hashlib
import os
import secrets
from pathlib import Path

import numpy as np
from jaxtyping import Int8, Int64

from jaxmark.errors import JaxmarkError
from jaxmark.mesh import Mesh, weld, welded_mesh

SCHEME_VERSION = 1
KEY_BYTES = 32


class Key(bytes):
    """A secret of 256 bits that does not show itself when printed."""

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
    """A fresh key: 256 bits from the operating system's generator."""
    return Key(secrets.token_bytes(KEY_BYTES))


def save_key(key: bytes, path: str | os.PathLike[str]) -> None:
    """Write a key as 64 hexadecimal digits to a new file that only its owner may read (mode 0600).

    Raises:
        JaxmarkError: if the file exists (a key is never overwritten) or cannot be written.
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
    """Read a key file as `save_key` writes it.

    Raises:
        JaxmarkError: if it cannot be read or does not hold 64 hexadecimal digits (they are not shown).
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


def geometry_hash(mesh: Mesh) -> bytes:
    """SHA-256 of a mesh's canonical geometry: the same for every file that stores it exactly.

    Canonical are the welded points in order of first occurrence, as little-endian float64 with -0.0 as 0.0, and the
    triangles that refer to them, as little-endian int64.
    """
    return points_hash(welded_mesh(mesh, weld(mesh.vertices)))


def points_hash(points: Mesh) -> bytes:
    """`geometry_hash` of a mesh that has been welded already."""
    vertices = np.asarray(points.vertices, np.float64) + 0.0  # turns -0.0 into 0.0
    faces = np.asarray(points.faces)
    state = hashlib.sha256(b"jaxmark/1/geometry")
    state.update(np.array([len(vertices), len(faces)], "<i8").tobytes())
    state.update(vertices.astype("<f8").tobytes())
    state.update(faces.astype("<i8").tobytes())
    return state.digest()


def derive(key: bytes, geometry: bytes, label: str, size: int, data: bytes = b"") -> bytes:
    """`size` bytes of SHAKE-256(key ‖ geometry hash ‖ "jaxmark/1/label"), with ‖ 0 ‖ data behind if there are data."""
    message = Key(key) + geometry + f"jaxmark/{SCHEME_VERSION}/{label}".encode()
    return hashlib.shake_256(message + b"\0" + data if data else message).digest(size)


def commitment(key: bytes) -> str:
    """A hash that commits to a key without telling it, hexadecimal."""
    return derive(key, b"", "commitment", 32).hex()


def signs(key: bytes, geometry: bytes, label: str, count: int) -> Int8[np.ndarray, " count"]:
    """`count` independent signs, -1 or +1."""
    stream = np.frombuffer(derive(key, geometry, label, -(-count // 8)), np.uint8)
    return 1 - 2 * np.unpackbits(stream)[:count].astype(np.int8)


def permutation(key: bytes, geometry: bytes, label: str, count: int) -> Int64[np.ndarray, " count"]:
    """A permutation of 0 … count - 1: the order of `count` 64-bit words."""
    words = np.frombuffer(derive(key, geometry, label, 8 * count), "<u8")
    return np.argsort(words, kind="stable").astype(np.int64)
