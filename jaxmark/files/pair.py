"""Write a file and the record that belongs to it, so that a killed process leaves no file beside another's record."""

import filecmp
import os
import stat
import time
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import NamedTuple

from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import MayStay, holds, read_file, replacing, write_atomically

try:
    import fcntl
except ModuleNotFoundError:  # not a POSIX system
    fcntl = None  # type: ignore[assignment]

_LOCK_SECONDS, _LOCK_PAUSE = 60.0, 0.02  # how long the names of a pair are waited for, and how often they are tried


def refuse_existing(*paths: Path, overwrite: bool) -> None:
    """Refuse files that exist already, unless they may be overwritten.

    Raises:
        JaxmarkError: if one of them exists.
    """
    for path in paths:
        if not overwrite and path.is_file():
            raise JaxmarkError(f"{path} exists; give another name, or replace it by --overwrite.")


def refuse_existing_pair(file: Path, record: Path, *, overwrite: bool, original: Path | None) -> None:
    """Refuse a file and its record that exist already, unless they may be overwritten.

    A file without a record may also be replaced if it is an exact copy of the original: such a copy comes along with
    a file that refers to the original.

    Raises:
        JaxmarkError: if one of them exists, and may not be replaced, is the original, or is in a folder that does not
            exist.
    """
    for path in (file, record):
        if not path.parent.is_dir():
            raise JaxmarkError(f"The folder {path.parent} does not exist.")
        if original is not None and os.path.realpath(path) == os.path.realpath(original):
            raise JaxmarkError(f"{path} is the original; give another name, or another folder.")
    came_along = not record.exists() and original is not None and _is_copy(file, original)
    refuse_existing(*([record] if came_along else [file, record]), overwrite=overwrite)


def _is_copy(file: Path, original: Path) -> bool:
    """Whether a file has the bytes of another one."""
    try:
        return not file.samefile(original) and filecmp.cmp(file, original, shallow=False)
    except OSError:
        return False


@dataclass
class Pair:
    """Drafts of a file and of its record, which `writing_pair` yields; `kept` is known when its block has ended."""

    file: Path
    record: Path
    kept: str | None = None  # path of the copy of a record that was replaced

    def __str__(self) -> str:
        return "" if self.kept is None else f"; the record that was there is kept as {self.kept}"


@contextmanager
def writing_pair(
    file: Path,
    record: Path,
    *,
    overwrite: bool = False,
    original: Path | None = None,
    may_stay: MayStay = holds,
) -> Iterator[Pair]:
    """Yield drafts of a file and of its record, which get their names if the block succeeds, and are deleted if not.

    No record is ever lost, and the record beside the file is always that of this file, even if the process is killed at
    any moment:

    - A new file gets its name after its record. Between the two steps, there is a record without a file.
    - If the pair exists already, the old record is first copied to `old-1-NAME` in its folder, and the old file is
      renamed to `old-1-NAME` in its folder; the number is the first that neither name has yet. The new record and the
      new file then get their names. Until they have, the old pair is complete, under its own names or under those with
      `old-1-`, and there is no file of the given name. At the end, the old file is deleted. The old record stays, for
      copies that were handed out, unless it is equal to the new one.

    Processes that write into the same folders give names one after another, where the system has locks of folders.

    Args:
        file: path of the file.
        record: path of its record.
        overwrite: whether existing files may be replaced.
        original: the file that is marked, if there is one, see `refuse_existing_pair`.
        may_stay: see `write_together`.

    Raises:
        JaxmarkError: if one of them exists and may not be replaced; see `replacing`. The files are then as before.
    """
    refuse_existing_pair(file, record, overwrite=overwrite, original=original)
    if os.path.realpath(file) == os.path.realpath(record):
        raise JaxmarkError(f"{file} cannot be both the file and its record; give another name for one of them.")
    old = None
    with ExitStack() as alone:
        try:
            with replacing(file, may_stay) as draft, replacing(record) as record_draft:
                pair = Pair(draft, record_draft)
                yield pair
                alone.enter_context(_locked({Path(os.path.realpath(path)).parent for path in (file, record)}))
                # Another process may have written them meanwhile.
                refuse_existing_pair(file, record, overwrite=overwrite, original=original)
                old = _Old.of(file, record)
                old.set_aside()
        except BaseException:
            if old is not None:
                old.restore()
            raise
        kept = old.discard()
        if kept is not None:
            pair.kept = str(kept if record.is_symlink() else record.with_name(kept.name))


@contextmanager
def _locked(folders: Collection[Path]) -> Iterator[None]:
    """Hold the locks of folders, which the system releases if the process is killed; some folders have none.

    Raises:
        JaxmarkError: if another process holds one of them for a minute.
    """
    with ExitStack() as opened:
        # A folder may have several names, and two processes must take its locks in the same order.
        places = {(status.st_dev, status.st_ino): folder for folder in folders for status in [folder.stat()]}
        for _, folder in sorted(places.items()):
            with suppress(OSError):
                descriptor = os.open(folder, os.O_RDONLY)
                opened.callback(os.close, descriptor)
                _lock(descriptor, folder)
        yield


def _lock(descriptor: int, folder: Path) -> None:
    if fcntl is None:
        return
    end = time.monotonic() + _LOCK_SECONDS
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > end:
                raise JaxmarkError(
                    f"Another process has locked {folder} for {_LOCK_SECONDS:g} s; end it, or give another folder."
                ) from None
            time.sleep(_LOCK_PAUSE)


class _Old(NamedTuple):
    """The file and the record of a pair, and the names that the old ones have while they are replaced."""

    file: Path
    record: Path
    aside: Path | None  # the old file; None if there is none
    copy: Path | None  # a copy of the old record; None if there is none

    @classmethod
    def of(cls, file: Path, record: Path) -> "_Old":
        """Choose names that no file has yet."""
        file, record = (Path(os.path.realpath(path)) for path in (file, record))
        names = ([path.with_name(f"old-{number}-{path.name}") for path in (file, record)] for number in count(1))
        taken = {file, record}
        aside, copy = next(pair for pair in names if not any(path in taken or path.exists() for path in pair))
        return cls(file, record, aside if file.exists() else None, copy if record.exists() else None)

    def set_aside(self) -> None:
        """Copy an existing record, and then rename an existing file."""
        if self.copy is not None:
            write_atomically(self.copy, read_file(self.record), mode=stat.S_IMODE(self.record.stat().st_mode))
        if self.aside is not None:
            self.file.rename(self.aside)

    def restore(self) -> None:
        """Undo as much as was done, unless the new pair is complete: give record and file their names again."""
        if not self.file.exists():
            if self.copy is None:
                self.record.unlink(missing_ok=True)
            elif self.copy.exists() and not (self.record.exists() and read_file(self.record) == read_file(self.copy)):
                write_atomically(self.record, read_file(self.copy))
            if self.aside is not None:
                self.aside.rename(self.file)
        self._drop_equal()

    def discard(self) -> Path | None:
        """Delete the old file, and a copy of the old record that is equal to the new one; return a copy that stays."""
        if self.aside is not None:
            with suppress(OSError):  # the new pair is complete
                self.aside.unlink()
        self._drop_equal()
        return self.copy if self.copy is not None and self.copy.exists() else None

    def _drop_equal(self) -> None:
        if self.copy is not None and self.copy.exists() and read_file(self.copy) == read_file(self.record):
            self.copy.unlink()
