import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.files import atomic
from jaxmark.files.atomic import replacing, write_atomically

pytestmark = pytest.mark.core


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
@pytest.mark.parametrize(("mode", "expected"), [(None, 0o640), (0o600, 0o600), (0o666, 0o666)])
def test_permissions(tmp_path: Path, mode: int | None, expected: int) -> None:
    old = os.umask(0o027)
    try:
        write_atomically(tmp_path / "file", b"data", mode=mode)
    finally:
        os.umask(old)
    assert (tmp_path / "file").stat().st_mode & 0o777 == expected


def test_a_file_is_replaced_and_nothing_else_left(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"before")
    write_atomically(tmp_path / "file", b"after")
    assert (tmp_path / "file").read_bytes() == b"after"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_failure_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, function: str) -> None:
    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "file").write_bytes(b"before")
    monkeypatch.setattr(os, function, fail)
    with pytest.raises(JaxmarkError, match=r"file: No space left on device\."):
        write_atomically(tmp_path / "file", b"after")
    assert (tmp_path / "file").read_bytes() == b"before"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_interruption_leaves_no_temporary_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "file", b"after")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [("absent/file", "the folder .*absent does not exist"), (".", "not an ordinary file"), ("a\0b", "NUL")],
)
def test_impossible_places(tmp_path: Path, name: str, message: str) -> None:
    with pytest.raises(JaxmarkError, match=message):
        write_atomically(tmp_path / name, b"data")


def test_a_symbolic_link_stays_one(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"before")
    (tmp_path / "link").symlink_to("real")
    write_atomically(tmp_path / "link", b"after")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"after"


def test_folders_that_cannot_be_written_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(atomic.tempfile, "mkdtemp", refuse)
    with pytest.raises(JaxmarkError, match=r"Cannot write .*file: Permission denied"), replacing(tmp_path / "file"):
        pytest.fail("There is no draft.")


def test_what_gets_its_name_has_reached_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_ino))
    with replacing(tmp_path / "file") as draft:
        draft.write_bytes(b"content")
    assert synced == [(tmp_path / "file").stat().st_ino]


@pytest.mark.skipif(os.name != "posix", reason="only there can a process be asked whether it runs")
def test_drafts_of_killed_processes_are_cleared(tmp_path: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    mine = atomic._own_prefix()
    dead = mine.replace(f"-{os.getpid()}-", f"-{child.pid}-")
    (tmp_path / f"{dead}folder").mkdir()
    (tmp_path / f"{dead}folder" / "marked.ply").write_text("draft")
    (tmp_path / f"{dead}file.tmp").write_text("draft")
    others = [f"{mine}file.tmp", ".jaxmark-elsewhere-1-file.tmp", ".jaxmark-notes", "marked.ply"]
    for name in others:
        (tmp_path / name).write_text("not ours to delete")
    write_atomically(tmp_path / "out.ply", b"out")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, "out.ply"])
