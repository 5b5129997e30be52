"""Read whole files, and write files atomically: a reader sees either the old file or the complete new one."""

import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from jaxmark.errors import JaxmarkError

#: Tells whether an existing file may stay, instead of a file with the given bytes.
MayStay = Callable[[Path, bytes], bool]

_PREFIX = ".jaxmark-"  # prefix of drafts, which are renamed to the file's name when they are complete


def read_file(path: str | os.PathLike, most: int | None = None, count: int | None = None) -> bytes:
    """Read the bytes of an ordinary file; a device or a pipe, which may never end, is refused.

    Args:
        path: the file; symbolic links are followed.
        most: the largest number of bytes that make sense.
        count: number of bytes to read, from the first one; by default all.

    Raises:
        OSError: if it cannot be read, is no ordinary file, or is larger than that.
        ValueError: if its name holds a NUL.
    """
    target = Path(path)
    size = target.stat().st_size  # raises where there is nothing
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    if not target.is_file():
        raise OSError(errno.EINVAL, "it is no ordinary file; write its content to one", os.fspath(path))
    if most is not None and (size if count is None else min(size, count)) > most:
        raise OSError(errno.EFBIG, f"it has {size} bytes, more than {most}", os.fspath(path))
    with target.open("rb") as file:
        return file.read(-1 if count is None else count)


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


def read_beside(folder: Path, most: int, most_together: int) -> Callable[[str, int | None], bytes]:
    """Make a function that reads files by their paths relative to a folder, and none outside of it or beyond a size.

    The function takes a path, and the number of bytes that are needed, or None for all. It returns no more than these,
    unless it has read more of the file before: it returns the same object for all paths of a file.
    It raises a `JaxmarkError`, half a sentence, for a file that cannot be read.

    Args:
        folder: the folder.
        most: largest number of bytes that are read of a file.
        most_together: largest number of bytes that are read of all files.
    """
    contents: dict[tuple[int, int], bytes] = {}
    left = most_together

    def read(path: str, count: int | None) -> bytes:
        nonlocal left
        try:
            target = _inside(folder, path)
            if target is None:
                raise JaxmarkError(f"the file {ascii(path)[:80]} that it refers to is outside of its folder")
            status = target.stat()
            file = status.st_dev, status.st_ino
            needed = status.st_size if count is None else min(count, status.st_size)
            if file not in contents or len(contents[file]) < needed:
                contents[file] = read_file(target, min(most, left), count)
                left -= len(contents[file])
            return contents[file]
        except (OSError, ValueError) as error:
            said = getattr(error, "strerror", None) or str(error)
            raise JaxmarkError(f"the file {ascii(path)[:80]} that it refers to cannot be read: {said}") from None

    return read


def _inside(folder: Path, name: str) -> Path | None:
    """Resolve a path relative to a folder, through symbolic links; None if it leads out of the folder."""
    inside = os.path.realpath(folder)
    target = os.path.realpath(Path(inside) / name)
    return Path(target) if os.path.commonpath([inside, target]) == inside else None


def _own_prefix() -> str:
    """Return the prefix of this process's drafts, from which others can find out whether it still runs."""
    return f"{_PREFIX}{re.sub('[^A-Za-z0-9]', '_', platform.node())}-{os.getpid()}-"


def _clear_drafts(folder: Path) -> None:
    """Delete drafts of processes of this machine that were killed before they could do so themselves."""
    if os.name != "posix":  # on other systems, there is no harmless way to test a process
        return
    own = re.compile(_own_prefix().replace(f"-{os.getpid()}-", r"-(\d+)-") + ".*")
    for draft in folder.glob(_PREFIX + "*"):
        found = own.fullmatch(draft.name)
        if found is None or _runs(int(found[1])):
            continue
        if draft.is_dir():
            shutil.rmtree(draft, ignore_errors=True)
        else:
            draft.unlink(missing_ok=True)


