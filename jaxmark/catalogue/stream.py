"""Identification of many suspects by any number of workers, with results in a file from which a run resumes.

Workers are those of any `concurrent.futures` executor, as for studies (`jaxmark.evaluation.cells`): local processes, or
a Dask cluster. Workers open the catalogue for reading only. Suspects are taken from an iterator, only a few per worker
at a time.
"""

import hashlib
import json
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import nullcontext
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from jaxmark.catalogue.catalogue import Catalogue
from jaxmark.catalogue.identification import Finder
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.cells import Pool, append, processes
from jaxmark.files import SUFFIXES
from jaxmark.watermark.coding.keys import load_key

DEAD_SUFFIX = ".dead.jsonl"  # suffix of the file that lists suspects that could not be read
_AHEAD = 4  # number of suspects that are submitted per worker, so that no worker waits
_MOST_BREAKS = 2  # number of times that a suspect may break a pool in which it is alone, before it is given up


@dataclass(frozen=True)
class Plan:
    """The work on each suspect: the catalogue, the keys and the options; workers cache the finder of a plan."""

    catalogue: Path
    keys: tuple[bytes | Path, ...]  # keys; or files that each worker reads, so that no key is sent to it
    options: tuple[tuple[str, Any], ...] = ()  # options of `Finder`
    after: Callable[[], object] | None = field(default=None, compare=False)  # module-level function, called per suspect


class Done(NamedTuple):
    """The numbers of results of a run."""

    named: int  # suspects whose original is named
    nobodys: int  # suspects for which no original is named
    dead: int  # suspects that could not be read, or killed their workers


def find_each(
    plan: Plan,
    suspects: Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    workers: int | Pool = 1,
    log: Callable[[str], None] = lambda line: None,
) -> Generator[dict[str, Any], None, None]:
    """Find the originals of suspects; yields each verdict after it is in the file, in arbitrary order.

    Args:
        plan: the catalogue, the keys and the options.
        suspects: files.
        output: file to which a line of JSON is appended for each suspect. Suspects that could not be read are listed in
            a second file, whose name is `output` followed by ".dead.jsonl". Suspects in either file are skipped; delete
            the second file to try them again.
        workers: number of processes, where 1 is this process; or a function that makes an executor.
        log: callback, called with a line about each problem.

    Raises:
        JaxmarkError: if the catalogue or a key cannot be read, or a file cannot be written.
    """
    target, dead = Path(output), Path(f"{os.fspath(output)}{DEAD_SUFFIX}")
    finished = _finished(target) | _finished(dead)
    _finder(plan).prepare()  # raises errors before any worker starts
    pool, ahead = _pool(workers)
    writable = os.access(plan.catalogue, os.W_OK) and os.access(plan.catalogue.resolve().parent, os.W_OK)
    if not writable:
        log("The catalogue cannot be written; verdicts are not stored in it.")
    with Catalogue(plan.catalogue) if writable else nullcontext() as catalogue:
        for path, row in _run(pool, ahead, plan, _unfinished(suspects, finished), log):
            line = {"suspect": path, "identity": _identity(path), **row}
            if catalogue is not None and "refused" not in row:
                try:
                    catalogue.record_verdict(row["suspect_sha256"], path, row)
                except JaxmarkError as error:  # such as for a name that is not UTF-8
                    log(f"The verdict on {path} is not stored in the catalogue: {error}")
            append(dead if "refused" in row else target, line)
            yield line


def count(rows: Iterable[Mapping[str, Any]]) -> Done:
    """Run `find_each` by consuming its results, and count them."""
    counts = Counter("dead" if "refused" in row else "named" if row["named"] else "nobodys" for row in rows)
    return Done(counts["named"], counts["nobodys"], counts["dead"])


def mesh_files_below(folder: Path) -> Iterator[Path]:
    """Yield the mesh files of a folder and its subfolders, in order; links to folders are not followed."""
    for place, folders, files in os.walk(folder):
        folders.sort()
        yield from (
            Path(place, name)
            for name in sorted(files)
            if Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")
        )


def _unfinished(suspects: Iterable[str | os.PathLike[str]], finished: set[bytes]) -> Iterator[str]:
    """Yield the suspects that are not finished, each once."""
    for suspect in suspects:
        try:
            path = os.path.realpath(suspect)
        except ValueError:  # a NUL in its name: it is refused when it is read
            path = os.fspath(suspect)
        digest = _digest(_identity(path))
        if digest not in finished:
            finished.add(digest)
            yield path


