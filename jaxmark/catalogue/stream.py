"""Many suspects, one after the other, by any number of workers; what is done is in a file, from which it resumes.

Any `concurrent.futures` executor will do, as for studies (`jaxmark.evaluation.cells`): processes here, or the workers
of a Dask cluster. Workers open the catalogue for reading only. Suspects come from an iterator, of which only as many
are taken at a time as workers can do.
"""

import hashlib
import json
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

from jaxmark.catalogue.catalogue import Catalogue
from jaxmark.catalogue.finding import Finder
from jaxmark.errors import JaxmarkError
from jaxmark.evaluation.cells import Pool, append, processes
from jaxmark.files import SUFFIXES
from jaxmark.watermark.coding.keys import load_key

DEAD_SUFFIX = ".dead.jsonl"  # of the file with what could not be read
_AHEAD = 4  # suspects that are taken for each worker, so that none waits
_MOST_BREAKS = 2  # times that a suspect may break a pool while it is alone in it


@dataclass(frozen=True)
class Plan:
    """What workers do with each suspect; they keep what they have prepared for it."""

    catalogue: Path
    keys: tuple[bytes | Path, ...]  # keys, or files that each worker reads, so that no key is sent to it
    options: tuple[tuple[str, Any], ...] = ()  # of `Finder`
    after: Callable[[], object] | None = field(default=None, compare=False)  # called after each suspect; at top level


