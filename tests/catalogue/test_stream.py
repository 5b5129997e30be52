"""Many suspects: resumed, with what cannot be read kept apart, whatever becomes of workers."""

import json
import os
import signal
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path

import pytest

import jaxmark as jm
from jaxmark.catalogue import Plan, count, find_each, stream
from jaxmark.evaluation.cells import processes
from tests.samples import rough_sphere

pytestmark = pytest.mark.usefixtures("unchecked")
KEY = jm.Key(bytes(32))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch) -> Path:
    """A catalogue and six suspects, of which two are no meshes."""
    monkeypatch.chdir(tmp_path)
    jm.save_mesh(rough_sphere(60), "original.obj")
    with jm.Catalogue("shop.db") as catalogue:
        catalogue.add("original.obj")
    Path("suspects", "deep").mkdir(parents=True)
    for name in ("a.obj", "b.obj", "deep/c.obj", "d.obj"):
        jm.save_mesh(rough_sphere(40, seed=len(name) + ord(name[0])), Path("suspects", name))
    for name in ("e.obj", "f.ply"):
        Path("suspects", name).write_text("nothing")
    Path("suspects", "notes.txt").write_text("no mesh")
    return tmp_path


class Quick:
    """Finds nobody, at once."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def prepare(self) -> None:
        pass

    def find(self, path: str) -> jm.catalogue.Verdict:
        self.seen.append(Path(path).name)
        jm.load_mesh(path)
        return jm.catalogue.Verdict("00", (), 1)


@pytest.fixture
def quick(monkeypatch) -> Quick:
    found = Quick()
    monkeypatch.setattr(stream, "_finder", lambda plan: found)
    return found


def run(pool=1, suspects=None, said=None) -> list[dict]:
    plan = Plan(Path("shop.db").resolve(), (KEY,))
    suspects = jm.catalogue.mesh_files_below(Path("suspects")) if suspects is None else suspects
    return list(find_each(plan, suspects, "found.jsonl", pool, said or (lambda line: None)))


def lines(name: str) -> list[dict]:
    return [json.loads(line) for line in Path(name).read_text().splitlines()]


def test_each_suspect_is_done_once_and_what_is_refused_is_kept_apart(folder: Path, quick: Quick):
    rows = run()
    assert count(rows) == (0, 4, 2)
    assert quick.seen == ["a.obj", "b.obj", "d.obj", "e.obj", "f.ply", "c.obj"]
    assert [Path(row["suspect"]).name for row in lines("found.jsonl")] == ["a.obj", "b.obj", "d.obj", "c.obj"]
    assert [Path(row["suspect"]).name for row in lines("found.jsonl.dead.jsonl")] == ["e.obj", "f.ply"]
    with jm.Catalogue("shop.db", read_only=True) as catalogue:
        assert len(list(catalogue.verdicts())) == 4
    assert run() == []
    Path("found.jsonl.dead.jsonl").unlink()
    assert len(run()) == 2
    assert KEY.hex() not in Path("found.jsonl").read_text()


def test_a_run_that_was_killed_resumes_at_its_last_whole_line(folder: Path, quick: Quick):
    run()
    text = Path("found.jsonl").read_bytes()
    Path("found.jsonl").write_bytes(text[:-20])
    assert [Path(row["suspect"]).name for row in run()] == ["c.obj"]
    assert len(lines("found.jsonl")) == 4
    Path("found.jsonl").write_text("[]\n")
    with pytest.raises(jm.JaxmarkError, match=r"Line 1 of .* is no verdict"):
        run()


def test_suspects_are_taken_as_workers_need_them(folder: Path, quick: Quick):
    taken = []

    def endless():
        for number in range(10**9):
            taken.append(number)
            yield f"suspects/{number}.obj"

    rows = find_each(Plan(Path("shop.db").resolve(), (KEY,)), endless(), "found.jsonl", lambda: ThreadPoolExecutor(2))
    assert "refused" in next(rows)
    rows.close()
    assert len(taken) <= 8 * (os.cpu_count() or 1)


class Fragile(Executor):
    """Breaks whenever a certain suspect is in it, as a pool does whose process is killed."""

    def submit(self, work, /, plan, path):  # pyright: ignore[reportIncompatibleMethodOverride]
        future: Future = Future()
        if path.endswith("b.obj"):
            future.set_exception(BrokenExecutor("A process ended."))
        else:
            future.set_result(work(plan, path))
        return future


def test_what_breaks_its_pool_is_found_out_and_left(folder: Path, quick: Quick):
    said: list[str] = []
    rows = run(Fragile, said=said.append)
    assert sorted(Path(row["suspect"]).name for row in lines("found.jsonl")) == ["a.obj", "c.obj", "d.obj"]
    assert "killed the worker" in next(row for row in rows if row["suspect"].endswith("b.obj"))["refused"]
    assert len(rows) == 6
    assert 1 <= len(said) <= 4


def killing(plan: Plan, path: str) -> dict:
    """Kills its process once."""
    if path.endswith("a.obj") and not Path("killed").exists():
        Path("killed").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return {"named": False, "suspect_sha256": Path(path).name}


@pytest.mark.long
def test_a_worker_that_is_killed_costs_no_suspect(folder: Path, quick: Quick, monkeypatch):
    monkeypatch.setattr(stream, "work", killing)
    rows = run(processes(2))
    assert Path("killed").exists()
    assert sorted(row["suspect_sha256"] for row in rows) == ["a.obj", "b.obj", "c.obj", "d.obj", "e.obj", "f.ply"]


@pytest.mark.long
def test_dask_gives_the_same_answers_when_a_worker_is_killed(folder: Path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(stream, "work", killing)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        rows = run(lambda: client.get_executor(pure=False))
    assert Path("killed").exists()
    assert sorted(row["suspect_sha256"] for row in rows) == ["a.obj", "b.obj", "c.obj", "d.obj", "e.obj", "f.ply"]


def is_read_only(plan: Plan) -> bool:
    """In a worker: whether it opened the catalogue for reading only."""
    return stream._finder(plan).catalogue.database.read_only


@pytest.mark.long
def test_dask_workers_search_as_one_process_does(tmp_path: Path, monkeypatch):
    """The search itself: a marked suspect and one that is nobody's get the verdicts that this process gives."""
    distributed = pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    with jm.Catalogue("shop.db") as catalogue:
        for seed in range(2):
            jm.save_mesh(rough_sphere(500, seed), f"{seed}.obj")
            catalogue.add(f"{seed}.obj")
    marked, _ = jm.embed(jm.load_mesh("0.obj"), b"ab", KEY, budget=0.004)
    jm.save_mesh(jm.attack(marked, "noise", 0.002, seed=0), "marked.obj")
    jm.save_mesh(jm.attack(jm.load_mesh("1.obj"), "noise", 0.002, seed=0), "nobodys.obj")
    plan, suspects = (
        Plan(Path("shop.db").resolve(), (KEY,), (("bits", 16), ("depth", 1))),
        ["marked.obj", "nobodys.obj"],
    )
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        found = list(find_each(plan, suspects, "found.jsonl", lambda: client.get_executor(pure=False)))
        assert list(client.run(is_read_only, plan).values()) == [True, True]
    rows, alone = (
        {Path(row["suspect"]).name: {**row, "seconds": 0} for row in some}
        for some in (found, find_each(plan, suspects, "alone.jsonl"))
    )
    assert rows == alone
    assert (Path(rows["marked.obj"]["original"]).name, rows["marked.obj"]["message"]) == ("0.obj", b"ab".hex())
    assert not rows["nobodys.obj"]["named"]


@pytest.mark.skipif(os.name != "posix", reason="other systems have no such names")
def test_names_that_cannot_be_stored_stop_no_other_suspect(folder: Path, quick: Quick):
    """A name that is not UTF-8, which SQLite refuses, and one with a NUL, which no file can have."""
    odd = "suspects/\udcff.obj"
    Path("suspects/a.obj").rename(odd)
    said: list[str] = []
    rows = run(suspects=[odd, "suspects/\0.obj", "suspects/b.obj"], said=said.append)
    assert [Path(row["suspect"]).name for row in rows] == ["\udcff.obj", "\0.obj", "b.obj"]
    assert ["refused" in row for row in rows] == [False, True, False]
    assert len(said) == 1
    assert "not stored in the catalogue" in said[0]
    with jm.Catalogue("shop.db", read_only=True) as catalogue:
        assert [Path(verdict["path"]).name for verdict in catalogue.verdicts()] == ["b.obj"]
