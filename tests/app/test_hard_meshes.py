"""What real tools choke on: each file is marked and read back, or refused with one sentence."""

import sys
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

import jaxmark as jm
from jaxmark.app import cli
from tests.meshes import shared_meshes

MESSAGE = "c3"
FILES = shared_meshes("hard")


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["jaxmark", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        sys.exit(cli.main())
    return int(end.value.code or 0)


@pytest.mark.slow
@pytest.mark.skipif(not FILES, reason="shared meshes hard/ are absent (set JAXMARK_MESHES)")
@pytest.mark.parametrize(
    ("path", "scheme"),
    list(zip(FILES[::3], cycle(["keyed", "host", "eigen"]), strict=False)),
    ids=lambda case: Path(case).name,
)
def test_marked_and_read_back_or_refused(path: Path, scheme, tmp_path, monkeypatch, capfd, unchecked):
    """Every third file, with one scheme each: every shape is compiled anew."""
    jm.watermark.save_key(jm.Key(bytes(range(32))), tmp_path / "key")
    marked = tmp_path / f"marked{path.suffix}"
    embed = ("embed", path, marked, "--key", tmp_path / "key", "--message", MESSAGE, "--scheme", scheme, "--noise", 0)
    status = run(monkeypatch, *embed)
    out, err = capfd.readouterr()
    if status == 2:
        assert out == ""
        assert err.startswith("jaxmark: ")
        assert err.count("\n") == 1
        assert [file.name for file in tmp_path.iterdir()] == ["key"]
        print(err, end="")
        return
    assert status == 0
    detect = ("detect", marked, "--original", path, "--key", tmp_path / "key", "--bits", "8", "--scheme", scheme)
    assert run(monkeypatch, *detect) == 0
    assert f"message {MESSAGE}" in capfd.readouterr().out
    before, after = jm.load_mesh(path), jm.load_mesh(marked)
    np.testing.assert_array_equal(before.faces, after.faces)


@pytest.mark.slow
@pytest.mark.skipif(not FILES, reason="shared meshes hard/ are absent (set JAXMARK_MESHES)")
def test_not_all_are_refused(key, unchecked):
    """The first test would pass on a program that refuses everything; about half of the files can be marked."""
    marked = 0
    for path in FILES[::6]:
        try:
            jm.embed(jm.load_mesh(path), b"\xc3", key, budget={"dame": 0.008}, scheme="host")
            marked += 1
        except jm.JaxmarkError:
            pass
    assert marked >= len(FILES[::6]) / 3
