"""The benchmark that spreads a corpus over workers: what is finished stays so, and dead workers cost no cell."""

import importlib
import json
import os
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import jaxmark as jm
from tests.samples import bumpy_sphere

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def corpus(monkeypatch) -> ModuleType:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("corpus")


def lines(output: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in output.read_text().splitlines()]


@pytest.mark.slow
def test_marks_attacks_and_reads(corpus, tmp_path):
    mesh, output = tmp_path / "sphere.ply", tmp_path / "corpus.jsonl"
    jm.save_mesh(bumpy_sphere(4), mesh)
    cells = [(str(mesh), 0, "none 0"), (str(mesh), 0, "noise 0.002")]
    corpus.run(cells[:2], lambda: ThreadPoolExecutor(1), output)
    assert [row["reads"] for row in lines(output)] == [True, True]
    # A run that was killed while it wrote a line has torn it.
    whole = output.read_bytes()
    output.write_bytes(whole[:-20])
    assert corpus.finished(output) == {cells[0]}
    corpus.run(cells[:2], lambda: ThreadPoolExecutor(1), output)
    assert {tuple(row["cell"]) for row in lines(output)} == set(cells[:2])
    # All is finished: no pool is asked for.
    corpus.run(cells[:2], lambda: pytest.fail("a pool"), output)


def test_a_killed_worker_costs_no_cell(corpus, tmp_path, monkeypatch):
    output, pools = tmp_path / "corpus.jsonl", []
    monkeypatch.setenv("GRAVE", str(tmp_path / "grave"))
    monkeypatch.setattr(corpus, "run_cell", dies_once)

    def pool() -> Executor:
        pools.append(ProcessPoolExecutor(1, get_context("spawn")))
        return pools[-1]

    cells = [("mesh", number, "none 0") for number in range(4)]
    corpus.run(cells, pool, output)
    assert len(pools) == 2
    assert sorted(row["cell"][1] for row in lines(output)) == [0, 1, 2, 3]


def dies_once(cell: tuple[str, int, str]) -> dict[str, Any]:
    """A cell whose first worker is killed at the third key."""
    grave = Path(os.environ["GRAVE"])
    if cell[1] == 2 and not grave.exists():
        grave.touch()
        os._exit(9)
    return {"cell": cell}