class Done(NamedTuple):
    """How a run ended."""

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
        output: file of JSON lines, one for each suspect, which grows. What is in it, or among the dead letters beside
            it (`output` and ".dead.jsonl"), is not done again; delete the latter to have them tried again.
        workers: number of processes, where 1 is this process; or a function that makes an executor.
        say: function that is called with a line about what goes wrong.

    Raises:
        JaxmarkError: if the catalogue or a key cannot be read, or a file cannot be written.
    """
    target, dead = Path(output), Path(f"{os.fspath(output)}{DEAD_SUFFIX}")
    known = _finished(target) | _finished(dead)
    _finder(plan).prepare()  # refuses before any worker starts
    pool, ahead = _pool(workers)
    with _Keeper(plan, say) as keep:
        for path, row, refused in _run(pool, ahead, plan, _fresh(suspects, known), say):
            line = {"suspect": path, "identity": _identity(path), **row}
            if not refused:
                keep(path, row)
            append(dead if refused else target, line)
            yield line


def count(rows: Iterable[Mapping[str, Any]]) -> Done:
    """Count what `find_each` yields, and so let it run."""
    counts = {"named": 0, "nobodys": 0, "dead": 0}
    for row in rows:
        counts["dead" if "refused" in row else "named" if row["named"] else "nobodys"] += 1
    return Done(**counts)


def mesh_files_below(folder: Path) -> Iterator[Path]:
    """The mesh files of a folder and of all below it, in order; links to folders are not followed."""
    for place, folders, files in os.walk(folder):
        folders.sort()
        yield from (
            Path(place, name)
            for name in sorted(files)
            if Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")
        )


def _fresh(suspects: Iterable[str | os.PathLike[str]], known: set[bytes]) -> Iterator[str]:
    """Suspects that are not done, each once."""
    for suspect in suspects:
        path = os.path.realpath(suspect)
        digest = _digest(_identity(path))
        if digest not in known:
            known.add(digest)
            yield path


def _identity(path: str) -> list[str | int]:
    """What tells a suspect from others without reading it."""
    try:
        found = Path(path).stat()
    except (OSError, ValueError):
        return [path]
    return [path, found.st_size, found.st_mtime_ns]


def _digest(identity: list[str | int]) -> bytes:
    return hashlib.sha256(json.dumps(identity).encode()).digest()[:12]


def _finished(path: Path) -> set[bytes]:
    """What a file has; a last line that a killed run left incomplete is cut off.

    Raises:
        JaxmarkError: if the file cannot be read, or a line is damaged.
    """
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


class _Keeper:
    """Keeps verdicts in the catalogue, unless it cannot be written."""

    def __init__(self, plan: Plan, say: Callable[[str], None]) -> None:
        writable = os.access(plan.catalogue, os.W_OK) and os.access(plan.catalogue.resolve().parent, os.W_OK)
        self._catalogue = Catalogue(plan.catalogue) if writable else None
        if not writable:
            say("The catalogue cannot be written; verdicts are not kept in it.")

    def __enter__(self) -> Callable[[str, Mapping[str, Any]], None]:
        return self._keep

    def __exit__(self, *error: object) -> None:
        if self._catalogue is not None:
            self._catalogue.close()

    def _keep(self, path: str, row: Mapping[str, Any]) -> None:
        if self._catalogue is not None:
            self._catalogue.record_verdict(row["suspect_sha256"], path, row)


def _pool(workers: int | Pool) -> tuple[Pool, int]:
    """A maker of executors, and how many suspects to give it at a time."""
    if not isinstance(workers, int):
        return workers, _AHEAD * (os.cpu_count() or 1)
    if workers < 1:
        raise JaxmarkError(f"Suspects need at least one worker, got {workers}.")
    pool = processes(workers) if workers > 1 else partial(ThreadPoolExecutor, 1)
    return pool, _AHEAD * workers


def _run(
    pool: Pool, ahead: int, plan: Plan, suspects: Iterator[str], say: Callable[[str], None]
) -> Iterator[tuple[str, dict[str, Any], bool]]:
    """Results of suspects as they come: the path, what was found, and whether that is a refusal.

    Whenever a pool breaks, what was in it is done again one at a time, so that what breaks it is known.
    """
    alone: deque[str] = deque()
    breaks: dict[str, int] = {}
    more = True
    while more or alone:
        running: dict[Future[dict[str, Any]], str] = {}
        try:
            with pool() as executor:
                try:
                    while True:
                        more = _fill(executor, running, plan, suspects, alone, ahead)
                        if not running:
                            break
                        done = wait(running, return_when=FIRST_COMPLETED).done
                        for future in [one for one in running if one in done]:
                            path = running[future]
                            row, refused = _outcome(future)
                            del running[future]
                            breaks.pop(path, None)
                            yield path, row, refused
                except BaseException:
                    executor.shutdown(wait=False, cancel_futures=True)
                    raise
        except (BrokenExecutor, CancelledError) as error:
            lost = list(running.values())
            if len(lost) == 1:
                breaks[lost[0]] = breaks.get(lost[0], 0) + 1
            for path in [path for path in lost if breaks.get(path, 0) >= _MOST_BREAKS]:
                lost.remove(path)
                yield path, {"refused": "It killed the worker that read it."}, True
            alone.extend(lost)
            say(f"{error or 'A pool broke.'} A new pool goes on, one suspect at a time for those that were in it.")


def _fill(
    executor: Executor,
    running: dict[Future[dict[str, Any]], str],
    plan: Plan,
    suspects: Iterator[str],
    alone: deque[str],
    ahead: int,
) -> bool:
    """Give an executor more to do; returns whether there may be more suspects."""
    if alone:
        if not running:
            _submit(executor, running, plan, alone.popleft(), alone)
        return True
    while len(running) < ahead:
        path = next(suspects, None)
        if path is None:
            return False
        _submit(executor, running, plan, path, alone)
    return True


def _submit(
    executor: Executor, running: dict[Future[dict[str, Any]], str], plan: Plan, path: str, alone: deque[str]
) -> None:
    """Give an executor a suspect; one that is broken already gets it again when it is whole."""
    try:
        running[executor.submit(work, plan, path)] = path
    except BrokenExecutor:
        alone.appendleft(path)
        raise


def _outcome(future: Future[dict[str, Any]]) -> tuple[dict[str, Any], bool]:
    try:
        row = future.result()
    except (BrokenExecutor, CancelledError):
        raise
    except Exception as error:  # such as Dask's KilledWorker
        row = {"refused": " ".join(f"{type(error).__name__}: {error}".split())}
    return row, "refused" in row


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
    """The finder of this process, which opens the catalogue for reading only."""
    keys = [load_key(key) if isinstance(key, Path) else key for key in plan.keys]
    return Finder(Catalogue(plan.catalogue, read_only=True), keys, **dict(plan.options))
