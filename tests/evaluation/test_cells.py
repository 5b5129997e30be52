"""Cells on many workers: what is finished stays so, dead workers cost no cell, and a corpus is read."""

import importlib
import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

import jaxmark as jm
from jaxmark.evaluation.cells import Cell, load_finished, run
from tests import ROOT
from tests.samples import bumpy_sphere

SPEED = ROOT / "benchmarks" / "speed"


def lines(output: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in output.read_text().splitlines()]


@pytest.mark.slow
def test_a_corpus_is_marked_attacked_and_read(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(SPEED)
    corpus = importlib.import_module("corpus")
    mesh, output = tmp_path / "sphere.ply", tmp_path / "corpus.jsonl"
    jm.save_mesh(bumpy_sphere(4), mesh)
    cells = [(str(mesh), 0, "none 0"), (str(mesh), 0, "noise 0.002")]
    rows = run(cells, corpus.run_cell, lambda: ThreadPoolExecutor(1), output)
    assert [row["reads"] for row in rows] == [True, True]
    assert lines(output) == [json.loads(json.dumps(row)) for row in rows]


def test_what_is_finished_stays_so(tmp_path):
    output, cells, said = tmp_path / "cells.jsonl", [("a", 1), ("b", 2), ("c", 3)], []
    done = run(cells[:2], squared, lambda: ThreadPoolExecutor(1), output, said.append)
    assert [row["square"] for row in done] == [1, 4]
    assert [line.split(",")[0] for line in said] == ["1/2", "2/2"]
    # A run that was killed while it wrote a line has torn it.
    whole = output.read_bytes()
    output.write_bytes(whole[:-20])
    assert [tuple(row["cell"]) for row in load_finished(output)] == cells[:1]
    # Rows come in the order of the cells, whatever was finished before.
    rows = run(cells[::-1], squared, lambda: ThreadPoolExecutor(1), output)
    assert [row["square"] for row in rows] == [9, 4, 1]
    assert {tuple(row["cell"]) for row in lines(output)} == set(cells)
    # All is finished: no pool is asked for.
    assert run(cells, squared, lambda: pytest.fail("a pool"), output) == rows[::-1]


def test_cells_of_a_group_are_computed_one_after_another(tmp_path):
    output, cells = tmp_path / "cells.jsonl", [("a", 1), ("b", 2), ("a", 3), ("b", 4)]
    rows = run(cells, squared, lambda: ThreadPoolExecutor(1), output, group=lambda cell: cell[0])
    assert [row["square"] for row in rows] == [1, 4, 9, 16]
    assert [row["cell"] for row in lines(output)] == [["a", 1], ["a", 3], ["b", 2], ["b", 4]]


@pytest.mark.long
def test_what_goes_wrong_is_raised_and_what_was_finished_stays(tmp_path):
    output = tmp_path / "cells.jsonl"
    with pytest.raises(ZeroDivisionError):
        run([("a", 4), ("b", 0), ("c", 5)], inverse, lambda: ThreadPoolExecutor(1), output)
    assert [row["inverse"] for row in lines(output)] == [0.25]
    with pytest.raises(jm.JaxmarkError, match="3 pools"):
        run([("d", 1)], dies, lambda: ProcessPoolExecutor(1, get_context("spawn")), output)


@pytest.mark.long
def test_a_killed_worker_costs_no_cell(tmp_path, monkeypatch):
    output, pools = tmp_path / "corpus.jsonl", []
    monkeypatch.setenv("GRAVE", str(tmp_path / "grave"))

    def pool() -> Executor:
        pools.append(ProcessPoolExecutor(1, get_context("spawn")))
        return pools[-1]

    cells = [("mesh", number, "none 0") for number in range(4)]
    run(cells, dies_once, pool, output)
    assert len(pools) == 2
    assert sorted(row["cell"][1] for row in lines(output)) == [0, 1, 2, 3]


def dies_once(cell: Cell) -> dict[str, Any]:
    """A cell whose first worker is killed at the third key."""
    grave = Path(os.environ["GRAVE"])
    if cell[1] == 2 and not grave.exists():
        grave.touch()
        os._exit(9)
    return {}


def dies(cell: Cell) -> dict[str, Any]:
    """No worker survives this."""
    os._exit(9)


def squared(cell: Cell) -> dict[str, Any]:
    return {"square": int(cell[1]) ** 2}


def inverse(cell: Cell) -> dict[str, Any]:
    return {"inverse": 1 / int(cell[1])}


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="asks for signals")
def test_workers_end_with_the_process_that_is_killed():
    code = "import os, time\nfrom jaxmark.evaluation.cells import processes\nif __name__ == '__main__':\n"
    code += "    pool = processes(1)()\n    print(pool.submit(os.getpid).result(), flush=True)\n    time.sleep(60)\n"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        worker = int(parent.stdout.readline())
        os.kill(worker, 0)
        parent.send_signal(signal.SIGKILL)
    for _ in range(100):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("the worker still waits")
