"""Process all mesh files of a folder, one after another or by several processes."""

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

from jaxmark.app.output import FileOutcome, Status, error_text
from jaxmark.app.process import end_by_exception
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.cells import processes
from jaxmark.files import SUFFIXES
from jaxmark.files.programs import keep_programs, release_programs

_MOST_TOGETHER = 16  # most files in a batch, which a worker takes at once
_TURNS = 4  # least batches per worker, if there are enough files, so that all workers end at about the same time

Work = Callable[[Path], FileOutcome]


def mesh_files(folder: Path) -> list[Path]:
    """List the files of a folder with the suffix of a mesh format, sorted by name, without hidden files.

    Raises:
        JaxmarkError: if there is no such file.
    """
    files = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")
    )
    if not files:
        raise JaxmarkError(f"The folder {folder} has no mesh file ({', '.join(SUFFIXES)}).")
    return files


def each(files: Sequence[Path], work: Work, workers: int = 1) -> Generator[tuple[Path, FileOutcome], None, None]:
    """Call a function for each file, and yield the outcomes; a refused file does not stop the others.

    Meshes of similar size share compiled programs: the first mesh of a size takes seconds, later ones a fraction of a
    second. Therefore each worker takes batches of files of similar size, and outcomes of several workers come in no
    particular order. Close the iterator if you leave it before its end, so that its processes end.

    Args:
        files: the files.
        work: function that processes one file; each of several workers has its own copy of it, and keeps the copy.
        workers: number of processes.

    Raises:
        JaxmarkError: if a worker is killed.
    """
    if workers == 1:
        yield from ((file, _run(work, file)) for file in files)
        return
    largest_first = sorted(files, key=lambda file: -file.stat().st_size)
    count = min(_MOST_TOGETHER, -(-len(files) // (_TURNS * workers)))
    batches = [largest_first[start : start + count] for start in range(0, len(files), count)]
    pool = processes(min(workers, len(batches)), begin_worker)()
    pickled = pickle.dumps(work)
    try:
        for future in as_completed([pool.submit(_work_on, pickled, batch) for batch in batches]):
            yield from future.result()
    except BaseException as error:
        for process in multiprocessing.active_children():
            process.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise JaxmarkError(
                "A worker was killed, perhaps because memory ran out; finished files are kept. Use fewer --workers."
            ) from None
        raise
    pool.shutdown()


def _run(work: Work, file: Path) -> FileOutcome:
    try:
        return work(file)
    except Exception as error:
        text = error_text(error)
        return FileOutcome({"refused": text}, (f"refused. {text}",), Status.REFUSED)
    finally:
        release_programs()


@lru_cache(maxsize=1)
def _unpickled(work: bytes) -> Work:
    """Unpickle the work; it is cached, so that an original it has prepared serves all files of this worker."""
    return pickle.loads(work)


def _work_on(work: bytes, files: Sequence[Path]) -> list[tuple[Path, FileOutcome]]:
    """Process a batch of files in a worker.

    SystemExit ends the whole worker process, because the pool would catch the exception and continue.
    """
    try:
        return [(file, _run(_unpickled(work), file)) for file in files]
    except SystemExit as end:
        os._exit(end.code if isinstance(end.code, int) else 1)


def begin_worker() -> None:
    """Set up a worker process: it ignores Ctrl+C, and ends when its parent process asks it to or ends itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_by_exception()
    keep_programs()
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)
