"""Files that appear whole or not at all."""

import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxmark.errors import JaxmarkError


def write_atomically(path: str | os.PathLike, data: bytes, *, mode: int | None = None) -> None:
    """Write a file through a temporary one beside it, so that no reader ever sees half of it.

    Whatever goes wrong, the file that stood there before is still there and no temporary file is left.

    Args:
        path: where to; a symbolic link is followed, and a file that stands there is replaced.
        data: all of the file's bytes.
        mode: permission bits such as `0o600`; by default those that any new file gets here (the umask's).

    Raises:
        JaxmarkError: if the folder is missing, something that is no ordinary file stands there, or the system
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
    """A draft beside a file, of the same name, that takes its place if all goes well and vanishes if not.

    Raises:
        JaxmarkError: if there is no such folder, or a folder of that name.
    """
    if not target.parent.is_dir():
        raise JaxmarkError(f"The folder {target.parent} does not exist.")
    if target.is_dir():
        raise JaxmarkError(f"{target} is a folder; name a file.")
    with tempfile.TemporaryDirectory(prefix=".jaxmark-", dir=target.parent) as folder:
        draft = Path(folder) / target.name
        yield draft
        draft.replace(target)
