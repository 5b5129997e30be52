"""Files and machines that misbehave: one sentence, an end, and nothing left behind."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.app.cli import main
from jaxmark.evaluation.cells import load_finished
from jaxmark.files import SUFFIXES
from jaxmark.files.atomic import replacing
from jaxmark.watermark.record import Record
from tests.samples import bumpy_sphere


def run(arguments: list, monkeypatch, capsys) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["jaxmark", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0), capsys.readouterr().err


@pytest.fixture
def ball(tmp_path: Path) -> Path:
    jm.save_mesh(bumpy_sphere(2), tmp_path / "ball.obj")
    return tmp_path / "ball.obj"


def test_what_does_not_end_is_not_read(tmp_path: Path, ball: Path):
    pipe = tmp_path / "pipe.obj"
    os.mkfifo(pipe)
    zero = tmp_path / "zero.obj"
    zero.symlink_to("/dev/zero")
    for path in (pipe, zero):
        with pytest.raises(jm.JaxmarkError, match="it is no ordinary file"):
            jm.load_mesh(path)
        with pytest.raises(jm.JaxmarkError, match="no ordinary file"):
            jm.watermark.load_key(path)
        with pytest.raises(jm.JaxmarkError, match="no ordinary file"):
            Record.load(path)
    with pytest.raises(jm.JaxmarkError, match="more than 4096"):
        jm.watermark.load_key(ball)


def test_a_key_that_cannot_be_written_leaves_no_file(tmp_path: Path, monkeypatch):
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    key = jm.new_key()
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(jm.JaxmarkError, match="No space left on device"):
            jm.watermark.save_key(key, tmp_path / "me.key")
    assert not (tmp_path / "me.key").exists()
    jm.watermark.save_key(key, tmp_path / "me.key")
    assert jm.watermark.load_key(tmp_path / "me.key") == key


def test_a_key_that_others_may_read_is_told(tmp_path: Path, ball: Path, monkeypatch, capsys):
    jm.watermark.save_key(jm.new_key(), tmp_path / "me.key")
    arguments = ["embed", ball, tmp_path / "marked.obj", "--key", tmp_path / "me.key", "--message", "00" * 512]
    assert "other users may read" not in run(arguments, monkeypatch, capsys)[1]
    (tmp_path / "me.key").chmod(0o644)
    assert "me.key; prevent this by: chmod 600" in run(arguments, monkeypatch, capsys)[1]


def test_a_folder_without_meshes_leaves_no_folder(tmp_path: Path, monkeypatch, capsys):
    jm.watermark.save_key(jm.new_key(), tmp_path / "me.key")
    (tmp_path / "empty").mkdir()
    arguments = ["embed", tmp_path / "empty", tmp_path / "out", "--key", tmp_path / "me.key"]
    assert run(arguments, monkeypatch, capsys) == (
        2,
        f"jaxmark: The folder {tmp_path / 'empty'} has no mesh file ({', '.join(SUFFIXES)}).\n",
    )
    assert not (tmp_path / "out").exists()


def test_studies_without_an_end_are_refused(tmp_path: Path):
    for strength in (float("nan"), float("inf"), -1.0):
        with pytest.raises(jm.JaxmarkError, match="finite and not negative"):
            jm.Study(meshes={"ball": bumpy_sphere(2)}, attacks={"noise": [strength]})


@pytest.mark.parametrize(
    "line", [b"{", b"[1, 2]", b"null", b'{"cell": 3}', b'{"cell": [{}]}', b"\xff\xfe", b"[" * 100_000, b"{}"]
)
def test_a_damaged_line_of_results_is_named(tmp_path: Path, line: bytes):
    file = tmp_path / "results.jsonl"
    file.write_bytes(json.dumps({"cell": ["a", 1.0]}).encode() + b"\n" + line + b"\n")
    with pytest.raises(jm.JaxmarkError, match=r"Line 2 of .*results\.jsonl is no row of a study"):
        load_finished(file)


def test_a_byte_order_mark_does_not_hide_a_vertex(tmp_path: Path, ball: Path):
    (tmp_path / "marked.obj").write_bytes(b"\xef\xbb\xbf" + ball.read_bytes())
    found, plain = jm.load_mesh(tmp_path / "marked.obj"), jm.load_mesh(ball)
    np.testing.assert_array_equal(found.vertices, plain.vertices)
    jm.save_mesh(found, tmp_path / "again.obj", like=tmp_path / "marked.obj")
    assert (tmp_path / "again.obj").read_bytes() == (tmp_path / "marked.obj").read_bytes()


def test_links_are_followed_and_drafts_are_not_named(tmp_path: Path):
    (tmp_path / "there").mkdir()
    link = tmp_path / "link.txt"
    link.symlink_to(tmp_path / "there" / "file.txt")
    with replacing(link) as draft:
        draft.write_text("new")
    assert link.is_symlink()
    assert (tmp_path / "there" / "file.txt").read_text() == "new"
    with pytest.raises(jm.JaxmarkError) as refused, replacing(link) as draft:
        raise jm.JaxmarkError(f"Cannot write {draft}: no space.")
    assert str(refused.value) == f"Cannot write {link}: no space."


@pytest.mark.slow
def test_who_is_asked_to_end_leaves_nothing(tmp_path: Path):
    """A request to end, at several moments of a run."""
    jm.watermark.save_key(jm.new_key(), tmp_path / "me.key")
    jm.save_mesh(bumpy_sphere(5), tmp_path / "ball.obj")
    command = [sys.executable, "-c", "from jaxmark.app.start import main; main()", "embed", tmp_path / "ball.obj"]
    command += [tmp_path / "marked.obj", "--key", tmp_path / "me.key", "--budget", "1e-3"]
    for seconds, number in ((0.2, signal.SIGINT), (1.0, signal.SIGTERM), (4.0, signal.SIGTERM), (8.0, signal.SIGTERM)):
        process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        time.sleep(seconds)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
        there = {path.name for path in tmp_path.iterdir()} - {"me.key", "ball.obj"}
        assert there in (set(), {"marked.obj", "marked.obj.jaxmark.json"}), there
        assert "Traceback" not in said or number == signal.SIGINT


@pytest.mark.parametrize("size", [1e-300, 1e-160, 1e160, 1e300])
def test_a_suspect_of_any_size_is_read(size: float, key: jm.Key):
    mesh = bumpy_sphere(3)
    marked, _ = jm.embed(mesh, b"ok", key)
    suspect = marked._replace(vertices=size * np.asarray(marked.vertices))
    found = jm.detect(suspect, original=mesh, key=key, bits=16)
    assert found.message == b"ok"
    assert found.detected()


def test_zeros_beside_exponents_take_their_digits(tmp_path: Path):
    mesh = bumpy_sphere(2)
    rows = 1e-40 * np.asarray(mesh.vertices)
    rows[0] = 0
    lines = [" ".join("0.0" if number == 0 else f"{number:.9e}" for number in row) for row in rows]
    text = "".join(f"v {line}\n" for line in lines) + "".join("f {} {} {}\n".format(*face) for face in mesh.faces + 1)
    (tmp_path / "a.obj").write_text(text)
    before = jm.load_mesh(tmp_path / "a.obj")
    moved = before._replace(vertices=np.asarray(before.vertices) + 1e-44)
    jm.save_mesh(moved, tmp_path / "b.obj", like=tmp_path / "a.obj")
    np.testing.assert_allclose(jm.load_mesh(tmp_path / "b.obj").vertices, moved.vertices, rtol=1e-8, atol=0)
