"""A corpus marked, attacked and read on many workers: python benchmarks/corpus.py MESH... --output corpus.jsonl.

One cell for each mesh, key and attack, run by any `concurrent.futures` executor: processes, or Dask's workers. Each
finished cell is a line of the output, and is skipped when the same command is run again, after whatever ended the last
run. Where a worker is killed, a new pool goes on with what is left.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import AbstractContextManager, contextmanager
from functools import lru_cache
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import jaxmark as jm
from jaxmark.mesh import Mesh

Cell = tuple[str, int, str]  # mesh, key's number, attack
_ATTEMPTS = 3  # pools in a row that may break without finishing a cell


@lru_cache(maxsize=1)  # cells of one mesh and key come one after another
def marked(mesh: str, key: int) -> tuple[jm.Marker, Mesh, bytes]:
    """A marker, its mark and its message."""
    rng = np.random.default_rng(key)
    marker, message = jm.make_marker(jm.load_mesh(mesh), rng.bytes(32)), rng.bytes(8)
    return marker, marker.embed(message)[0], message


def run_cell(cell: Cell) -> dict[str, Any]:
    """Mark, attack and read; a refusal is a result too."""
    mesh, key, attack = cell
    start = time.perf_counter()
    row: dict[str, Any] = {"cell": cell}
    try:
        marker, mark, message = marked(mesh, key)
        kind, strength = attack.split()
        suspect = mark if kind == "none" else jm.attack(mark, kind, float(strength), seed=key)
        found = marker.detect(suspect)
        row |= {"reads": found.message == message, "log10_p": found.log10_p}
    except jm.JaxmarkError as error:
        row |= {"refused": str(error)}
    return row | {"seconds": time.perf_counter() - start, "worker": os.getpid()}


def finished(output: Path) -> set[Cell]:
    """Cells that have a line; a last line that a killed run has torn is cut off."""
    text = output.read_bytes() if output.exists() else b""
    whole = text[: text.rfind(b"\n") + 1]
    if whole != text:
        os.truncate(output, len(whole))
    return {tuple(json.loads(line)["cell"]) for line in whole.splitlines()}


def append(output: Path, row: dict[str, Any]) -> None:
    """One write for a whole line, on disk before the next."""
    with output.open("ab", buffering=0) as file:
        file.write(json.dumps(row).encode() + b"\n")
        os.fsync(file.fileno())


def run(cells: list[Cell], pool: Callable[[], AbstractContextManager[Executor]], output: Path) -> None:
    """Finish what is left, with a new pool for one that breaks; give up where pools break without a result."""
    broken = 0
    while left := [cell for cell in cells if cell not in finished(output)]:
        try:
            with pool() as executor:
                for future in as_completed([executor.submit(run_cell, cell) for cell in left]):
                    append(output, future.result())
                    broken = 0
        except BrokenExecutor as error:
            broken += 1
            if broken == _ATTEMPTS:
                raise
            print(f"{error} A new pool goes on.", flush=True)


def pools(name: str, workers: int) -> Callable[[], AbstractContextManager[Executor]]:
    """What makes an executor of so many processes; forks of a started JAX would hang, so they are spawned."""
    if name == "processes":
        return lambda: ProcessPoolExecutor(workers, get_context("spawn"))

    @contextmanager
    def dask() -> Iterator[Executor]:
        from distributed import Client

        with Client(n_workers=workers, threads_per_worker=1, dashboard_address=None) as client:
            yield client.get_executor(retries=_ATTEMPTS)

    return dask


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="+")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--keys", type=int, default=2)
    parser.add_argument("--attacks", nargs="+", default=["none 0", "noise 0.005", "smoothing 50", "quantisation 8"])
    parser.add_argument("--executor", choices=["processes", "dask"], default="processes")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    cells: list[Cell] = [*product(options.mesh, range(options.keys), options.attacks)]
    print(f"{len(cells)} cells, {len(finished(options.output).intersection(cells))} of them finished before")
    start = time.perf_counter()
    run(cells, pools(options.executor, options.workers), options.output)
    rows = [row for line in options.output.open() if tuple((row := json.loads(line))["cell"]) in cells]
    for attack in options.attacks:
        mine = [row for row in rows if row["cell"][2] == attack]
        print(f"{attack:<20} {sum(row.get('reads', False) for row in mine)}/{len(mine)} read")
    print(f"{time.perf_counter() - start:.1f} s, {len({row['worker'] for row in rows})} workers")


if __name__ == "__main__":
    from corpus import main  # by its own name, by which workers find its functions

    main()
