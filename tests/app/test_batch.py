"""Folders of files marked and read: a line for each, and one that is refused stops none of the others."""

import json
from pathlib import Path

import pytest

import jaxmark as jm
from jaxmark.app.output import Status
from tests.app.test_cli import Workshop
from tests.samples import bumpy_sphere

pytestmark = pytest.mark.usefixtures("unchecked")
KEY = ("--key", "owner.key")
MARK = (*KEY, "--message", "c0ff", "--budget", "0.002", "--noise", "0")


@pytest.fixture
def workshop(tmp_path, monkeypatch, capfd) -> Workshop:
    made = Workshop(tmp_path, monkeypatch, capfd)
    Path("models").mkdir()
    for seed, name in enumerate(("a.ply", "b.obj")):
        jm.save_mesh(bumpy_sphere(3, seed), Path("models", name))
    Path("models/notes.txt").write_text("no mesh")
    Path("models/.hidden.ply").write_text("no mesh")
    return made


def lines(workshop: Workshop, *arguments: object) -> tuple[int, list[dict]]:
    code, out, _ = workshop(*arguments, "--json")
    return code, [json.loads(line) for line in out.splitlines()]


@pytest.mark.slow
def test_a_folder_is_marked_and_read(workshop: Workshop):
    code, told = lines(workshop, "embed", "models", "marked", *MARK)
    assert code == 0
    assert [one["file"] for one in told] == ["a.ply", "b.obj"]
    assert [one["rms"] for one in told] == pytest.approx([0.002, 0.002], rel=1e-3)
    assert {path.name for path in Path("marked").iterdir()} == {
        *("a.ply", "b.obj", "a.ply.jaxmark.json", "b.obj.jaxmark.json")
    }
    code, found = lines(workshop, "detect", "marked", "--original", "models", *KEY, "--record", "marked")
    assert code == 0
    assert [one["message"] for one in found] == ["c0ff", "c0ff"]
    alone = workshop.json(
        "detect", "marked/a.ply", "--original", "models/a.ply", *KEY, "--record", "marked/a.ply.jaxmark.json"
    )
    assert alone["log10_p"] == found[0]["log10_p"]
    # Files without a mark: nothing is detected.
    code, out, _ = workshop("detect", "models", "--original", "models", *KEY, "--bits", "16")
    assert code == 1
    assert [line.split(": ")[:2] for line in out.splitlines()] == [
        ["a.ply", "nothing detected"],
        ["b.obj", "nothing detected"],
    ]
    # One original for all, another mesh among the suspects.
    code, found = lines(workshop, "detect", "marked", "--original", "models/a.ply", *KEY, "--message", "c0ff")
    assert code in (1, 2)
    assert found[0]["detected"]
    assert not found[1].get("detected")


@pytest.mark.parametrize(
    ("statuses", "worst"), [([], 0), ([0, 0], 0), ([0, 3], 3), ([0, 3, 1], 1), ([3, 2, 1], 2), ([3, 3], 3)]
)
def test_a_folder_has_the_worst_status_of_its_files(statuses: list[int], worst: int):
    assert Status.worst(map(Status, statuses)) == worst


def test_one_that_is_refused_does_not_stop_the_others(workshop: Workshop):
    Path("models/a-broken.ply").write_text("ply")
    code, told = lines(workshop, "embed", "models", "marked", *MARK)
    assert code == 2
    assert [one["file"] for one in told] == ["a-broken.ply", "a.ply", "b.obj"]
    assert "a-broken.ply" in told[0]["refused"]
    assert not Path("marked/a-broken.ply").exists()
    assert all(Path(one["marked"]).is_file() for one in told[1:])
    Path("models/a.ply").unlink()
    code, out, _ = workshop("detect", "marked", "--original", "models", *KEY, "--bits", "16")
    assert code == 2
    first, second = out.splitlines()
    assert first.startswith("a.ply: refused. Cannot read models/a.ply")
    assert second.startswith("b.obj: detected: message c0ff")


def test_refusals(workshop: Workshop):
    Path("empty").mkdir()
    for arguments, sentence in [
        (("embed", "models", "models", *MARK), "same file"),
        (("embed", "models", "out", *MARK, "--record", "one.json"), "leave out --record"),
        (("embed", "models", "owner.key", *MARK), "owner.key"),
        (("detect", "empty", "--original", "models", *KEY), "no mesh file"),
        (("embed", "models", "out", "--key", "absent.key", "--message", "c0ff"), "absent.key"),
    ]:
        assert sentence in workshop.refused(*arguments)
