"""Run the cells of a study on many workers; each finished cell is appended to a file, from which a killed run resumes.

Workers are those of any `concurrent.futures` executor: local processes, or the workers of Dask, Ray or MPI.
"""

import json
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from jaxmark.errors import JaxmarkError
from jaxmark.files.atomic import read_file

Cell = tuple[str | int | float, ...]  # values that JSON keeps as they are
Row = Mapping[str, Any]
Pool = Callable[[], AbstractContextManager[Executor]]
_MAX_BROKEN_POOLS = 3  # most pools that may break one after another without finishing a cell


def processes(workers: int, begin: Callable[[], object] | None = None) -> Callable[[], ProcessPoolExecutor]:
    """Return a function that makes pools of processes, which are spawned because forks of a running JAX would hang.

    Each process first calls `begin`, a function at the top level of a module.
    """
    return lambda: ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin, (begin,))


def _begin(begin: Callable[[], object] | None) -> None:
    """Let this process end when its parent is killed; otherwise it would wait for work forever."""
    if (parent := multiprocessing.parent_process()) is not None:
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()
    if begin is not None:
        begin()


def run(
    cells: Sequence[Cell],
    work: Callable[[Cell], Row],
    pool: int | Pool,
    output: str | os.PathLike[str],
    log: Callable[[str], None] = lambda line: None,
    name: Callable[[Cell], str] = lambda cell: "",
    group: Callable[[Cell], Hashable] = lambda cell: cell,
) -> list[dict[str, Any]]:
    """Compute the cells that are not finished, with a new pool whenever one breaks.

    Args:
        cells: the cells, each once; they identify their rows.
        work: function from a cell to its results, which must be JSON values; it must be at the top level of a module if
            the workers are processes.
        pool: number of processes, where 1 is this process; or a function that makes an executor. It is called again
            when an executor breaks, for example because a process is killed.
        output: file of JSON lines, `{"cell": [...], ...}`; each line is written to disk at once. The file may contain
            other cells, too.
        log: callback, called with a line about the progress after each cell.
        name: function that names a cell in such a line.
        group: function that returns the same value for cells with work in common, which one worker computes one after
            another. A run that is killed or fails loses the cells of a group that is not finished.

    Returns:
        The rows of the cells in their order, including those of earlier runs.

    Raises:
        JaxmarkError: if three pools in a row break without finishing a cell.
        Exception: whatever `work` raises; cells that were finished before are kept.
    """
    target, broken, start, count = Path(output), 0, time.monotonic(), None
    if isinstance(pool, int):
        pool = processes(pool) if pool > 1 else partial(ThreadPoolExecutor, 1)
    rows = _finished_rows(target)
    while left := [cell for cell in cells if cell not in rows]:
        count, missing = count or len(left), len(left)
        try:
            with pool() as executor:
                futures = {executor.submit(_work_through, work, some): some for some in _grouped(left, group)}
                try:
                    for cell, row in _as_finished(futures):
                        append(target, {"cell": cell, **row})
                        broken, missing = 0, missing - 1
                        pace = (time.monotonic() - start) / (count - missing)
                        done = f"{len(cells) - missing}/{len(cells)} {name(cell)}".rstrip()
                        log(f"{done}, {left_over(missing * pace)}")
                except BaseException:  # also an interruption: cells that have not begun are cancelled
                    executor.shutdown(wait=False, cancel_futures=True)
                    raise
        except BrokenExecutor as error:
            broken += 1
            if broken == _MAX_BROKEN_POOLS:
                first = f", the first of which is {name(left[0])}" if name(left[0]) else ""
                raise JaxmarkError(
                    f"{broken} pools of workers broke without finishing a cell of {missing}{first}: {error}"
                ) from None
            log(f"{error} A new pool continues.")
        rows = _finished_rows(target)
    return [rows[cell] for cell in cells]


def _grouped(some: Sequence[Cell], group: Callable[[Cell], Hashable]) -> list[list[Cell]]:
    groups: dict[Hashable, list[Cell]] = {}
    for cell in some:
        groups.setdefault(group(cell), []).append(cell)
    return list(groups.values())


def _work_through(work: Callable[[Cell], Row], some: Sequence[Cell]) -> list[Row]:
    return [work(cell) for cell in some]


def _as_finished(futures: Mapping[Future[list[Row]], Sequence[Cell]]) -> Iterator[tuple[Cell, Row]]:
    for future in as_completed(futures):
        yield from zip(futures[future], future.result(), strict=True)


def _finished_rows(output: Path) -> dict[Cell, dict[str, Any]]:
    return {tuple(row["cell"]): row for row in load_finished(output)}


def left_over(seconds: float) -> str:
    """Express the remaining time in words: seconds, minutes or hours."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"about {seconds / size:.0f} {unit} left"
    return f"about {seconds:.0f} s left"


def load_finished(output: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Load the rows of a file; an incomplete last line of a killed run is removed.

    Raises:
        JaxmarkError: if the file cannot be read, or a line is not a row.
    """
    path = Path(output)
    try:
        text = read_file(path) if path.exists() else b""
    except OSError as error:
        raise JaxmarkError(f"Cannot read {path}: {error.strerror or error}.") from None
    whole = text[: text.rfind(b"\n") + 1]
    if whole != text:
        os.truncate(path, len(whole))
    return [_row(line, path, number) for number, line in enumerate(whole.splitlines(), 1)]


def _row(line: bytes, path: Path, number: int) -> dict[str, Any]:
    row: Any = None
    with suppress(ValueError, RecursionError):
        row = json.loads(line)
    cell = row.get("cell") if isinstance(row, dict) else None
    if not isinstance(cell, list) or not all(isinstance(value, str | int | float) for value in cell):
        raise JaxmarkError(f"Line {number} of {path} is no row of a study; delete the line to compute its cell again.")
    return row


def append(output: Path, row: Row) -> None:
    """Append a row, and wait until it is on disk; a full disk may leave a part of the line, which readers remove.

    Raises:
        JaxmarkError: if it cannot be written.
    """
    try:
        with output.open("ab") as file:
            file.write(json.dumps(row).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise JaxmarkError(f"Cannot write {output}: {error.strerror or error}.") from None
