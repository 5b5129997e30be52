"""Write files that appear whole or not at all."""

import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxmark.errors import JaxmarkError


def write_atomically(path: str | os.PathLike, data: bytes, *, mode: int | None = None) -> None:
    """Write a file through a temporary one beside it, so that no reader ever sees half of it.

    Whatever goes wrong, a file that was there before is unchanged and no temporary file is left.

    Args:
        path: the file to write; a symbolic link is followed, and an existing file is replaced.
        data: all of the file's bytes.
        mode: permission bits such as `0o600`; by default those that the umask gives any new file.

    Raises:
        JaxmarkError: if the folder does not exist, the path is something other than an ordinary file, or the system
            refuses to write.
    """
    if "\0" in os.fspath(path):
        raise JaxmarkError("Cannot write a file whose name holds a NUL character.")
    try:
        target = Path(os.path.realpath(path))
        if not target.parent.is_dir():
            raise JaxmarkError(f"Cannot write {os.fspath(path)}: the folder {target.parent} does not exist.")
        if target.exists() and not target.is_file():
            raise JaxmarkError(f"Cannot write {os.fspath(path)}: it is not an ordinary file.")
        temporary = target.parent / f".{secrets.token_hex(8)}.tmp"
        descriptor = os.open(
            temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), mode or 0o666
        )
        try:
            with os.fdopen(descriptor, "wb") as file:
                if mode is not None:
                    temporary.chmod(mode)
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise JaxmarkError(f"Cannot write {os.fspath(path)}: {error.strerror or error}.") from error


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """Yield the path of a draft that replaces a file if the block succeeds, and is deleted if it fails.

    The draft has the file's name, in a temporary folder beside it. A symbolic link is followed. What is refused of the
    draft is said of the file.

    Raises:
        JaxmarkError: if the file's folder does not exist, or the target is itself a folder.
    """
    if not target.parent.is_dir():
        raise JaxmarkError(f"The folder {target.parent} does not exist.")
    if target.is_dir():
        raise JaxmarkError(f"{target} is a folder; name a file.")
    real = Path(os.path.realpath(target))
    with tempfile.TemporaryDirectory(prefix=".jaxmark-", dir=real.parent) as folder:
        draft = Path(folder) / target.name
        try:
            yield draft
        except JaxmarkError as error:
            raise JaxmarkError(str(error).replace(os.fspath(draft), os.fspath(target))) from error
        draft.replace(real)