def _runs(process: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it belongs to another user
        pass
    return True


@contextmanager
def _writing(path: str | os.PathLike) -> Iterator[None]:
    """Convert an OSError of writing a file to a `JaxmarkError`."""
    try:
        yield
    except OSError as error:
        raise JaxmarkError(f"Cannot write {os.fspath(path)}: {error.strerror or error}.") from error


def write_atomically(path: str | os.PathLike, data: bytes, *, mode: int | None = None) -> None:
    """Write a file through a temporary file in the same folder, so that no reader ever sees a part of it.

    If an error occurs, an existing file is unchanged, and no temporary file remains.

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
    with _writing(path):
        target = Path(os.path.realpath(path))
        if not target.parent.is_dir():
            raise JaxmarkError(f"Cannot write {os.fspath(path)}: the folder {target.parent} does not exist.")
        if target.exists() and not target.is_file():
            raise JaxmarkError(f"Cannot write {os.fspath(path)}: it is not an ordinary file.")
        _clear_drafts(target.parent)
        temporary = target.parent / f"{_own_prefix()}{secrets.token_hex(8)}.tmp"
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        descriptor = os.open(temporary, flags, mode or 0o666)
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


def holds(target: Path, content: bytes) -> bool:
    """Whether a path is an ordinary file with the given bytes; files of another size are not read."""
    return target.is_file() and target.stat().st_size == len(content) and target.read_bytes() == content


def write_together(
    path: str | os.PathLike, data: bytes, beside: Mapping[str, bytes], may_stay: MayStay = holds
) -> None:
    """Write a file and other files that belong to it, all or none; the other files are written first.

    Args:
        path: the file to write.
        data: all of its bytes.
        beside: the other files' bytes, by path relative to the folder of the first. None of them replaces a file.
        may_stay: tells whether a file that is there already may stay, instead of one with the given bytes; by default,
            if it has these bytes.

    Raises:
        JaxmarkError: if one of the others is there already, and may not stay, or would lie outside of the folder, such
            as beyond a symbolic link; see `write_atomically`.
    """
    written: list[Path] = []
    with _writing(path):
        try:
            for name, content in beside.items():
                folder = Path(os.path.realpath(path)).parent
                target = _inside(folder, name)
                if target is None:
                    raise JaxmarkError(f"{ascii(name)[:80]}, which it refers to, would lie outside of {folder}.")
                if not target.exists():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    written.append(target)
                    write_atomically(target, content)
                elif not may_stay(target, content):
                    raise JaxmarkError(f"{target} is there already, and is another file; write into another folder.")
            write_atomically(path, data)
        except BaseException:
            for target in written:
                target.unlink(missing_ok=True)
            raise


@contextmanager
def replacing(target: Path, may_stay: MayStay = holds) -> Iterator[Path]:
    """Yield the path of a draft that replaces a file if the block succeeds, and is deleted if it fails.

    The draft has the file's name, in a temporary folder beside it; files that are written beside it there come along. A
    symbolic link is followed. Refusals of the draft name the file.

    Args:
        target: the file.
        may_stay: see `write_together`.

    Raises:
        JaxmarkError: if the file's folder does not exist, the target exists and is no ordinary file, or the system
            refuses to write.
    """
    if not target.parent.is_dir():
        raise JaxmarkError(f"The folder {target.parent} does not exist.")
    if target.is_dir():
        raise JaxmarkError(f"{target} is a folder; name a file.")
    if target.exists() and not target.is_file():
        raise JaxmarkError(f"Cannot write {target}: it is not an ordinary file.")
    real = Path(os.path.realpath(target))
    _clear_drafts(real.parent)
    with _writing(target):
        drafts = tempfile.TemporaryDirectory(prefix=_own_prefix(), dir=real.parent)
    with drafts as folder:
        draft = Path(folder) / target.name
        try:
            yield draft
        except JaxmarkError as error:
            raise JaxmarkError(str(error).replace(os.fspath(draft), os.fspath(target))) from error
        others = {
            os.fspath(file.relative_to(folder)): file.read_bytes()
            for file in Path(folder).rglob("*")
            if file.is_file() and file != draft
        }
        if others:
            return write_together(real, draft.read_bytes(), others, may_stay)
        with _writing(target):
            # Otherwise, a power failure might leave the name with an empty file.
            with draft.open("r+b") as file:
                os.fsync(file.fileno())
            draft.replace(real)
