"""Mark, attack and read a corpus on many workers: python benchmarks/speed/corpus.py MESH... --output corpus.jsonl.

There is one cell for each mesh, key and attack, run by any `concurrent.futures` executor: processes, or Dask's workers.
Each finished cell is a line of the output, and is skipped if the same command runs again. If a worker is killed, a new
pool continues with the remaining cells.
"""

import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import jaxmark as jm
from jaxmark.evaluation.cells import Cell, Pool, load_finished, processes, run
from jaxmark.geometry.mesh import Mesh

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from common.arguments import add_meshes, make_parser
from common.attacks import attacked
from common.tables import Row


@lru_cache(maxsize=1)  # cells of one mesh and key come one after another
def marked(mesh: str, key: int) -> tuple[jm.watermark.NonBlindMarker, Mesh, bytes]:
    """A marker, its mark and its message."""
    rng = np.random.default_rng(key)
    marker, message = jm.make_marker(jm.load_mesh(mesh), rng.bytes(32)), rng.bytes(8)
    return marker, marker.embed(message)[0], message


def run_cell(cell: Any) -> Row:
    """Mark, attack and read; a refusal is a result too."""
    mesh, key, attack = cell
    start = time.perf_counter()
    row: Row = {}
    try:
        marker, mark, message = marked(mesh, key)
        found = marker.detect(attacked(mark, attack, key))
        row |= {"reads": found.message == message, "log10_p": found.log10_p}
    except jm.JaxmarkError as error:
        row |= {"refused": str(error)}
    return row | {"seconds": time.perf_counter() - start, "worker": os.getpid()}


def pools(name: str, workers: int) -> Pool:
    """What makes an executor of so many processes, of this machine or Dask's."""
    if name == "processes":
        return processes(workers)

    @contextmanager
    def dask() -> Iterator[Executor]:
        from distributed import Client

        with Client(n_workers=workers, threads_per_worker=1, dashboard_address=None) as client:
            yield client.get_executor(retries=3)

    return dask


def main() -> None:
    parser = make_parser(__doc__)
    add_meshes(parser)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--keys", type=int, default=2)
    parser.add_argument("--attacks", nargs="+", default=["none 0", "noise 0.005", "smoothing 50", "quantisation 8"])
    parser.add_argument("--executor", choices=["processes", "dask"], default="processes")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    cells: list[Cell] = [*product(map(str, options.meshes), range(options.keys), options.attacks)]
    before = {tuple(row["cell"]) for row in load_finished(options.output)}
    print(f"{len(cells)} cells, {len(before.intersection(cells))} of them finished before")
    start = time.perf_counter()
    rows = run(cells, run_cell, pools(options.executor, options.workers), options.output)
    for attack in options.attacks:
        mine = [row for row in rows if row["cell"][2] == attack]
        print(f"{attack:<20} {sum(row.get('reads', False) for row in mine)}/{len(mine)} read")
    print(f"{time.perf_counter() - start:.1f} s, {len({row['worker'] for row in rows})} workers")


if __name__ == "__main__":
    from corpus import main  # by its own name, by which workers find its functions

    main()
