"""Many suspects, one after the other, by any number of workers; results are in a file, from which a run resumes.

Any `concurrent.futures` executor will do, as for studies (`jaxmark.evaluation.cells`): processes here, or the workers
of a Dask cluster. Workers open the catalogue for reading only. Suspects come from an iterator, of which only as many
are taken at a time as workers can do.
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

DEAD_SUFFIX = ".dead.jsonl"  # of the file with what could not be read
_AHEAD = 4  # suspects that are taken for each worker, so that none waits
_MOST_BREAKS = 2  # times that a suspect may break a pool while it is alone in it


@dataclass(frozen=True)
class Plan:
    """The work on each suspect; workers keep what they have prepared for it."""

    catalogue: Path
    keys: tuple[bytes | Path, ...]  # keys, or files that each worker reads, so that no key is sent to it
    options: tuple[tuple[str, Any], ...] = ()  # of `Finder`
    after: Callable[[], object] | None = field(default=None, compare=False)  # called after each suspect; at top level


class Done(NamedTuple):
    """The result of a run, counted."""

    named: int
    nobodys: int
    dead: int  # suspects that could not be read, or killed their workers


def find_each(
    plan: Plan,
    suspects: Iterable[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    workers: int | Pool = 1,
    say: Callable[[str], None] = lambda line: None,
) -> Generator[dict[str, Any], None, None]:
    """Find the originals of suspects; yields each verdict once it is in the file, in no order.

    Args:
        plan: the catalogue, the keys, and how to look.
        suspects: files.
        output: file of JSON lines, one for each suspect, which grows. Suspects in it, or among the dead letters beside
            it (`output` and ".dead.jsonl"), are not done again; delete the latter to have them tried again.
        workers: number of processes, where 1 is this process; or a function that makes an executor.
        say: function that is called with a line about what goes wrong.

    Raises:
        JaxmarkError: if the catalogue or a key cannot be read, or a file cannot be written.
    """
    target, dead = Path(output), Path(f"{os.fspath(output)}{DEAD_SUFFIX}")
    known = _finished(target) | _finished(dead)
    _finder(plan).prepare()  # refuses before any worker starts
    pool, ahead = _pool(workers)
    writable = os.access(plan.catalogue, os.W_OK) and os.access(plan.catalogue.resolve().parent, os.W_OK)
    if not writable:
        say("The catalogue cannot be written; verdicts are not kept in it.")
    with Catalogue(plan.catalogue) if writable else nullcontext() as catalogue:
        for path, row in _run(pool, ahead, plan, _fresh(suspects, known), say):
            line = {"suspect": path, "identity": _identity(path), **row}
            if catalogue is not None and "refused" not in row:
                catalogue.record_verdict(row["suspect_sha256"], path, row)
            append(dead if "refused" in row else target, line)
            yield line


def count(rows: Iterable[Mapping[str, Any]]) -> Done:
    """Count the results of `find_each`, which runs it."""
    counts = Counter("dead" if "refused" in row else "named" if row["named"] else "nobodys" for row in rows)
    return Done(counts["named"], counts["nobodys"], counts["dead"])


def mesh_files_below(folder: Path) -> Iterator[Path]:
    """Yield the mesh files of a folder and of all below it, in order; links to folders are not followed."""
    for place, folders, files in os.walk(folder):
        folders.sort()
        yield from (
            Path(place, name)
            for name in sorted(files)
            if Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")
        )


def _fresh(suspects: Iterable[str | os.PathLike[str]], known: set[bytes]) -> Iterator[str]:
    """Yield the suspects that are not done, each once."""
    for suspect in suspects:
        path = os.path.realpath(suspect)
        digest = _digest(_identity(path))
        if digest not in known:
            known.add(digest)
            yield path


def _identity(path: str) -> list[str | int]:
    """Return values that distinguish a suspect from others without reading it."""
    try:
        found = Path(path).stat()
    except (OSError, ValueError):
        return [path]
    return [path, found.st_size, found.st_mtime_ns]


def _digest(identity: list[str | int]) -> bytes:
    return hashlib.sha256(json.dumps(identity).encode()).digest()[:12]


def _finished(path: Path) -> set[bytes]:
    """Read the identities in a file; a last line that a killed run left incomplete is cut off."""
    found: set[bytes] = set()
    if not path.exists():
        return found
    whole = 0
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                if not line.endswith(b"\n"):
                    break
                whole += len(line)
                try:
                    found.add(_digest(json.loads(line)["identity"]))
                except (ValueError, KeyError, TypeError):
                    raise JaxmarkError(
                        f"Line {number} of {path} is no verdict; delete that line to have it done again."
                    ) from None
        if whole != path.stat().st_size:
            os.truncate(path, whole)
    except OSError as error:
        raise JaxmarkError(f"Cannot use {path}: {error.strerror or error}.") from None
    return found


def _pool(workers: int | Pool) -> tuple[Pool, int]:
    """Return a maker of executors, and the number of suspects to give it at a time."""
    if not isinstance(workers, int):
        return workers, _AHEAD * (os.cpu_count() or 1)
    if workers < 1:
        raise JaxmarkError(f"Suspects need at least one worker, got {workers}.")
    pool = processes(workers) if workers > 1 else partial(ThreadPoolExecutor, 1)
    return pool, _AHEAD * workers


def _run(
    pool: Pool, ahead: int, plan: Plan, suspects: Iterator[str], say: Callable[[str], None]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the results of suspects as they come: the path, and the verdict or a refusal.

    Whenever a pool breaks, the suspects in it are done again one at a time, so that the one that breaks it is known.
    """
    alone: deque[str] = deque()
    breaks: Counter[str] = Counter()
    while True:
        running: dict[Future[dict[str, Any]], str] = {}
        try:
            with pool() as executor:
                try:
                    while True:
                        most = 1 if alone else ahead
                        while len(running) < most and (path := alone.popleft() if alone else next(suspects, None)):
                            alone.appendleft(path)  # where it stays if the executor is broken already
                            running[executor.submit(work, plan, path)] = path
                            alone.popleft()
                        if not running:
                            return
                        done = wait(running, return_when=FIRST_COMPLETED).done
                        for future in [one for one in running if one in done]:
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
                yield path, {"refused": "It killed the worker that read it."}
            alone.extend(lost)
            say(f"{error or 'A pool broke.'} A new pool goes on, one suspect at a time for those that were in it.")


def _outcome(future: Future[dict[str, Any]]) -> dict[str, Any]:
    try:
        return future.result()
    except (BrokenExecutor, CancelledError):
        raise
    except Exception as error:  # such as Dask's KilledWorker
        return {"refused": " ".join(f"{type(error).__name__}: {error}".split())}


def work(plan: Plan, path: str) -> dict[str, Any]:
    """Find the originals of a suspect, in a worker; a refusal is a result. At the top level, where workers find it."""
    start = time.perf_counter()
    try:
        found = _finder(plan).find(path).as_json()
    except JaxmarkError as error:
        return {"refused": str(error)}
    finally:
        if plan.after is not None:
            plan.after()
    return {**found, "seconds": round(time.perf_counter() - start, 2)}


@lru_cache(maxsize=1)
def _finder(plan: Plan) -> Finder:
    """Make the finder of this process, which opens the catalogue for reading only."""
    keys = [load_key(key) if isinstance(key, Path) else key for key in plan.keys]
    return Finder(Catalogue(plan.catalogue, read_only=True), keys, **dict(plan.options))
