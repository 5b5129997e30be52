"""Cells of a study on many workers: a line of a file for each that is finished, so that a killed run goes on.

Any `concurrent.futures` executor will do: processes here, or the workers of Dask, Ray or MPI.
"""

import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from jaxmark.errors import JaxmarkError

Cell = tuple[str | int | float, ...]  # what JSON keeps as it is
Row = Mapping[str, Any]
Pool = Callable[[], AbstractContextManager[Executor]]
_ATTEMPTS = 3  # pools in a row that may break without finishing a cell


def processes(workers: int) -> Pool:
    """What makes a pool of so many processes; forks of a started JAX would hang, so they are spawned."""
    return lambda: ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))


def run(
    cells: Sequence[Cell],
    work: Callable[[Cell], Row],
    pool: Pool,
    output: str | os.PathLike[str],
    say: Callable[[str], None] = lambda line: None,
) -> list[dict[str, Any]]:
    """Work on what is not finished, with a new pool for one that breaks.

    Args:
        cells: each once; their rows are told apart by them.
        work: from a cell to its results, which JSON can hold; a function of a module, if workers are processes.
        pool: makes an executor; called again where one breaks, as a pool of processes does when one is killed.
        output: a file of JSON lines, `{"cell": [...], ...}`, on disk one by one. It may hold other cells, too.
        say: is called with a line about the progress after each cell.

    Returns:
        The rows of the cells, in their order, those of earlier runs too.

    Raises:
        JaxmarkError: if pools break without a result.
        Exception: what `work` raises; what was finished until then stays.
    """
    target, broken, start, count = Path(output), 0, time.monotonic(), None
    while left := _left(cells, target):
        count = len(left) if count is None else count
        missing = len(left)
        try:
            with pool() as executor:
                futures = {executor.submit(work, cell): cell for cell in left}
                try:
                    for future in as_completed(futures):
                        _append(target, {"cell": futures[future], **future.result()})
                        broken, missing = 0, missing - 1
                        pace = (time.monotonic() - start) / (count - missing)
                        say(f"{len(cells) - missing}/{len(cells)}, about {missing * pace / 60:.0f} min left")
                except BaseException:  # an interruption, too: what has not begun does not begin
                    executor.shutdown(wait=False, cancel_futures=True)
                    raise
        except BrokenExecutor as error:
            broken += 1
            if broken == _ATTEMPTS:
                raise JaxmarkError(f"{broken} pools of workers broke without finishing a cell: {error}") from None
            say(f"{error} A new pool goes on.")
    rows = {_cell(row): row for row in finished(target)}
    return [rows[cell] for cell in cells]


def finished(output: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Rows that a file holds; a last line that a killed run has torn is cut off."""
    path = Path(output)
    text = path.read_bytes() if path.exists() else b""
    whole = text[: text.rfind(b"\n") + 1]
    if whole != text:
        os.truncate(path, len(whole))
    return [json.loads(line) for line in whole.splitlines()]


def _left(cells: Iterable[Cell], output: Path) -> list[Cell]:
    there = {_cell(row) for row in finished(output)}
    return [cell for cell in cells if cell not in there]


def _cell(row: Row) -> Cell:
    return tuple(row["cell"])


def _append(output: Path, row: Row) -> None:
    """One write for a whole line, on disk before the next."""
    with output.open("ab", buffering=0) as file:
        file.write(json.dumps(row).encode() + b"\n")
        os.fsync(file.fileno())
