"""The mesh files of a folder, worked on one after another, or by several processes at once."""

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from multiprocessing import connection
from pathlib import Path

from jaxmark.app.output import FileOutcome, error_text
from jaxmark.app.process import end_by_exception, keep_programs, release_programs
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.cells import processes
from jaxmark.files import SUFFIXES

_MOST_TOGETHER = 16  # files that a worker takes at once
_TURNS = 4  # that each worker has at least, if there are enough files, so that all end at about the same time

Work = Callable[[Path], FileOutcome]


def mesh_files(folder: Path) -> list[Path]:
    """List the files of a folder that have a mesh format's suffix, by name; hidden files are left out.

    Raises:
        JaxmarkError: if there is no such file.
    """
    found = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")
    )
    if not found:
        raise JaxmarkError(f"The folder {folder} has no mesh file ({', '.join(SUFFIXES)}).")
    return found


def each(files: Sequence[Path], work: Work, workers: int = 1) -> Generator[tuple[Path, FileOutcome], None, None]:
    """Work on files, and tell of each; a file that is refused stops none of the others.

    Meshes of like size share compiled programs: the first of a size takes seconds, the next ones a fraction of one. So
    several workers take files of like size together, and what they have done comes in no order.
    Close the iterator if it is left before its end, so that its processes end, too.

    Args:
        files: the files.
        work: what to do; if there are several workers, each has a copy of its own, which it keeps.
        workers: number of processes.

    Raises:
        JaxmarkError: if a worker is killed.
    """
    if workers == 1:
        yield from ((file, _run(work, file)) for file in files)
        return
    largest_first = sorted(files, key=lambda file: -file.stat().st_size)
    count = min(_MOST_TOGETHER, -(-len(files) // (_TURNS * workers)))
    together = [largest_first[start : start + count] for start in range(0, len(files), count)]
    pool = processes(min(workers, len(together)), begin_worker)()
    held = pickle.dumps(work)
    try:
        for done in as_completed([pool.submit(_work_on, held, some) for some in together]):
            yield from done.result()
    except BaseException as error:
        for process in multiprocessing.active_children():
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise JaxmarkError(
                "A worker was killed, perhaps because memory ran out; what is finished is kept. Use fewer --workers."
            ) from None
        raise
    pool.shutdown()


def _run(work: Work, file: Path) -> FileOutcome:
    try:
        return work(file)
    except Exception as error:
        said = error_text(error)
        return FileOutcome({"refused": said}, f"refused. {said}", done=False, refused=True)
    finally:
        release_programs()


@lru_cache(maxsize=1)
def _kept(work: bytes) -> Work:
    """The work, which keeps from file to file what it has prepared."""
    return pickle.loads(work)


def _work_on(work: bytes, files: Sequence[Path]) -> list[tuple[Path, FileOutcome]]:
    """Tell of files, in a worker, which is ended while it works by ending the process: the pool would go on."""
    try:
        return [(file, _run(_kept(work), file)) for file in files]
    except SystemExit as end:
        os._exit(end.code if isinstance(end.code, int) else 1)


def begin_worker() -> None:
    """Set a worker up: whoever started it decides when it ends, and so does that process's own end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_by_exception()
    keep_programs()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)