def _identity(path: str) -> list[str | int]:
    """Return values that identify a suspect without reading it: path, size and time of change."""
    try:
        status = Path(path).stat()
    except (OSError, ValueError):
        return [path]
    return [path, status.st_size, status.st_mtime_ns]


def _digest(identity: list[str | int]) -> bytes:
    return hashlib.sha256(json.dumps(identity).encode()).digest()[:12]


def _finished(path: Path) -> set[bytes]:
    """Read the digests of the finished suspects in a file; an incomplete last line of a killed run is removed."""
    finished: set[bytes] = set()
    if not path.exists():
        return finished
    complete = 0  # bytes of complete lines
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                if not line.endswith(b"\n"):
                    break
                complete += len(line)
                try:
                    finished.add(_digest(json.loads(line)["identity"]))
                except (ValueError, KeyError, TypeError):
                    raise JaxmarkError(
                        f"Line {number} of {path} is no verdict; delete this line, and the suspect is read again."
                    ) from None
        if complete != path.stat().st_size:
            os.truncate(path, complete)
    except OSError as error:
        raise JaxmarkError(f"Cannot use {path}: {error.strerror or error}.") from None
    return finished


def _pool(workers: int | Pool) -> tuple[Pool, int]:
    """Return a function that makes executors, and the number of suspects to submit at a time."""
    if not isinstance(workers, int):
        return workers, _AHEAD * (os.cpu_count() or 1)
    if workers < 1:
        raise JaxmarkError(f"The number of workers must be at least 1, got {workers}.")
    pool = processes(workers) if workers > 1 else partial(ThreadPoolExecutor, 1)
    return pool, _AHEAD * workers


def _run(
    pool: Pool, ahead: int, plan: Plan, suspects: Iterator[str], log: Callable[[str], None]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the results of suspects as they are finished: the path, and the verdict or a refusal.

    If a pool breaks, its suspects are read again one at a time, to find the one that breaks the pool.
    """
    singly: deque[str] = deque()  # suspects that are read one at a time
    breaks: Counter[str] = Counter()
    while True:
        running: dict[Future[dict[str, Any]], str] = {}
        try:
            with pool() as executor:
                try:
                    while True:
                        most = 1 if singly else ahead
                        while len(running) < most and (path := singly.popleft() if singly else next(suspects, None)):
                            singly.appendleft(path)  # it stays in the queue if the executor is broken already
                            running[executor.submit(work, plan, path)] = path
                            singly.popleft()
                        if not running:
                            return
                        done = wait(running, return_when=FIRST_COMPLETED).done
                        for future in [future for future in running if future in done]:
                            path, row = running[future], _outcome(future)
                            del running[future], breaks[path]
                            yield path, row
                except BaseException:
                    executor.shutdown(wait=False, cancel_futures=True)
                    raise
        except (BrokenExecutor, CancelledError) as error:
            lost = list(running.values())
            if len(lost) == 1:
                breaks[lost[0]] += 1
            for path in [path for path in lost if breaks[path] >= _MOST_BREAKS]:
                lost.remove(path)
                yield path, {"refused": "Reading it killed the worker."}
            singly.extend(lost)
            log(f"{error or 'A pool broke.'} A new pool continues; the suspects of the old one are read one at a time.")


def _outcome(future: Future[dict[str, Any]]) -> dict[str, Any]:
    try:
        return future.result()
    except (BrokenExecutor, CancelledError):
        raise
    except Exception as error:  # such as Dask's KilledWorker
        return {"refused": " ".join(f"{type(error).__name__}: {error}".split())}


def work(plan: Plan, path: str) -> dict[str, Any]:
    """Find the originals of a suspect in a worker; a refusal is a result, too.

    This function is at the top level of the module, so that worker processes can import it.
    """
    start = time.perf_counter()
    try:
        values = _finder(plan).find(path).as_json()
    except JaxmarkError as error:
        return {"refused": str(error)}
    finally:
        if plan.after is not None:
            plan.after()
    return {**values, "seconds": round(time.perf_counter() - start, 2)}


@lru_cache(maxsize=1)
def _finder(plan: Plan) -> Finder:
    """Make the finder of this process, which opens the catalogue for reading only."""
    keys = [load_key(key) if isinstance(key, Path) else key for key in plan.keys]
    return Finder(Catalogue(plan.catalogue, read_only=True), keys, **dict(plan.options))
