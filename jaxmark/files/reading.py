"""Read whole files that end."""

import errno
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

from jaxmark.errors import JaxmarkError


def read_file(path: str | os.PathLike, most: int | None = None) -> bytes:
    """Read all bytes of an ordinary file; a device or a pipe, which may never end, is refused.

    Args:
        path: the file; symbolic links are followed.
        most: the largest number of bytes that make sense.

    Raises:
        OSError: if it cannot be read, is no ordinary file, or is larger than that.
        ValueError: if its name holds a NUL.
    """
    target = Path(path)
    found = target.stat()  # raises where there is nothing
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    if not target.is_file():
        raise OSError(errno.EINVAL, "it is no ordinary file; write its content to one", os.fspath(path))
    if most is not None and found.st_size > most:
        raise OSError(errno.EFBIG, f"it has {found.st_size} bytes, more than {most}", os.fspath(path))
    return target.read_bytes()


def file_hash(path: str | os.PathLike[str]) -> str:
    """Compute the SHA-256 of a file's bytes, hexadecimal.

    Raises:
        JaxmarkError: if it cannot be read.
    """
    if Path(path).exists() and not Path(path).is_file():  # a pipe may never end
        raise JaxmarkError(f"Cannot read {path}: it is no ordinary file.")
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise JaxmarkError(f"Cannot read {path}: {error.strerror or error}.") from None


def read_beside(folder: Path) -> Callable[[str], bytes]:
    """A function that reads files by their paths relative to a folder, and none outside of it.

    It raises a `JaxmarkError`, half a sentence, for what cannot be read.
    """

    def read(path: str) -> bytes:
        try:
            inside = os.path.realpath(folder)
            target = os.path.realpath(Path(inside) / path)
            if os.path.commonpath([inside, target]) != inside:
                raise JaxmarkError(f"the file {ascii(path)[:80]} that it refers to is outside of its folder")
            return read_file(target)
        except (OSError, ValueError) as error:
            said = getattr(error, "strerror", None) or str(error)
            raise JaxmarkError(f"the file {ascii(path)[:80]} that it refers to cannot be read: {said}") from None

    return read
